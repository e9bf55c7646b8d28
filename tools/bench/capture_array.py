"""Sixteen simulated devices at full rate: lost frame sets, CPU, memory, speed of reading back."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from capture.devices.simulated import streaming_array
from capture.errors import WorkError
from capture.frame_header import ImageLayout
from capture.live import LiveArray
from capture.live_take import LiveTake, TakePhase
from capture.recorder import RecordSettings
from capture.session import Session, Shot


@dataclass(frozen=True)
class ArrayRun:
    """What a recording of simulated devices cost.

    Attributes:
        seconds: recorded.
        frame_sets: how many triggers.
        lost: frame sets that are not complete.
        cores: CPU seconds a second while recording; the simulation, collation, CRC and writing.
        idle_cores: the same while the array streams and nothing is written.
        verify_ratio: time to read the take back, CRC and SHA-256, over the time it took to record.
        drain_s: from the end of the window until all was written.
        memory_share: the most of a device's memory that was ever in use; of one look a second.
        mb_per_s: written.
        devices: how many.
    """

    seconds: float
    frame_sets: int
    lost: int
    cores: float
    idle_cores: float
    verify_ratio: float
    drain_s: float
    memory_share: float
    mb_per_s: float
    devices: int

    def lines(self) -> list[str]:
        """What was found, in words."""
        return [
            f"{self.devices} devices, 75 Hz, {self.seconds:.0f} s: {self.lost} of "
            f"{self.frame_sets} frame sets lost, {self.mb_per_s:.0f} MB/s, {self.cores:.2f} cores "
            f"(streaming alone {self.idle_cores:.2f})",
            f"written {self.drain_s:.2f} s after the last trigger, at most "
            f"{self.memory_share:.0%} of the memory in use; read back, CRC and SHA-256, in "
            f"{self.verify_ratio:.2f} of the time it took to record",
        ]


def record_array(devices: int, layout: ImageLayout, seconds: float, folder: Path) -> ArrayRun:
    """Record one take of simulated devices in real time, 75 triggers a second."""
    settings = RecordSettings(pre_roll=38, post_roll=38)
    session = Session.create(folder / "session")
    with LiveArray(streaming_array(devices, layout), settings) as live:
        idle_cores = _cores(3.0)
        frames = round(seconds * settings.rate_hz)
        began, cpu, high = time.monotonic(), time.process_time(), 0
        take = live.record(session, Shot(slate="bench", kind="expression", frames=frames))
        while take.phase == TakePhase.RECORDING:
            high = max(high, *(state.taken for state in live.states()))
            time.sleep(0.05)
        over = time.monotonic()
        cores = (time.process_time() - cpu) / (over - began)
        while take.phase == TakePhase.DRAINING:
            time.sleep(0.001)
        checked = time.monotonic()
        _finished(take)
        check_s = time.monotonic() - checked
    if take.recording is None:
        raise WorkError(f"{take.name}: no ledger")
    ledger = take.recording.ledger
    recorded_s = ledger.triggers / settings.rate_hz
    return ArrayRun(
        seconds=recorded_s,
        frame_sets=ledger.triggers,
        lost=len(ledger.incomplete()),
        cores=cores,
        idle_cores=idle_cores,
        verify_ratio=check_s / recorded_s,
        drain_s=checked - over,
        memory_share=high / settings.ring_frames,
        mb_per_s=devices * layout.nbytes * settings.rate_hz / 1e6,
        devices=devices,
    )


def session_memory(devices: int, layout: ImageLayout, takes: int, folder: Path) -> list[float]:
    """Resident memory, MB, before the first take and after each of many in one session."""
    settings = RecordSettings(pre_roll=38, post_roll=38)
    session = Session.create(folder / "long")
    resident = []
    with LiveArray(streaming_array(devices, layout), settings) as live:
        time.sleep(1.0)
        resident.append(resident_mb())
        for number in range(takes):
            shot = Shot(slate=f"shot{number:03d}", kind="expression", frames=150)
            _finished(live.record(session, shot))
            resident.append(resident_mb())
    return resident


def resident_mb() -> float:
    """Resident memory of this process, MB."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * 4096 / 1e6


def _finished(take: LiveTake) -> None:
    take.wait()
    if take.phase != TakePhase.DONE:
        raise WorkError(f"{take.name}: {take.error}")


def _cores(seconds: float) -> float:
    began, cpu = time.monotonic(), time.process_time()
    time.sleep(seconds)
    return (time.process_time() - cpu) / (time.monotonic() - began)
