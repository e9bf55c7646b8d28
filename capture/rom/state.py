"""In which state a session stands; nothing here changes, a step makes a new one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

from capture.judgement import Colour
from capture.live_take import TakePhase
from capture.take_notes import Overrule, TakeStatus


class Stage(StrEnum):
    """Where the session is. Takes are checked in the background, whatever the stage."""

    IDLE = "idle"  # the devices are stopped
    PREFLIGHT = "preflight"  # they are being started and checked, or the check was red
    ARMED = "armed"  # they stream; the prompt is shown
    COUNTDOWN = "countdown"
    RECORD = "record"
    DRAIN = "drain"  # the take is over, its frames are being written


@dataclass(frozen=True, kw_only=True)
class TakeState:
    """One take of the session.

    Attributes:
        name: of its folder: slate and number.
        slate: of its prompt.
        number: from 1, within its slate.
        phase: how far it has come.
        colour: its verdict; None while it is being recorded.
        sentence: why.
        problems: what reading it back, or the failure, found; one line each.
        status: what was decided.
        decided_by: "operator" or "machine"; empty while undecided.
        overruled: the verdict that the operator did not follow, or None.
        cut: whether it was closed before its end; it is then not kept without a key.
    """

    name: str
    slate: str
    number: int
    phase: TakePhase
    colour: Colour | None = None
    sentence: str = ""
    problems: tuple[str, ...] = ()
    status: TakeStatus = TakeStatus.UNDECIDED
    decided_by: str = ""
    overruled: Overrule | None = None
    cut: bool = False

    @property
    def shown_colour(self) -> Colour | None:
        """The verdict; red when it failed or was not read back whole."""
        return Colour.RED if self.problems or self.phase == TakePhase.FAILED else self.colour

    @property
    def shown_sentence(self) -> str:
        """Why it has that colour; problems first."""
        return " ".join([*self.problems, self.sentence]).strip()


@dataclass(frozen=True, kw_only=True)
class PreflightState:
    """How the last preflight ended.

    Attributes:
        colour: the worst of its findings.
        sentence: the worst finding.
        streaming: whether the devices deliver frames.
        reason: why the operator armed all the same; empty when nothing was overruled.
    """

    colour: Colour
    sentence: str
    streaming: bool
    reason: str = ""


@dataclass(frozen=True, kw_only=True)
class RomState:
    """A session at one instant.

    Attributes:
        stage: where it is.
        place: number of the prompt, from 0.
        since_s: when the stage began.
        takes: in the order they were recorded.
        current: name of the take in RECORD or DRAIN; empty when none has started.
        closing: whether the operator has stopped it.
        advance: whether the next prompt follows once it is written.
        skipped: slates left out.
        lost: devices that deliver nothing.
        takes_left: takes that the disk has room for.
        preflight: how it ended; None while it runs or before the first.
    """

    stage: Stage = Stage.IDLE
    place: int = 0
    since_s: float = 0.0
    takes: tuple[TakeState, ...] = ()
    current: str = ""
    closing: bool = False
    advance: bool = False
    skipped: frozenset[str] = frozenset()
    lost: tuple[str, ...] = ()
    takes_left: int = 1
    preflight: PreflightState | None = None

    def take(self, name: str) -> TakeState | None:
        """The take of that name, or None."""
        return next((take for take in self.takes if take.name == name), None)

    def with_take(self, take: TakeState) -> RomState:
        """The state with a take in place of the one of that name, or added."""
        if self.take(take.name) is None:
            return replace(self, takes=(*self.takes, take))
        changed = tuple(take if old.name == take.name else old for old in self.takes)
        return replace(self, takes=changed)

    @property
    def done(self) -> frozenset[str]:
        """Slates that have a take which was kept or flagged."""
        good = (TakeStatus.KEEP, TakeStatus.FLAG)
        return frozenset(take.slate for take in self.takes if take.status in good)

    @property
    def undecided(self) -> tuple[TakeState, ...]:
        """Takes that nothing was decided about yet, the one being recorded left out."""
        return tuple(
            take
            for take in self.takes
            if take.status == TakeStatus.UNDECIDED and take.phase != TakePhase.RECORDING
        )


class Task(StrEnum):
    """What a step asks its driver to do."""

    START = "start"  # the devices, and check them: answer with PreflightDone
    STOP = "stop"  # the devices
    RECORD = "record"  # the prompt: answer with TakeStarted or TakeNotStarted
    CLOSE = "close"  # the window of the take


@dataclass(frozen=True)
class Step:
    """What an event led to.

    Attributes:
        state: the state after it.
        tasks: what the driver must do.
        told: what the operator should know: how grave, and one sentence.
        refusal: why nothing was done; empty when the event was taken.
    """

    state: RomState
    tasks: tuple[Task, ...] = ()
    told: tuple[tuple[Colour, str], ...] = ()
    refusal: str = ""
