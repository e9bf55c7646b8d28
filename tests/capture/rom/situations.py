"""Session states and events for tests."""

from __future__ import annotations

from capture.judgement import Colour
from capture.rom.events import (
    Event,
    Key,
    KeyPressed,
    PreflightDone,
    TakeChecked,
    TakeJudged,
    TakeStarted,
    TakeWritten,
    Tick,
)
from capture.rom.machine import Machine
from capture.rom.shot_list import Prompt, PromptList
from capture.rom.state import RomState, Step

SLATES = ("neutral", "smile", "frown")


def prompts(*slates: str, hold_s: float = 1.0, total_s: float = 2.0) -> PromptList:
    """A short list."""
    return PromptList(
        name="short",
        title="Short",
        prompts=tuple(
            Prompt(
                slate=slate,
                title=slate.capitalize(),
                sentence=f"Show me a {slate}.",
                kind="expression",
                hold_s=hold_s,
                total_s=total_s,
                countdown_s=3.0,
            )
            for slate in slates or SLATES
        ),
    )


MACHINE = Machine(prompts=prompts())


def after(state: RomState, *events: Event, machine: Machine = MACHINE) -> RomState:
    """The state after events, none of which may be refused."""
    for event in events:
        step = machine.step(state, event)
        assert not step.refusal, (event, step.refusal)
        state = step.state
    return state


def press(state: RomState, key: Key, at_s: float = 0.0, **more: str) -> Step:
    """What a key leads to."""
    event = KeyPressed(
        at_s=at_s,
        key=key,
        slate=more.get("slate", ""),
        take=more.get("take", ""),
        reason=more.get("reason", ""),
    )
    return MACHINE.step(state, event)


def armed(at_s: float = 0.0) -> RomState:
    """Armed at the first prompt."""
    return after(
        RomState(),
        KeyPressed(at_s=at_s, key=Key.ARM),
        PreflightDone(at_s=at_s, colour=Colour.GREEN, sentence="All devices are ready."),
    )


def recording(state: RomState, take: str, at_s: float = 0.0) -> RomState:
    """Recording a take of the present prompt; the state before was armed."""
    return after(
        state,
        KeyPressed(at_s=at_s, key=Key.GO),
        Tick(at_s=at_s + 3.0),
        TakeStarted(at_s=at_s + 3.0, take=take, number=int(take[-3:])),
    )


def judged(
    state: RomState, take: str, colour: Colour = Colour.GREEN, at_s: float = 5.0
) -> RomState:
    """A take that was being recorded is over."""
    return after(
        state, TakeJudged(at_s=at_s, take=take, colour=colour, sentence=f"It is {colour}.")
    )


def written(
    state: RomState, take: str, colour: Colour = Colour.GREEN, at_s: float = 5.5
) -> RomState:
    """A take that was judged is on disk."""
    return after(
        state, TakeWritten(at_s=at_s, take=take, colour=colour, sentence=f"It is {colour}.")
    )


def taken(
    state: RomState, take: str, colour: Colour = Colour.GREEN, problems: tuple[str, ...] = ()
) -> RomState:
    """A take from the key to having been read back; the state before was armed."""
    state = written(judged(recording(state, take), take, colour), take, colour)
    return after(state, TakeChecked(at_s=6.0, take=take, problems=problems))
