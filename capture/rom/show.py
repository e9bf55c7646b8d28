"""From a state to a view."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from capture.device_watch import DeviceState
from capture.disk import DiskForecast
from capture.judgement import Colour
from capture.live_take import TakePhase
from capture.preflight.finding import Finding
from capture.rom.events import Key, KeyPressed
from capture.rom.machine import Machine
from capture.rom.shot_list import Prompt
from capture.rom.state import RomState, Stage, TakeState
from capture.rom.view import Cue, Message, PromptView, TakeView, View
from capture.rom.words import listed, no_room
from capture.take_notes import OperatorNote, TakeStatus


@dataclass(frozen=True, kw_only=True)
class Sight:
    """All that a view is made of.

    Attributes:
        at_s: the time.
        session: its name.
        machine: the rules.
        state: where the session stands.
        note: the note of a take, by its name.
        fractions: of takes under way, by name.
        devices: how each fares.
        disk: how long it lasts.
        checking: what the preflight looks at now; empty before the first.
        findings: of the last preflight.
        messages: so far.
    """

    at_s: float
    session: str
    machine: Machine
    state: RomState
    note: Callable[[str], OperatorNote]
    fractions: Mapping[str, float]
    devices: tuple[DeviceState, ...]
    disk: DiskForecast | None
    checking: str
    findings: tuple[Finding, ...]
    messages: tuple[Message, ...]


def draw(sight: Sight) -> View:
    """Make the view of an instant."""
    state, prompts = sight.state, sight.machine.prompts.prompts
    prompt = sight.machine.prompt(state)
    takes = tuple(_take_view(sight, take) for take in state.takes)
    current = [take for take in takes if take.name == state.current] or list(takes[-1:])
    cue, fraction, hold = _progress(sight, prompt)
    return View(
        at_s=sight.at_s,
        session=sight.session,
        list_title=sight.machine.prompts.title,
        stage=state.stage,
        headline=_headline(sight, prompt),
        place=state.place,
        prompts=tuple(_prompt_view(state, place, each) for place, each in enumerate(prompts)),
        prompt=prompt,
        next_prompt=prompts[state.place + 1] if state.place + 1 < len(prompts) else None,
        countdown=_countdown(sight, prompt),
        cue=cue,
        fraction=fraction,
        hold_fraction=hold,
        takes=takes,
        current=current[0] if current else None,
        undecided=tuple(take.name for take in state.undecided),
        devices=sight.devices,
        disk=sight.disk,
        preflight=state.preflight,
        findings=sight.findings,
        messages=sight.messages,
        offers=_offers(sight),
        finished=_finished(sight),
    )


def _take_view(sight: Sight, take: TakeState) -> TakeView:
    numbers = [other.number for other in sight.state.takes if other.slate == take.slate]
    over = take.phase in (TakePhase.DONE, TakePhase.FAILED)
    return TakeView(
        name=take.name,
        slate=take.slate,
        number=take.number,
        phase=take.phase,
        fraction=1.0 if over else sight.fractions.get(take.name, 0.0),
        colour=take.shown_colour,
        sentence=take.shown_sentence,
        note=sight.note(take.name),
        superseded=take.number < max(numbers),
    )


def _prompt_view(state: RomState, place: int, prompt: Prompt) -> PromptView:
    takes = [take for take in state.takes if take.slate == prompt.slate]
    good = [take for take in takes if take.status != TakeStatus.RETAKE]
    colour = None
    if good:
        status, colour = str(good[-1].status), good[-1].shown_colour
    elif takes:
        status = str(TakeStatus.RETAKE)
    elif prompt.slate in state.skipped:
        status = "skipped"
    else:
        status = "current" if place == state.place else ""
    return PromptView(prompt=prompt, takes=len(takes), status=status, colour=colour)


def _countdown(sight: Sight, prompt: Prompt) -> int | None:
    if sight.state.stage != Stage.COUNTDOWN:
        return None
    left_s = sight.state.since_s + prompt.countdown_s - sight.at_s
    return max(1, math.ceil(left_s))


def _progress(sight: Sight, prompt: Prompt) -> tuple[Cue, float, float]:
    """The cue, the fraction of the take and that of the hold."""
    state = sight.state
    if state.stage == Stage.COUNTDOWN:
        return Cue.READY, 0.0, 0.0
    if state.stage != Stage.RECORD or not state.current:
        return Cue.NONE, 0.0, 0.0
    elapsed_s = sight.at_s - state.since_s
    fraction = min(max(elapsed_s / prompt.total_s, 0.0), 1.0)
    held_s = elapsed_s - prompt.before_s
    if held_s < 0:
        return Cue.NEUTRAL, fraction, 0.0
    if held_s >= prompt.hold_s:
        return Cue.RELAX, fraction, 1.0
    return Cue.HOLD, fraction, held_s / prompt.hold_s


def _headline(sight: Sight, prompt: Prompt) -> str:
    state = sight.state
    match state.stage:
        case Stage.IDLE:
            return "The devices are stopped. Arm them to begin."
        case Stage.PREFLIGHT if state.preflight is None:
            at = f": {sight.checking}" if sight.checking else ""
            return f"The devices are being started and checked{at}."
        case Stage.PREFLIGHT:
            return "The check was red. Put it right and check again, or overrule it with a reason."
        case Stage.COUNTDOWN:
            return f"{prompt.title}: get ready."
        case Stage.RECORD:
            return f"{state.current or prompt.title} is being recorded."
        case Stage.DRAIN:
            return f"{state.current} is being written."
    return _armed_headline(sight, prompt)


def _armed_headline(sight: Sight, prompt: Prompt) -> str:
    state = sight.state
    if state.takes_left < 1:
        return no_room()
    if state.lost:
        return f"Lost: {listed(state.lost)}. Nothing is recorded without {_them(state)}."
    red = [
        take
        for take in state.undecided
        if take.slate == prompt.slate and take.shown_colour == Colour.RED
    ]
    if red:
        return f"{red[-1].name} is red. Go takes it again; or overrule it with a reason."
    if _finished(sight):
        return "Every prompt has a good take or is left out. Disarm to end."
    waiting = len(state.undecided)
    more = f" {waiting} take{'s' if waiting > 1 else ''} to decide about." if waiting else ""
    return f"Ready. Go records {prompt.title}.{more}"


def _them(state: RomState) -> str:
    return "it" if len(state.lost) == 1 else "them"


def _finished(sight: Sight) -> bool:
    state = sight.state
    return all(slate in state.done | state.skipped for slate in sight.machine.prompts.slates)


def _offers(sight: Sight) -> frozenset[Key]:
    """The rules are a pure function: ask them what they would say."""
    slates = sight.machine.prompts.slates
    return frozenset(
        key
        for key in Key
        if not sight.machine.step(
            sight.state,
            KeyPressed(at_s=sight.at_s, key=key, slate=slates[0], reason="asked"),
        ).refusal
    )
