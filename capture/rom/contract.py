"""What the conductor needs of an array and of a take; `capture.live` has both."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from capture.device_watch import DeviceState
from capture.devices.capabilities import Health
from capture.judgement import Judgement
from capture.live_take import TakePhase
from capture.recorder import Recording
from capture.session import Session, Shot
from capture.verify import VerifyReport


class RunningTake(Protocol):
    """What the conductor needs of a `LiveTake`; attributes are read at any time."""

    @property
    def number(self) -> int:
        """From 1, within the slate."""

    @property
    def folder(self) -> Path:
        """Where it will stand once it is done."""

    @property
    def phase(self) -> TakePhase:
        """How far it has come."""

    @property
    def fraction(self) -> float:
        """Of the present phase, 0 to 1."""

    @property
    def judgement(self) -> Judgement | None:
        """The verdict, once the phase is past RECORDING; final once it is past DRAINING."""

    @property
    def recording(self) -> Recording | None:
        """Ledger and clocks; from the same moment."""

    @property
    def check(self) -> VerifyReport | None:
        """What reading it back found, once DONE."""

    @property
    def error(self) -> str:
        """What went wrong, once FAILED."""

    def stop(self) -> None:
        """Close the window now."""

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until it is DONE or FAILED; False when that took too long."""


class StreamingArray(Protocol):
    """What the conductor needs of a `LiveArray`."""

    @property
    def trouble(self) -> str:
        """Why streaming ended by itself; empty while all is well."""

    def start(self) -> None:
        """Start the devices; raises DeviceError."""

    def stop(self) -> None:
        """Finish the takes that are being written, and stop the devices."""

    def record(self, session: Session, shot: Shot) -> RunningTake:
        """Open the window of a take now; returns at once."""

    def states(self) -> tuple[DeviceState, ...]:
        """How each device fares."""

    def health(self) -> Mapping[str, Health]:
        """What each device said of itself last, by name; some can say nothing."""

    def reconnect(self, name: str) -> None:
        """Find a lost device again while the others go on; raises DeviceError, TakeError."""
