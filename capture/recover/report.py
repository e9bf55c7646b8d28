"""What recovery found and did, device by device."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

from capture.ledger import Verdict

_NAMED = 6  # numbers in a sentence


class Outcome(StrEnum):
    """What became of a folder."""

    SETTLED = "settled"  # it is a take under its own name now
    NOTHING = "nothing to do"  # it was one already
    BUSY = "busy"  # another process records or recovers it
    EMPTY = "empty"  # no whole frame in it; it stays as it is
    FAILED = "failed"  # `reason` says why; it stays, and can be recovered later


class FileMend(StrEnum):
    """What a device's file needed."""

    WHOLE = "whole"  # nothing: it had been closed
    COMPLETED = "completed"  # its torn end cut, its summary written behind the last whole frame
    REBUILT = "rebuilt"  # its whole frames copied to a new file; the old one stands in `damaged/`
    MADE = "made"  # there was none: an empty one


@dataclass(frozen=True, kw_only=True)
class DeviceRecovery:
    """What became of the frames of one device.

    Attributes:
        name: of the device.
        mend: what its file needed.
        frames: how many were saved.
        damaged: trigger indices of frames that were written and are damaged.
        damaged_unknown: how many more are damaged, so that nobody can tell their trigger.
        torn: trigger index of the frame that was being written; None when none was, or when too
            little of it is there to tell.
        dropped_bytes: bytes of the file that belong to no whole frame.
    """

    name: str
    mend: FileMend
    frames: int
    damaged: tuple[int, ...] = ()
    damaged_unknown: int = 0
    torn: int | None = None
    dropped_bytes: int = 0

    @property
    def losses(self) -> str:
        """What is lost, in plain words; empty when nothing is."""
        parts = []
        if self.damaged:
            parts.append(f"damaged on the disk: frame {_numbers(self.damaged)}")
        if self.damaged_unknown:
            parts.append(f"damaged beyond telling which: {self.damaged_unknown} frames")
        if self.torn is not None:
            parts.append(f"torn while it was written: frame {self.torn}")
        if self.mend == FileMend.MADE:
            parts.append("its file is not there")
        if self.dropped_bytes:
            parts.append(f"{self.dropped_bytes} bytes dropped")
        return ", ".join(parts)


@dataclass(frozen=True, kw_only=True)
class TakeRecovery:
    """What became of one folder.

    Attributes:
        folder: where it stands now.
        outcome: what became of it.
        reason: why, when it is not settled; problems that reading it back found.
        devices: what became of each device's frames, in the take's order.
        frame_count: triggers of the take.
        planned: how many were to be recorded; None when nobody knows.
        verdicts: how often each verdict stands in the ledger.
        remade: which of the take's files had to be made from the frames.
    """

    folder: Path
    outcome: Outcome
    reason: str = ""
    devices: tuple[DeviceRecovery, ...] = ()
    frame_count: int = 0
    planned: int | None = None
    verdicts: dict[Verdict, int] = field(default_factory=dict)
    remade: tuple[str, ...] = ()

    @property
    def sentence(self) -> str:
        """In plain words, for the operator."""
        if self.outcome != Outcome.SETTLED:
            return f"{self.folder.name}: {self.outcome}{': ' if self.reason else ''}{self.reason}"
        saved = sum(device.frames for device in self.devices)
        planned = "" if self.planned in (None, self.frame_count) else f" of {self.planned} planned"
        head = (
            f"{self.folder.name}: saved {saved} frames of {len(self.devices)} devices, "
            f"{self.frame_count}{planned} triggers"
        )
        said = [f"{d.name}: {d.losses}" for d in self.devices if d.losses]
        if self.reason:
            said.append(self.reason)
        return "; ".join([head, *said])

    def document(self) -> dict[str, Any]:
        """All of it as plain values."""
        return {
            "take": str(self.folder),
            "outcome": str(self.outcome),
            "sentence": self.sentence,
            "frame_count": self.frame_count,
            "planned": self.planned,
            "devices": [asdict(device) for device in self.devices],
            "verdicts": {str(kind): count for kind, count in self.verdicts.items()},
            "remade": list(self.remade),
        }


def _numbers(numbers: Iterable[int]) -> str:
    listed = sorted(numbers)
    rest = f" and {len(listed) - _NAMED} more" if len(listed) > _NAMED else ""
    return ", ".join(str(number) for number in listed[:_NAMED]) + rest
