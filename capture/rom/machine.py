"""The state machine of a session: a pure function of state and event. It has no clock, no thread.

::

    IDLE -> PREFLIGHT -> ARMED -> COUNTDOWN -> RECORD -> DRAIN -> ARMED, the next prompt
                                                           `-> each take: check, decision

Every event has an answer in every stage: a new state, or a refusal with a sentence. A take is never
dropped for a small defect, and no defect is hidden: what is red waits for a decision.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from capture.judgement import Colour
from capture.live_take import TakePhase
from capture.rom.decisions import decide, judged_anew, superseded
from capture.rom.events import (
    DevicesLost,
    DiskLeft,
    Event,
    Key,
    KeyPressed,
    PreflightDone,
    TakeChecked,
    TakeFailed,
    TakeJudged,
    TakeNotStarted,
    TakeStarted,
    TakeWritten,
    Tick,
)
from capture.rom.shot_list import Prompt, PromptList
from capture.rom.state import PreflightState, RomState, Stage, Step, TakeState, Task
from capture.rom.words import listed, no_room

_MAY_MOVE = (Stage.IDLE, Stage.PREFLIGHT, Stage.ARMED, Stage.DRAIN)
_DECISIONS = (Key.KEEP, Key.FLAG, Key.RETAKE, Key.OVERRULE)


@dataclass(frozen=True, kw_only=True)
class Machine:
    """The rules of a session.

    Attributes:
        prompts: what is to be recorded.
        keep_green: whether a green take that was read back whole is kept without a key.
        late_s: how long after its planned end, post-roll included, a take may stay open.
    """

    prompts: PromptList
    keep_green: bool = True
    late_s: float = 3.0

    def step(self, state: RomState, event: Event) -> Step:
        """What an event leads to."""
        match event:
            case KeyPressed():
                return self._key(state, event)
            case Tick():
                return self._tick(state, event)
            case PreflightDone():
                return self._preflight_done(state, event)
            case TakeStarted():
                return self._take_started(state, event)
            case TakeNotStarted():
                return self._take_not_started(state, event)
            case DevicesLost():
                return self._devices_lost(state, event)
            case DiskLeft():
                return self._disk_left(state, event)
            case _:
                return self._take_news(state, event)

    def prompt(self, state: RomState) -> Prompt:
        """The present prompt."""
        return self.prompts.prompts[state.place]

    def _key(self, state: RomState, event: KeyPressed) -> Step:
        if event.key == Key.OVERRULE and state.stage == Stage.PREFLIGHT and not event.take:
            return self._overrule_preflight(state, event)
        if event.key in _DECISIONS:
            return decide(self.prompts, state, event)
        match event.key:
            case Key.ARM:
                return self._arm(state, event)
            case Key.DISARM:
                return self._disarm(state, event)
            case Key.GO:
                return self._go(state, event)
            case Key.ABORT:
                return self._abort(state, event)
            case Key.STOP:
                return self._stop(state, event)
            case _:
                return self._move(state, event)

    def _arm(self, state: RomState, event: KeyPressed) -> Step:
        if state.stage in (Stage.COUNTDOWN, Stage.RECORD, Stage.DRAIN):
            return Step(state, refusal="The array is armed already.")
        if state.stage == Stage.PREFLIGHT and state.preflight is None:
            return Step(state, refusal="The array is being checked; wait for the answer.")
        if state.takes_left < 1:
            return Step(state, refusal=no_room())
        checking = replace(state, stage=Stage.PREFLIGHT, since_s=event.at_s, preflight=None)
        return Step(checking, (Task.START,))

    def _disarm(self, state: RomState, event: KeyPressed) -> Step:
        if state.stage == Stage.IDLE:
            return Step(state, refusal="The devices are stopped already.")
        if state.stage == Stage.DRAIN:
            return Step(state, refusal=f"{state.current} is being written; wait a moment.")
        if state.stage == Stage.RECORD:
            return self._give_up(state, event)
        return Step(replace(state, stage=Stage.IDLE, since_s=event.at_s), (Task.STOP,))

    def _give_up(self, state: RomState, event: KeyPressed) -> Step:
        """The way out when a take does not end although it was closed."""
        overdue_s = event.at_s - state.since_s - self.prompt(state).total_s
        take = state.take(state.current)
        if take is None or not state.closing or overdue_s < self.late_s:
            return Step(state, refusal=f"{_named(state)} is being recorded; stop it first.")
        failed = judged_anew(
            replace(take, phase=TakePhase.FAILED, problems=("It was closed and did not end.",))
        )
        after = replace(
            state.with_take(failed), stage=Stage.IDLE, since_s=event.at_s, current="",
            closing=False,
        )  # fmt: skip
        return Step(after, (Task.STOP,), ((Colour.RED, f"{take.name} did not end."),))

    def _go(self, state: RomState, event: KeyPressed) -> Step:
        refusal = {
            Stage.IDLE: "The array is not armed; arm it first.",
            Stage.PREFLIGHT: "The array is being checked; it is not armed yet."
            if state.preflight is None
            else "The preflight was red: check again, or overrule it with a reason.",
            Stage.COUNTDOWN: "The countdown is running.",
            Stage.RECORD: f"{_named(state)} is being recorded.",
            Stage.DRAIN: f"{state.current} is still being written; wait a moment.",
        }.get(state.stage, "")
        if not refusal:
            refusal = _not_recordable(state)
        if refusal:
            return Step(state, refusal=refusal)
        return Step(replace(state, stage=Stage.COUNTDOWN, since_s=event.at_s))

    def _abort(self, state: RomState, event: KeyPressed) -> Step:
        if state.stage != Stage.COUNTDOWN:
            return Step(state, refusal="No countdown is running.")
        return Step(replace(state, stage=Stage.ARMED, since_s=event.at_s))

    def _stop(self, state: RomState, event: KeyPressed) -> Step:
        if state.stage == Stage.COUNTDOWN:
            return self._abort(state, event)
        if state.stage != Stage.RECORD:
            return Step(state, refusal="Nothing is being recorded.")
        if not state.current:
            return Step(state, refusal="The take is just beginning; try again.")
        if state.closing:
            return Step(state, refusal=f"{state.current} is being closed already.")
        return Step(replace(state, closing=True), (Task.CLOSE,))

    def _move(self, state: RomState, event: KeyPressed) -> Step:
        if state.stage == Stage.COUNTDOWN:
            return Step(state, refusal="The countdown is running; abort it first.")
        if state.stage not in _MAY_MOVE:
            return Step(state, refusal=f"{_named(state)} is being recorded; stop it first.")
        if event.key == Key.SKIP:
            return self._skip(state)
        place, refusal = self._wanted_place(state, event)
        if refusal:
            return Step(state, refusal=refusal)
        return Step(replace(state, place=place, advance=False))

    def _wanted_place(self, state: RomState, event: KeyPressed) -> tuple[int, str]:
        if event.key == Key.JUMP:
            if event.slate in self.prompts.slates:
                return self.prompts.slates.index(event.slate), ""
            return 0, f"No prompt has the slate {event.slate!r}."
        if event.key == Key.NEXT:
            last = state.place == len(self.prompts.prompts) - 1
            return state.place + 1, "This is the last prompt." if last else ""
        return state.place - 1, "" if state.place else "This is the first prompt."

    def _skip(self, state: RomState) -> Step:
        slate = self.prompt(state).slate
        if slate in state.done:
            return Step(state, refusal=f"{slate} has a good take already; go to the next prompt.")
        after = replace(
            state,
            skipped=state.skipped | {slate},
            place=min(state.place + 1, len(self.prompts.prompts) - 1),
            advance=False,
        )
        return Step(after, told=((Colour.AMBER, f"{slate} is left out."),))

    def _tick(self, state: RomState, event: Tick) -> Step:
        elapsed_s = event.at_s - state.since_s
        if state.stage == Stage.COUNTDOWN and elapsed_s >= self.prompt(state).countdown_s:
            recording = replace(
                state, stage=Stage.RECORD, since_s=event.at_s, current="", closing=False,
                advance=False,
            )  # fmt: skip
            return Step(recording, (Task.RECORD,))
        if state.stage != Stage.RECORD or elapsed_s < self.late_s:
            return Step(state)
        if not state.current:
            return self._ended(state, event.at_s, (Colour.RED, "The take did not start."))
        if not state.closing and elapsed_s > self.prompt(state).total_s + self.late_s:
            text = f"{state.current} should have ended; it is being closed."
            return Step(replace(state, closing=True), (Task.CLOSE,), ((Colour.AMBER, text),))
        return Step(state)

    def _preflight_done(self, state: RomState, event: PreflightDone) -> Step:
        if state.stage != Stage.PREFLIGHT or state.preflight is not None:
            return Step(state, refusal="No check was asked for.")
        done = PreflightState(
            colour=event.colour, sentence=event.sentence, streaming=event.streaming
        )
        after = replace(state, preflight=done, since_s=event.at_s)
        told = ((event.colour, event.sentence),)
        if not event.streaming:
            return Step(replace(after, stage=Stage.IDLE), (Task.STOP,), told)
        if state.takes_left < 1:
            return Step(after, told=(*told, (Colour.RED, no_room())))
        if event.colour == Colour.RED:
            return Step(after, told=told)
        return Step(replace(after, stage=Stage.ARMED), told=told)

    def _overrule_preflight(self, state: RomState, event: KeyPressed) -> Step:
        reason = event.reason.strip()
        if state.preflight is None:
            return Step(state, refusal="The array is being checked; wait for the answer.")
        if state.takes_left < 1:
            return Step(state, refusal=no_room())
        if not reason:
            return Step(state, refusal="Overruling the preflight needs a reason.")
        after = replace(
            state, stage=Stage.ARMED, since_s=event.at_s,
            preflight=replace(state.preflight, reason=reason),
        )  # fmt: skip
        text = f"The preflight was {state.preflight.colour} and is overruled: {reason}"
        return Step(after, told=((Colour.AMBER, text),))

    def _take_started(self, state: RomState, event: TakeStarted) -> Step:
        if state.stage != Stage.RECORD or state.current:
            return Step(state, refusal="No take was asked for.")
        if state.take(event.take) is not None:
            return Step(state, refusal=f"There is a take {event.take} already.")
        slate = self.prompt(state).slate
        take = TakeState(
            name=event.take, slate=slate, number=event.number, phase=TakePhase.RECORDING
        )
        after = replace(
            superseded(state, slate).with_take(take), since_s=event.at_s, current=event.take,
            skipped=state.skipped - {slate},
        )  # fmt: skip
        return Step(after)

    def _take_not_started(self, state: RomState, event: TakeNotStarted) -> Step:
        if state.stage != Stage.RECORD or state.current:
            return Step(state, refusal="No take was asked for.")
        return self._ended(state, event.at_s, (Colour.RED, f"Nothing recorded: {event.error}"))

    def _take_news(
        self, state: RomState, event: TakeJudged | TakeWritten | TakeChecked | TakeFailed
    ) -> Step:
        take = state.take(event.take)
        if take is None:
            return Step(state, refusal=f"There is no take {event.take!r}.")
        match event:
            case TakeJudged() if take.phase == TakePhase.RECORDING:
                return self._judged(state, take, event)
            case TakeWritten() if take.phase == TakePhase.DRAINING:
                return self._written(state, take, event)
            case TakeChecked() if take.phase == TakePhase.CHECKING:
                return self._checked(state, take, event)
            case TakeFailed() if take.phase not in (TakePhase.DONE, TakePhase.FAILED):
                return self._failed(state, take, event)
            case _:
                return Step(state, refusal=f"{take.name} is {take.phase} already.")

    def _judged(self, state: RomState, take: TakeState, event: TakeJudged) -> Step:
        judged = replace(
            take, phase=TakePhase.DRAINING, colour=event.colour, sentence=event.sentence,
            cut=state.closing,
        )  # fmt: skip
        after = replace(
            state.with_take(judged), stage=Stage.DRAIN, since_s=event.at_s, closing=False,
            advance=event.colour != Colour.RED and not state.closing,
        )  # fmt: skip
        told = [(event.colour, f"{take.name}: {event.sentence}")]
        if judged.cut and event.colour != Colour.RED:
            told.append((Colour.AMBER, f"{take.name} was closed early: keep it, or go again."))
        return Step(after, told=tuple(told))

    def _written(self, state: RomState, take: TakeState, event: TakeWritten) -> Step:
        written = judged_anew(
            replace(take, phase=TakePhase.CHECKING, colour=event.colour, sentence=event.sentence)
        )
        after = state.with_take(written)
        told = None
        if event.colour != take.colour:
            told = (event.colour, f"{take.name}: {event.sentence}")
            after = replace(after, advance=after.advance and event.colour != Colour.RED)
        if take.name == state.current:
            return self._ended(after, event.at_s, told)
        return Step(after, told=() if told is None else (told,))

    def _checked(self, state: RomState, take: TakeState, event: TakeChecked) -> Step:
        done = judged_anew(
            replace(take, phase=TakePhase.DONE, problems=event.problems),
            keep_green=self.keep_green,
        )
        told: tuple[tuple[Colour, str], ...] = ()
        if event.problems:
            text = f"{take.name} was not read back whole: {listed(event.problems)}"
            told = ((Colour.RED, text),)
        return Step(state.with_take(done), told=told)

    def _failed(self, state: RomState, take: TakeState, event: TakeFailed) -> Step:
        failed = judged_anew(replace(take, phase=TakePhase.FAILED, problems=(event.error,)))
        after = state.with_take(failed)
        told = (Colour.RED, f"{take.name} failed: {event.error}")
        if take.name == state.current:
            return self._ended(replace(after, advance=False), event.at_s, told)
        return Step(after, told=(told,))

    def _ended(self, state: RomState, at_s: float, told: tuple[Colour, str] | None = None) -> Step:
        """Armed again, at the next prompt when the take allows it."""
        last = state.place == len(self.prompts.prompts) - 1
        after = replace(
            state,
            stage=Stage.ARMED,
            since_s=at_s,
            current="",
            closing=False,
            advance=False,
            place=state.place + (state.advance and not last),
        )
        lines = [] if told is None else [told]
        if state.advance and last:
            lines.append((Colour.GREEN, "That was the last prompt."))
        return Step(after, told=tuple(lines))

    def _devices_lost(self, state: RomState, event: DevicesLost) -> Step:
        gone = [name for name in event.devices if name not in state.lost]
        back = [name for name in state.lost if name not in event.devices]
        after = replace(state, lost=event.devices)
        lines = []
        if gone:
            lines.append((Colour.RED, f"Lost: {', '.join(gone)}."))
        if back and state.stage not in (Stage.IDLE, Stage.PREFLIGHT):
            lines.append((Colour.GREEN, f"Back: {', '.join(back)}."))
        if event.devices and state.stage == Stage.COUNTDOWN:
            after = replace(after, stage=Stage.ARMED, since_s=event.at_s)
            lines.append((Colour.AMBER, "The countdown was ended; nothing was recorded."))
        return Step(after, told=tuple(lines))

    def _disk_left(self, state: RomState, event: DiskLeft) -> Step:
        after = replace(state, takes_left=event.takes)
        if event.takes >= 1 or state.takes_left < 1:
            return Step(after)
        lines = [(Colour.RED, no_room())]
        if state.stage == Stage.COUNTDOWN:
            after = replace(after, stage=Stage.ARMED, since_s=event.at_s)
            lines.append((Colour.AMBER, "The countdown was ended; nothing was recorded."))
        return Step(after, told=tuple(lines))


def _named(state: RomState) -> str:
    return state.current or "A take"


def _not_recordable(state: RomState) -> str:
    """Why nothing can be recorded though the array is armed, or ""."""
    if state.takes_left < 1:
        return no_room()
    if state.lost:
        return (
            f"{listed(state.lost)} {'is' if len(state.lost) == 1 else 'are'} lost: wait, or "
            "disarm and take what is broken out of the array."
        )
    return ""
