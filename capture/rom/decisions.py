"""Decisions about takes: keep, flag, retake, overrule. Each take has exactly one, or none yet."""

from __future__ import annotations

from dataclasses import replace

from capture.judgement import Colour
from capture.live_take import TakePhase
from capture.rom.events import Key, KeyPressed
from capture.rom.shot_list import PromptList
from capture.rom.state import RomState, Stage, Step, TakeState
from capture.take_notes import Overrule, TakeStatus

_STATUS = {Key.KEEP: TakeStatus.KEEP, Key.FLAG: TakeStatus.FLAG, Key.RETAKE: TakeStatus.RETAKE}
OPERATOR, MACHINE = "operator", "machine"


def decide(prompts: PromptList, state: RomState, event: KeyPressed) -> Step:
    """What KEEP, FLAG, RETAKE or OVERRULE leads to.

    Args:
        prompts: of the session.
        state: of the session.
        event: one of these keys; without a take it means the latest that is no longer recorded.
    """
    over = [take for take in state.takes if take.phase != TakePhase.RECORDING]
    take = state.take(event.take) if event.take else next(iter(over[::-1]), None)
    if take is None:
        missing = f"There is no take {event.take!r}." if event.take else "There is no take yet."
        return Step(state, refusal=missing)
    if take not in over:
        return Step(state, refusal=f"{take.name} is still being recorded.")
    if event.key == Key.OVERRULE:
        return _overrule(state, take, event.reason.strip())
    if event.key == Key.RETAKE:
        return _retake(prompts, state, take, event.at_s)
    status = _STATUS[event.key]
    if status == TakeStatus.KEEP and take.shown_colour == Colour.RED:
        return Step(
            state, refusal=f"{take.name} is red: retake it, flag it, or overrule it with a reason."
        )
    if take.status == status and take.decided_by == OPERATOR:
        return Step(state, refusal=f"{take.name} has the status {status} already.")
    return Step(state.with_take(_decided(take, status, OPERATOR)))


def judged_anew(take: TakeState, *, keep_green: bool = False) -> TakeState:
    """A take after news of it: what was kept and turns out bad waits for a decision again.

    Args:
        take: with its news.
        keep_green: whether it is kept without a key when it is green, read back whole and was not
            closed before its end.
    """
    news = take.overruled is None or bool(take.problems)
    if take.shown_colour == Colour.RED and news and take.status == TakeStatus.KEEP:
        return _decided(take, TakeStatus.UNDECIDED, "")
    whole = take.phase == TakePhase.DONE and take.shown_colour == Colour.GREEN
    if keep_green and whole and not take.cut and take.status == TakeStatus.UNDECIDED:
        return _decided(take, TakeStatus.KEEP, MACHINE)
    return take


def superseded(state: RomState, slate: str) -> RomState:
    """The state once a new take of a slate begins: undecided ones of it are retaken by that."""
    for take in state.undecided:
        if take.slate == slate:
            state = state.with_take(_decided(take, TakeStatus.RETAKE, MACHINE))
    return state


def _overrule(state: RomState, take: TakeState, reason: str) -> Step:
    if take.phase == TakePhase.FAILED:
        return Step(
            state,
            refusal=f"{take.name} failed and may not be whole: retake it, or flag it and run "
            "`likeness recover` later.",
        )
    if take.shown_colour == Colour.GREEN:
        return Step(state, refusal=f"{take.name} is green: there is nothing to overrule.")
    if not reason:
        return Step(state, refusal=f"Overruling the verdict on {take.name} needs a reason.")
    verdict = Overrule(
        colour=take.shown_colour or Colour.RED, sentence=take.shown_sentence, reason=reason
    )
    kept = replace(_decided(take, TakeStatus.KEEP, OPERATOR), overruled=verdict)
    return Step(state.with_take(kept))


def _retake(prompts: PromptList, state: RomState, take: TakeState, at_s: float) -> Step:
    if state.stage == Stage.RECORD:
        return Step(state, refusal="Another take is being recorded; stop it first.")
    after = state.with_take(_decided(take, TakeStatus.RETAKE, OPERATOR))
    if take.slate not in prompts.slates:
        text = f"{take.slate} is not in the shot list; choose a prompt."
        return Step(after, told=((Colour.AMBER, text),))
    stage = Stage.ARMED if state.stage == Stage.COUNTDOWN else state.stage
    since_s = at_s if stage != state.stage else state.since_s
    place = prompts.slates.index(take.slate)
    return Step(replace(after, stage=stage, since_s=since_s, place=place, advance=False))


def _decided(take: TakeState, status: TakeStatus, by: str) -> TakeState:
    return replace(take, status=status, decided_by=by, overruled=None)
