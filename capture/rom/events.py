"""What can happen in a session: keys, time, news of takes, devices and disk.

Every event carries the time it happened, `at_s`, by one clock that never goes back.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from capture.judgement import Colour


class Key(StrEnum):
    """What the operator can ask for; a front end chooses the keys of the keyboard."""

    ARM = "arm"  # start the devices and check them
    DISARM = "disarm"  # stop the devices
    GO = "go"  # count down and record the prompt
    ABORT = "abort"  # end the countdown
    STOP = "stop"  # close the take now; what was exposed is kept
    KEEP = "keep"
    FLAG = "flag"  # keep it, somebody must look at it
    RETAKE = "retake"  # and go back to its prompt
    OVERRULE = "overrule"  # keep it, or arm, against the verdict; needs a reason
    NEXT = "next"
    PREVIOUS = "previous"
    JUMP = "jump"  # to a slate
    SKIP = "skip"  # leave the prompt out


@dataclass(frozen=True, kw_only=True)
class KeyPressed:
    """The operator asks for something.

    Attributes:
        key: what for.
        slate: of the prompt, for JUMP.
        take: by name, for KEEP, FLAG, RETAKE and OVERRULE; empty: the latest, or for OVERRULE in
            preflight the preflight.
        reason: for OVERRULE.
    """

    at_s: float
    key: Key
    slate: str = ""
    take: str = ""
    reason: str = ""


@dataclass(frozen=True, kw_only=True)
class Tick:
    """Time has passed."""

    at_s: float


@dataclass(frozen=True, kw_only=True)
class PreflightDone:
    """The devices were started and checked.

    Attributes:
        colour: the worst of the findings.
        sentence: the worst finding.
        streaming: whether the devices deliver frames; without that nothing can be armed.
    """

    at_s: float
    colour: Colour
    sentence: str
    streaming: bool = True


@dataclass(frozen=True, kw_only=True)
class TakeStarted:
    """The window of the take that was asked for is open."""

    at_s: float
    take: str
    number: int


@dataclass(frozen=True, kw_only=True)
class TakeNotStarted:
    """The take that was asked for could not be started."""

    at_s: float
    error: str


@dataclass(frozen=True, kw_only=True)
class TakeJudged:
    """The window of a take is closed, and its ledger is known."""

    at_s: float
    take: str
    colour: Colour
    sentence: str


@dataclass(frozen=True, kw_only=True)
class TakeWritten:
    """All frames of a take are on disk; its verdict is final: some may not have been written."""

    at_s: float
    take: str
    colour: Colour
    sentence: str


@dataclass(frozen=True, kw_only=True)
class TakeChecked:
    """A take was read back; `problems` is empty when it is sound."""

    at_s: float
    take: str
    problems: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class TakeFailed:
    """A take could not be recorded, written or read back to the end."""

    at_s: float
    take: str
    error: str


@dataclass(frozen=True, kw_only=True)
class DevicesLost:
    """Which devices deliver nothing now; empty when all do again."""

    at_s: float
    devices: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class DiskLeft:
    """How many takes the disk has room for."""

    at_s: float
    takes: int


Event = (
    KeyPressed | Tick | PreflightDone | TakeStarted | TakeNotStarted | TakeJudged | TakeWritten
    | TakeChecked | TakeFailed | DevicesLost | DiskLeft
)  # fmt: skip
