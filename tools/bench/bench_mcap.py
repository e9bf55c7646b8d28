"""Frame files: our writer beside bare writev and the official package, and reading back.

Run: python -m tools.bench.bench_mcap [--megapixels 4.2] [--frames 40] [--folder /dev/shm]

All write the same frames to the same file system; runs alternate and the median ratio counts, so
that a busy machine does not decide. As in a recording, another thread has computed the CRC of the
pixels, so it is not in our writer's time; that of the package is in its own. Reading back is held
against recording: writing a take of several devices, CRCs included, files closed and synced.
"""

from __future__ import annotations

import argparse
import functools
import os
import shutil
import statistics
import tempfile
import time
import zlib
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from mcap.reader import SeekingReader
from mcap.writer import CompressionType, Writer

from capture.arrays import Image
from capture.crc import crc32, crc_engine
from capture.frame_header import FrameHeader, ImageLayout, pixel_crc
from capture.ledger import all_present
from capture.manifest import TakeManifest
from capture.mcap import FrameReader, FrameWriter
from capture.take import Take
from capture.take_writer import TakeWriter, partial_folder
from capture.verify import VerifySettings, verify_take

_DEVICES = 4


def main() -> None:
    """Print every figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--megapixels", type=float, default=4.2)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--folder", type=Path, default=Path("/dev/shm"))
    arguments = parser.parse_args()
    side = round((arguments.megapixels * 1e6) ** 0.5)
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        lines = bench_lines(Path(folder), side, arguments.frames, arguments.repeats)
    print("\n".join(lines))


def bench_lines(place: Path, side_px: int = 2048, frames: int = 40, repeats: int = 7) -> list[str]:
    """Every figure, a line each; frames are square and of noise."""
    shape = (side_px, side_px)
    image = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    tables = (
        measure_writers(place, image, frames=frames, repeats=repeats),
        measure_readers(place, image, frames=frames, repeats=repeats),
        measure_verification(place, image, frames=frames // 2, repeats=repeats),
    )
    return crc_lines(image) + [line for table in tables for line in lines_of(table)]


def measure_writers(place: Path, image: Image, *, frames: int, repeats: int) -> dict[str, float]:
    """Medians of MB/s of each writer, and of our ratios to the others, run by run.

    Args:
        place: a folder of the file system that counts.
        image: every frame.
        frames: in a file.
        repeats: rounds; every writer has its turn in each.
    """
    crc = pixel_crc(image)
    runs: dict[str, Callable[[Path], None]] = {
        "writev": lambda path: _write_bare(path, image, frames),
        "ours": lambda path: _write_ours(path, image, frames, crc),
        "ours, CRC in the same thread": lambda path: _write_ours(path, image, frames, None),
        "mcap package": lambda path: _write_theirs(path, image, frames),
    }
    rates = _paired(place, runs, frames * image.nbytes / 1e6, repeats)
    return {
        **{f"write {name}, MB/s": statistics.median(values) for name, values in rates.items()},
        "ours / writev": _ratio(rates["ours"], rates["writev"]),
        "ours / mcap package": _ratio(rates["ours"], rates["mcap package"]),
    }


def measure_readers(place: Path, image: Image, *, frames: int, repeats: int) -> dict[str, float]:
    """Medians of MB/s of our reader and the official one, CRCs checked, and their ratio."""
    path = place / "read.mcap"
    _write_ours(path, image, frames, None)
    runs: dict[str, Callable[[Path], None]] = {
        "ours": lambda _: _read_ours(path),
        "mcap package": lambda _: _read_theirs(path),
    }
    rates = _paired(place, runs, frames * image.nbytes / 1e6, repeats)
    path.unlink()
    return {
        **{f"read {name}, MB/s": statistics.median(values) for name, values in rates.items()},
        "reading, ours / mcap package": _ratio(rates["ours"], rates["mcap package"]),
    }


def measure_verification(
    place: Path, image: Image, *, frames: int, repeats: int
) -> dict[str, float]:
    """Medians of MB/s of recording a take and of reading it back, and their ratios.

    Args:
        place: a folder of the file system that counts.
        image: every frame.
        frames: of each of four devices.
        repeats: rounds.
    """
    names = [f"cam{number:02d}" for number in range(_DEVICES)]
    megabytes = _DEVICES * frames * image.nbytes / 1e6
    rates: dict[str, list[float]] = {"record": [], "verify": [], "verify, CRC only": []}
    for _ in range(repeats):
        folder = partial_folder(place / "take")
        rates["record"].append(
            megabytes / _seconds(lambda: record_take(place / "take", names, image, frames))
        )
        for name, settings in (
            ("verify", VerifySettings()),
            ("verify, CRC only", VerifySettings(hashed=False)),
        ):
            reading = functools.partial(_verified, folder, settings)
            rates[name].append(megabytes / _seconds(reading))
        shutil.rmtree(folder)
    return {
        **{f"{name}, MB/s": statistics.median(values) for name, values in rates.items()},
        "verify / record": _ratio(rates["verify"], rates["record"]),
        "verify, CRC only / record": _ratio(rates["verify, CRC only"], rates["record"]),
    }


def crc_lines(image: Image) -> list[str]:
    """How fast CRCs are computed, by zlib and by what is used."""
    raw = image.data.cast("B")
    lines = []
    for name, compute in (("zlib", zlib.crc32), (crc_engine(), crc32)):
        best = min(_seconds(functools.partial(compute, raw)) for _ in range(20))
        lines.append(f"CRC by {name:24s} {len(raw) / best / 1e6:8.0f} MB/s")
    return lines


def lines_of(table: Mapping[str, float]) -> list[str]:
    """The figures of a table, a line each."""
    return [
        f"{name:32s} {value:8.0f}" if name.endswith("MB/s") else f"{name:32s} {value:8.2f}"
        for name, value in table.items()
    ]


def _write_bare(path: Path, image: Image, frames: int) -> None:
    """Write header and pixels of each frame and nothing else."""
    raw, header = image.data.cast("B"), FrameHeader(0).pack()
    with path.open("wb", buffering=0) as file:
        for _ in range(frames):
            pending = [memoryview(header), raw]
            while pending:
                written = os.writev(file.fileno(), pending)
                while pending and written >= len(pending[0]):
                    written -= len(pending.pop(0))
                if pending:
                    pending[0] = pending[0][written:]
        os.fsync(file.fileno())


def _write_ours(path: Path, image: Image, frames: int, crc: int | None) -> None:
    """Write with our emitter; `crc` of the pixels where another thread has computed it."""
    with FrameWriter(path, "cam00", ImageLayout.of(image)) as writer:
        for k in range(frames):
            writer.write(FrameHeader(k), image, crc)


def _write_theirs(path: Path, image: Image, frames: int) -> None:
    """Write with the official package: one chunk a frame, no compression, CRCs on."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1, compression=CompressionType.NONE, enable_crcs=True)
        writer.start()
        schema = writer.register_schema("frame", "x-raw", b"")
        channel = writer.register_channel("cam00", "x-raw", schema)
        for k in range(frames):
            data = FrameHeader(k).pack() + image.tobytes()
            writer.add_message(channel, log_time=k, publish_time=k, data=data, sequence=k)
        writer.finish()


