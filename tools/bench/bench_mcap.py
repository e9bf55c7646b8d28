"""Frame files: megabytes a second of our writer and reader, beside the official Python ones.

Run: python -m tools.bench.bench_mcap [--megapixels 4.2] [--frames 40]

Both write one uncompressed chunk a frame with its CRC, and read with CRCs checked. Seconds are CPU
time, so that a busy machine does not change the ratio; files are removed at the end.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from mcap.reader import SeekingReader
from mcap.writer import CompressionType, Writer

from capture.arrays import Image
from capture.frame_header import FrameHeader, ImageLayout
from capture.mcap import FrameReader, FrameWriter


def main() -> None:
    """Print one line a measurement."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--megapixels", type=float, default=4.2)
    parser.add_argument("--frames", type=int, default=40)
    arguments = parser.parse_args()
    side = round((arguments.megapixels * 1e6) ** 0.5)
    image = np.random.default_rng(0).integers(0, 256, (side, side), dtype=np.uint8)
    megabytes = arguments.frames * image.nbytes / 1e6
    with tempfile.TemporaryDirectory() as folder:
        ours, theirs = Path(folder) / "ours.mcap", Path(folder) / "theirs.mcap"
        runs: dict[str, Callable[[], None]] = {
            "write, ours": lambda: write_ours(ours, image, arguments.frames),
            "write, mcap package": lambda: write_theirs(theirs, image, arguments.frames),
            "read, ours": lambda: read_ours(ours),
            "read, mcap package": lambda: read_theirs(theirs),
        }
        for name, run in runs.items():
            began = time.process_time()
            run()
            print(f"{name:22s} {megabytes / (time.process_time() - began):7.0f} MB/s of CPU time")


def write_ours(path: Path, image: Image, frames: int) -> None:
    """Write with our emitter."""
    with FrameWriter(path, "cam00", ImageLayout.of(image)) as writer:
        for k in range(frames):
            writer.write(FrameHeader(k), image)


def write_theirs(path: Path, image: Image, frames: int) -> None:
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


def read_ours(path: Path) -> None:
    """Read every frame with our reader, CRCs checked."""
    reader = FrameReader(path)
    for k in range(len(reader)):
        reader.read(k)


def read_theirs(path: Path) -> None:
    """Read every message with the official package, CRCs checked."""
    with path.open("rb") as file:
        for _ in SeekingReader(file, validate_crcs=True).iter_messages():
            pass


if __name__ == "__main__":
    main()
