"""The disk that frames are written to, and one that fails on request while an array streams."""

from __future__ import annotations

import errno
import os
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Protocol

from capture.errors import SettingsError


class Disk(Protocol):
    """Where frames are written."""

    def writev(self, path: Path, handle: int, parts: Sequence[memoryview]) -> int:
        """Write some of the parts to an open file, in order.

        Args:
            path: of the file, for whoever tells files apart.
            handle: of the open file.
            parts: bytes, one behind the other.

        Returns:
            How many bytes were written.

        Raises:
            OSError: when the disk is full or fails.
        """


class RealDisk:
    """The disk of this machine."""

    def writev(self, path: Path, handle: int, parts: Sequence[memoryview]) -> int:
        """Write by the system's own call."""
        return os.writev(handle, parts)


class DiskFaultKind(StrEnum):
    """What can go wrong at one write."""

    SLOW = "slow"  # it takes `seconds` longer
    FULL = "full"  # there is no space
    TORN = "torn"  # half of it is written, then the disk fails


@dataclass(frozen=True)
class DiskFault:
    """One thing that goes wrong.

    Attributes:
        kind: what.
        device: whose file is hit; empty: whichever is written next.
        writes: how many in a row.
        seconds: how much longer a slow one takes.
    """

    kind: DiskFaultKind
    device: str = ""
    writes: int = 1
    seconds: float = 0.0

    def __post_init__(self) -> None:
        if self.writes < 1 or not 0 <= self.seconds <= 60:
            raise SettingsError(
                "a disk fault hits 1 write or more and takes 0 to 60 s, "
                f"found {self.writes} and {self.seconds}"
            )


class SimulatedDisk(RealDisk):
    """A disk that fails on request; faults may be set from any thread while frames are written."""

    def __init__(self) -> None:
        """A disk that is well."""
        self._lock = threading.Lock()
        self._waiting: list[DiskFault] = []

    def inject(self, fault: DiskFault) -> None:
        """Let a fault hit the next writes that it names, after those set before."""
        with self._lock:
            self._waiting += [fault] * fault.writes

    def writev(self, path: Path, handle: int, parts: Sequence[memoryview]) -> int:
        """Write, or fail as the next fault says."""
        fault = self._next(path.name.partition(".mcap")[0])
        if fault is None:
            return super().writev(path, handle, parts)
        if fault.kind == DiskFaultKind.FULL:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if fault.kind == DiskFaultKind.TORN:
            whole = b"".join(parts)
            os.write(handle, whole[: len(whole) // 2])
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        time.sleep(fault.seconds)
        return super().writev(path, handle, parts)

    def _next(self, device: str) -> DiskFault | None:
        with self._lock:
            for place, fault in enumerate(self._waiting):
                if fault.device in ("", device):
                    return self._waiting.pop(place)
        return None
