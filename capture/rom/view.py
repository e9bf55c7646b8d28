"""What a front end draws. A `View` never changes; the conductor makes a new one when asked."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from capture.device_watch import DeviceState
from capture.disk import DiskForecast
from capture.judgement import Colour
from capture.live_take import TakePhase
from capture.preflight.finding import Finding
from capture.rom.events import Key
from capture.rom.shot_list import Prompt
from capture.rom.state import PreflightState, Stage
from capture.take_notes import OperatorNote


class Cue(StrEnum):
    """What the talent does in this instant."""

    NONE = ""  # nothing is being recorded
    READY = "ready"  # countdown
    NEUTRAL = "neutral"  # before the hold, still moving into it
    HOLD = "hold"
    RELAX = "relax"  # after the hold, back to neutral


@dataclass(frozen=True, kw_only=True)
class Message:
    """One line for the operator.

    Attributes:
        at_s: when, by the conductor's clock.
        colour: green for news, amber for a warning or a refusal, red for a loss.
        text: one sentence.
    """

    at_s: float
    colour: Colour
    text: str


@dataclass(frozen=True, kw_only=True)
class TakeView:
    """One take, for the list.

    Attributes:
        name: of its folder.
        slate: of its prompt.
        number: from 1, within its slate.
        phase: how far it has come.
        fraction: of the present phase, 0 to 1.
        colour: the verdict; None while it is being recorded.
        sentence: why.
        note: status, rating, text and overruled verdict.
        superseded: whether a later take of the slate is there.
    """

    name: str
    slate: str
    number: int
    phase: TakePhase
    fraction: float
    colour: Colour | None
    sentence: str
    note: OperatorNote
    superseded: bool


@dataclass(frozen=True, kw_only=True)
class PromptView:
    """One line of the shot list.

    Attributes:
        prompt: the prompt.
        takes: how many takes there are.
        status: "" nothing yet, "current", "skipped", or the status of its latest take that does not
            say retake; "retake" when all say so.
        colour: the verdict of that take, or None.
    """

    prompt: Prompt
    takes: int
    status: str
    colour: Colour | None


@dataclass(frozen=True, kw_only=True)
class View:
    """All a front end needs to draw one picture.

    Attributes:
        at_s: when, by the conductor's clock.
        session: its name.
        list_title: the title of the shot list.
        stage: where the session is.
        headline: what is going on and what to do, one sentence.
        place: number of the prompt, from 0, of `prompts`.
        prompts: the whole list.
        prompt: the present one.
        next_prompt: the one after it, or None at the end.
        countdown: the number to show, whole seconds left, at least 1; None outside the countdown.
        cue: what the talent does now.
        fraction: of the take, 0 to 1; 0 outside RECORD.
        hold_fraction: of the hold, 0 before it, 1 after it.
        takes: in the order they were recorded.
        current: the take being recorded or written; otherwise the latest; None before the first.
        undecided: names of takes that wait for a decision.
        devices: how each device fares.
        disk: how long the disk lasts; None before it was looked at.
        preflight: how it ended, or None.
        findings: of the last preflight, the worst first.
        messages: the latest last.
        offers: what the operator may ask for now without being refused; JUMP and OVERRULE are
            offered when some slate, or some reason, would be taken.
        finished: whether every prompt has a take that was kept or flagged, or is skipped.
    """

    at_s: float
    session: str
    list_title: str
    stage: Stage
    headline: str
    place: int
    prompts: tuple[PromptView, ...]
    prompt: Prompt
    next_prompt: Prompt | None
    countdown: int | None
    cue: Cue
    fraction: float
    hold_fraction: float
    takes: tuple[TakeView, ...]
    current: TakeView | None
    undecided: tuple[str, ...]
    devices: tuple[DeviceState, ...]
    disk: DiskForecast | None
    preflight: PreflightState | None
    findings: tuple[Finding, ...]
    messages: tuple[Message, ...]
    offers: frozenset[Key]
    finished: bool
