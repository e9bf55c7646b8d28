"""Laws of the state machine, over random streams of events, sensible, stale and senseless."""

from __future__ import annotations

from random import Random

import pytest

from capture.judgement import Colour
from capture.live_take import TakePhase
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
from capture.rom.state import RomState, Stage, Step, Task
from capture.take_notes import TakeStatus
from tests.capture.rom.situations import MACHINE, SLATES

_ORDER = list(TakePhase)


class Source:
    """Events at random; half of them are what a real array would answer."""

    def __init__(self, seed: int) -> None:
        self.random, self.at_s, self.asked = Random(seed), 0.0, False

    def draw(self, state: RomState) -> Event:
        self.at_s += self.random.choice((0.05, 0.05, 0.5, 1.0, 4.0))
        return self._answer(state) if self.random.random() < 0.5 else self._anything(state)

    def _answer(self, state: RomState) -> Event:
        at_s, colour = self.at_s, self.random.choice(list(Colour))
        if state.stage == Stage.PREFLIGHT:
            streaming = self.random.random() < 0.9
            return PreflightDone(at_s=at_s, colour=colour, sentence="So.", streaming=streaming)
        if state.stage == Stage.RECORD and not state.current:
            slate = MACHINE.prompt(state).slate
            number = 1 + sum(take.slate == slate for take in state.takes)
            return TakeStarted(at_s=at_s, take=f"{slate}_{number:03d}", number=number)
        if state.stage == Stage.RECORD:
            return TakeJudged(at_s=at_s, take=state.current, colour=colour, sentence="So.")
        if state.stage == Stage.DRAIN:
            return TakeWritten(at_s=at_s, take=state.current, colour=colour, sentence="So.")
        checking = [take for take in state.takes if take.phase == TakePhase.CHECKING]
        if checking:
            problems = () if self.random.random() < 0.8 else ("cam01: damaged",)
            return TakeChecked(at_s=at_s, take=checking[0].name, problems=problems)
        return Tick(at_s=at_s)

    def _anything(self, state: RomState) -> Event:
        at_s, colour = self.at_s, self.random.choice(list(Colour))
        take = self.random.choice([take.name for take in state.takes] + ["nothing_001"])
        makers = (
            lambda: KeyPressed(
                at_s=at_s,
                key=self.random.choice((*Key, Key.GO, Key.GO, Key.ARM)),
                slate=self.random.choice((*SLATES, "grin", "")),
                take=self.random.choice((take, "", "")),
                reason=self.random.choice(("it will do", "", " ")),
            ),
            lambda: Tick(at_s=at_s),
            lambda: PreflightDone(at_s=at_s, colour=colour, sentence="So."),
            lambda: TakeStarted(at_s=at_s, take=take, number=1),
            lambda: TakeNotStarted(at_s=at_s, error="no"),
            lambda: TakeJudged(at_s=at_s, take=take, colour=colour, sentence="So."),
            lambda: TakeWritten(at_s=at_s, take=take, colour=colour, sentence="So."),
            lambda: TakeChecked(at_s=at_s, take=take, problems=self.random.choice(((), ("bad",)))),
            lambda: TakeFailed(at_s=at_s, take=take, error="gone"),
            lambda: DevicesLost(at_s=at_s, devices=self.random.choice(((), (), ("cam03",)))),
            lambda: DiskLeft(at_s=at_s, takes=self.random.choice((0, 1, 5, 40))),
        )
        weights = (8, 4, 1, 1, 1, 1, 1, 1, 1, 2, 2)
        event: Event = self.random.choices(makers, weights)[0]()
        return event


@pytest.mark.parametrize("seed", range(60))
def test_laws_hold_for_every_event_in_every_state(seed: int) -> None:
    source, state = Source(seed), RomState()
    for _ in range(250):
        event = source.draw(state)
        step = MACHINE.step(state, event)
        assert step == MACHINE.step(state, event), "not a pure function"
        _check_step(state, event, step)
        _check_state(step.state)
        state = step.state
    _check_way_home(state, source.at_s)


def _check_step(before: RomState, event: Event, step: Step) -> None:
    if step.refusal:
        assert step.state is before
        assert step.tasks == ()
        return
    # No take is ever lost, none changes its name, slate or number, none goes back in its phase.
    for old, new in zip(before.takes, step.state.takes, strict=False):
        assert (old.name, old.slate, old.number) == (new.name, new.slate, new.number)
        assert _ORDER.index(new.phase) >= _ORDER.index(old.phase)
        if old.colour != new.colour:
            assert isinstance(event, TakeJudged | TakeWritten)
    grown = len(step.state.takes) - len(before.takes)
    assert grown == isinstance(event, TakeStarted)
    # Nothing is recorded but after a countdown, armed, with all devices and room on the disk.
    assert (Task.RECORD in step.tasks) == (
        step.state.stage == Stage.RECORD and before.stage != Stage.RECORD
    )
    if Task.RECORD in step.tasks:
        assert before.stage == Stage.COUNTDOWN
        assert before.takes_left >= 1
        assert not before.lost
    if step.state.stage == Stage.COUNTDOWN and before.stage != Stage.COUNTDOWN:
        assert before.stage == Stage.ARMED
    if step.state.stage == Stage.ARMED and before.stage in (Stage.IDLE, Stage.PREFLIGHT):
        assert before.stage == Stage.PREFLIGHT
        assert before.takes_left >= 1


def _check_state(state: RomState) -> None:
    recording = [take.name for take in state.takes if take.phase == TakePhase.RECORDING]
    assert len(recording) <= 1
    assert recording == ([state.current] if state.stage == Stage.RECORD and state.current else [])
    assert bool(state.current) <= (state.stage in (Stage.RECORD, Stage.DRAIN))
    assert 0 <= state.place < len(SLATES)
    assert len({take.name for take in state.takes}) == len(state.takes)
    for take in state.takes:
        undecided = take.status == TakeStatus.UNDECIDED
        assert undecided == (take.decided_by == "")
        assert (take in state.undecided) == (undecided and take.phase != TakePhase.RECORDING)
        # What is red is kept by nobody without a reason, and its verdict stays.
        if take.status == TakeStatus.KEEP and take.shown_colour == Colour.RED:
            assert take.overruled is not None
            assert take.overruled.reason
            assert take.phase != TakePhase.FAILED
        assert take.overruled is None or take.status == TakeStatus.KEEP
        if take.decided_by == "machine" and take.status == TakeStatus.KEEP:
            assert (take.phase, take.shown_colour) == (TakePhase.DONE, Colour.GREEN)


def _check_way_home(state: RomState, at_s: float) -> None:
    """From anywhere the operator gets back to idle, whatever the array does not answer."""
    for _ in range(3):
        at_s += 100
        state = MACHINE.step(state, Tick(at_s=at_s)).state
    if state.stage == Stage.DRAIN:
        state = MACHINE.step(state, TakeFailed(at_s=at_s, take=state.current, error="gone")).state
    step = MACHINE.step(state, KeyPressed(at_s=at_s, key=Key.DISARM))
    assert step.state.stage == Stage.IDLE