def _read_ours(path: Path) -> None:
    """Read every frame with our reader, CRCs checked."""
    reader = FrameReader(path)
    for k in range(len(reader)):
        reader.read(k)


def _read_theirs(path: Path) -> None:
    """Read every message with the official package, CRCs checked."""
    with path.open("rb") as file:
        for _ in SeekingReader(file, validate_crcs=True).iter_messages():
            pass


def record_take(final: Path, names: list[str], image: Image, frames: int) -> None:
    """Record a take of several devices as a recording does: a thread a device, CRCs, syncs."""
    layouts = dict.fromkeys(names, ImageLayout.of(image))
    writing = TakeWriter(partial_folder(final), layouts, opening={}, expected_frames=frames)
    with writing as writer, ThreadPoolExecutor(os.cpu_count()) as pool:

        def record(device: str) -> None:
            for k in range(frames):
                writer.write(device, FrameHeader(k), image, pixel_crc(image))

        list(pool.map(record, names))
        writer.finish(
            lambda devices: TakeManifest(
                name=final.name, kind="capture", devices=devices, frame_count=frames
            ),
            ledger=all_present(names, frames),
            hashed=False,
        )


def _verified(folder: Path, settings: VerifySettings) -> None:
    report = verify_take(Take.open(folder), settings)
    if not report.sound:
        raise SystemExit("\n".join(report.problems))


def _paired(
    place: Path, runs: Mapping[str, Callable[[Path], None]], megabytes: float, repeats: int
) -> dict[str, list[float]]:
    """MB/s of every run in every round; each round runs all, the first one last the next time."""
    rates: dict[str, list[float]] = {name: [] for name in runs}
    order = list(runs)
    for _ in range(repeats):
        for name in order:
            path = place / "bench.mcap"
            rates[name].append(megabytes / _seconds(functools.partial(runs[name], path)))
            path.unlink(missing_ok=True)
        order = [*order[1:], order[0]]
    return rates


def _ratio(ours: list[float], others: list[float]) -> float:
    return statistics.median(a / b for a, b in zip(ours, others, strict=True))


def _seconds(action: Callable[[], object]) -> float:
    began = time.perf_counter()
    action()
    return time.perf_counter() - began


if __name__ == "__main__":
    main()
