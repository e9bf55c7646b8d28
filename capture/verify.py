"""Reading a take back: frames against their CRC, files against their hash, the ledger's sums."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

from capture.errors import TakeError
from capture.ledger import Ledger, Verdict
from capture.mcap import FrameReader
from capture.product import hash_file
from capture.progress import Progress, silent
from capture.take import Take


@dataclass(frozen=True)
class VerifyReport:
    """What reading a take back found.

    Attributes:
        frames: how many were read whole.
        verdicts: how often each verdict stands in the ledger.
        problems: one line each; none when the take is sound.
    """

    frames: int
    verdicts: dict[Verdict, int]
    problems: tuple[str, ...]

    @property
    def sound(self) -> bool:
        """Whether nothing is wrong."""
        return not self.problems


def verify_take(take: Take, *, progress: Progress = silent) -> VerifyReport:
    """Read back all frames of a take, and hold the ledger against them.

    Args:
        take: the take.
        progress: told after each device.
    """
    problems: list[str] = []
    try:
        ledger = take.ledger()
        verdicts = ledger.counts()
        _check_ledger(take, ledger, problems)
    except TakeError as error:
        ledger, verdicts = None, {}
        problems.append(str(error))
    frames = 0
    for place, entry in enumerate(take.manifest.devices):
        path = take.folder / "frames" / f"{entry.name}.mcap"
        try:
            if hash_file(path) != entry.sha256:
                problems.append(f"{path}: its SHA-256 is not the one in take.json")
            reader = take.reader(entry.name)
        except (OSError, TakeError) as error:
            problems.append(f"{path}: {error}")
            continue
        if len(reader) != entry.frames:
            problems.append(f"{path}: expected {entry.frames} frames, found {len(reader)}")
        frames += _read_all(reader, problems)
        if ledger is not None:
            _check_device(reader, entry.name, ledger, problems)
        progress(place + 1, len(take.manifest.devices), "verify")
    return VerifyReport(frames, verdicts, tuple(problems))


def _read_all(reader: FrameReader, problems: list[str]) -> int:
    whole = 0
    for index, header in enumerate(reader.headers):
        try:
            pixels = reader.read(index)
        except TakeError as error:
            problems.append(str(error))
            continue
        if zlib.crc32(pixels.astype(pixels.dtype.newbyteorder("<")).tobytes()) != header.pixel_crc:
            problems.append(f"{reader.path}: frame {index}: pixels do not match their CRC")
            continue
        whole += 1
    return whole


def _check_ledger(take: Take, ledger: Ledger, problems: list[str]) -> None:
    where = take.folder / "ledger.csv"
    if ledger.devices != take.device_names or ledger.triggers != take.manifest.frame_count:
        problems.append(
            f"{where}: expected {take.manifest.frame_count} triggers x "
            f"{len(take.device_names)} devices, found {ledger.triggers} x {len(ledger.devices)}"
        )


def _check_device(reader: FrameReader, device: str, ledger: Ledger, problems: list[str]) -> None:
    if device not in ledger.devices:
        return
    there = {header.trigger_index for header in reader.headers if header.status == 0}
    good = {
        e.trigger_index for e in ledger.entries if e.device == device and e.verdict == Verdict.OK
    }
    for k in sorted(good - there):
        problems.append(f"{reader.path}: the ledger has frame {k} of {device}, the file has not")
    for k in sorted(there - good):
        problems.append(f"{reader.path}: the file has frame {k} of {device}, the ledger has not")
