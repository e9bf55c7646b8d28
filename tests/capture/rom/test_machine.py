"""The state machine: what every event leads to in every stage, and the policy for takes."""

from __future__ import annotations

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
from capture.rom.state import RomState, Stage, TakeState, Task
from capture.take_notes import TakeStatus
from tests.capture.rom.situations import (
    MACHINE,
    after,
    armed,
    judged,
    press,
    recording,
    taken,
    written,
)

GREEN, AMBER, RED = Colour.GREEN, Colour.AMBER, Colour.RED


def stages() -> dict[Stage, RomState]:
    """One state of every stage, at the second of three prompts, with one take that was kept."""
    start = taken(armed(), "neutral_001")
    assert start.place == 1
    return {
        Stage.IDLE: after(start, KeyPressed(at_s=9, key=Key.DISARM)),
        Stage.PREFLIGHT: after(start, KeyPressed(at_s=9, key=Key.ARM)),
        Stage.ARMED: start,
        Stage.COUNTDOWN: after(start, KeyPressed(at_s=9, key=Key.GO)),
        Stage.RECORD: recording(start, "smile_001", 9),
        Stage.DRAIN: judged(recording(start, "smile_001", 9), "smile_001"),
    }


# By stage, what each key leads to; "-" is a refusal, "=" the same stage.
KEYS = {
    #               idle         preflight    armed        countdown  record  drain
    Key.ARM:      ("preflight", "-",         "preflight", "-",       "-",    "-"),
    Key.DISARM:   ("-",         "idle",      "idle",      "idle",    "-",    "-"),
    Key.GO:       ("-",         "-",         "countdown", "-",       "-",    "-"),
    Key.ABORT:    ("-",         "-",         "-",         "armed",   "-",    "-"),
    Key.STOP:     ("-",         "-",         "-",         "armed",   "=",    "-"),
    Key.KEEP:     ("=",         "=",         "=",         "=",       "=",    "="),
    Key.FLAG:     ("=",         "=",         "=",         "=",       "=",    "="),
    Key.RETAKE:   ("=",         "=",         "=",         "armed",   "-",    "="),
    Key.OVERRULE: ("-",         "-",         "-",         "-",       "-",    "-"),
    Key.NEXT:     ("=",         "=",         "=",         "-",       "-",    "="),
    Key.PREVIOUS: ("=",         "=",         "=",         "-",       "-",    "="),
    Key.JUMP:     ("=",         "=",         "=",         "-",       "-",    "="),
    Key.SKIP:     ("=",         "=",         "=",         "-",       "-",    "="),
}  # fmt: skip


@pytest.mark.parametrize("key", Key)
def test_every_key_has_its_answer_in_every_stage(key: Key) -> None:
    for (stage, state), wanted in zip(stages().items(), KEYS[key], strict=True):
        assert state.stage == stage
        step = press(state, key, 20.0, slate="frown", reason="it will do")
        if wanted == "-":
            assert step.refusal.endswith("."), (stage, key)
            assert step.state is state
            assert not step.tasks
        else:
            assert not step.refusal, (stage, key, step.refusal)
            assert step.state.stage == (stage if wanted == "=" else wanted)


EVENTS = {
    #                   idle    preflight  armed    countdown  record   drain
    "tick":            ("=",    "=",       "=",     "record",  "=",     "="),
    "ready":           ("-",    "armed",   "-",     "-",       "-",     "-"),
    "red check":       ("-",    "=",       "-",     "-",       "-",     "-"),
    "not streaming":   ("-",    "idle",    "-",     "-",       "-",     "-"),
    "started":         ("-",    "-",       "-",     "-",       "-",     "-"),
    "not started":     ("-",    "-",       "-",     "-",       "-",     "-"),
    "judged":          ("-",    "-",       "-",     "-",       "drain", "-"),
    "written":         ("-",    "-",       "-",     "-",       "-",     "armed"),
    "checked":         ("-",    "-",       "-",     "-",       "-",     "-"),
    "failed":          ("-",    "-",       "-",     "-",       "armed", "armed"),
    "unknown take":    ("-",    "-",       "-",     "-",       "-",     "-"),
    "device lost":     ("=",    "=",       "=",     "armed",   "=",     "="),
    "disk full":       ("=",    "=",       "=",     "armed",   "=",     "="),
}  # fmt: skip


@pytest.mark.parametrize("name", EVENTS)
def test_every_other_event_has_its_answer_in_every_stage(name: str) -> None:
    take = "smile_001"
    events: dict[str, Event] = {
        "tick": Tick(at_s=13),
        "ready": PreflightDone(at_s=13, colour=AMBER, sentence="Well."),
        "red check": PreflightDone(at_s=13, colour=RED, sentence="No."),
        "not streaming": PreflightDone(at_s=13, colour=RED, sentence="No.", streaming=False),
        "started": TakeStarted(at_s=13, take="smile_002", number=2),
        "not started": TakeNotStarted(at_s=13, error="no"),
        "judged": TakeJudged(at_s=13, take=take, colour=GREEN, sentence="Good."),
        "written": TakeWritten(at_s=13, take=take, colour=GREEN, sentence="Good."),
        "checked": TakeChecked(at_s=13, take=take),
        "failed": TakeFailed(at_s=13, take=take, error="The disk is full."),
        "unknown take": TakeFailed(at_s=13, take="laugh_001", error="?"),
        "device lost": DevicesLost(at_s=13, devices=("cam03",)),
        "disk full": DiskLeft(at_s=13, takes=0),
    }
    event = events[name]
    for (stage, state), wanted in zip(stages().items(), EVENTS[name], strict=True):
        step = MACHINE.step(state, event)
        assert bool(step.refusal) == (wanted == "-"), (stage, step.refusal)
        if wanted == "-":
            assert step.state is state
        else:
            assert step.state.stage == (stage if wanted == "=" else wanted), stage


def test_a_session_of_three_green_takes_needs_one_key_a_take() -> None:
    state = armed()
    for slate in ("neutral", "smile", "frown"):
        assert MACHINE.prompt(state).slate == slate
        state = taken(state, f"{slate}_001")
    assert [take.status for take in state.takes] == [TakeStatus.KEEP] * 3
    assert {take.decided_by for take in state.takes} == {"machine"}
    assert state.done == {"neutral", "smile", "frown"}
    assert state.stage == Stage.ARMED
    assert state.undecided == ()


def test_the_next_prompt_is_shown_while_the_take_is_read_back() -> None:
    state = written(judged(recording(armed(), "neutral_001"), "neutral_001"), "neutral_001")
    assert (state.stage, state.place) == (Stage.ARMED, 1)
    assert state.takes[0].phase == TakePhase.CHECKING
    during = recording(state, "smile_001")
    done = after(during, TakeChecked(at_s=9, take="neutral_001"))
    assert done.stage == Stage.RECORD
    assert done.takes[0].status == TakeStatus.KEEP


def test_red_stays_at_its_prompt_and_go_takes_it_again() -> None:
    state = taken(armed(), "neutral_001", RED)
    assert (state.stage, state.place) == (Stage.ARMED, 0)
    assert [take.name for take in state.undecided] == ["neutral_001"]
    again = taken(state, "neutral_002")
    assert [take.status for take in again.takes] == [TakeStatus.RETAKE, TakeStatus.KEEP]
    assert again.takes[0].decided_by == "machine"
    assert again.place == 1


def test_amber_goes_on_and_waits_for_a_decision() -> None:
    state = taken(armed(), "neutral_001", AMBER)
    assert state.place == 1
    assert [take.name for take in state.undecided] == ["neutral_001"]
    kept = after(state, KeyPressed(at_s=9, key=Key.KEEP))
    assert kept.undecided == ()
    assert kept.takes[0].decided_by == "operator"


def test_a_red_take_is_kept_only_by_overruling_with_a_reason_and_its_verdict_stays() -> None:
    state = taken(armed(), "neutral_001", RED)
    assert press(state, Key.KEEP).refusal == (
        "neutral_001 is red: retake it, flag it, or overrule it with a reason."
    )
    assert press(state, Key.OVERRULE, reason="  ").refusal == (
        "Overruling the verdict on neutral_001 needs a reason."
    )
    [take] = press(state, Key.OVERRULE, reason="only cam09, behind the head").state.takes
    assert (take.status, take.colour, take.sentence) == (TakeStatus.KEEP, RED, "It is red.")
    assert take.overruled is not None
    assert (take.overruled.colour, take.overruled.sentence) == (RED, "It is red.")
    assert take.overruled.reason == "only cam09, behind the head"
    flagged = press(state.with_take(take), Key.FLAG).state.takes[0]
    assert flagged.overruled is None


def test_what_was_kept_and_is_not_read_back_whole_waits_for_a_decision_again() -> None:
    state = written(judged(recording(armed(), "neutral_001"), "neutral_001"), "neutral_001")
    state = after(state, KeyPressed(at_s=6, key=Key.KEEP))
    step = MACHINE.step(
        state, TakeChecked(at_s=7, take="neutral_001", problems=("cam02: frame 3 is damaged",))
    )
    [take] = step.state.takes
    assert (take.status, take.shown_colour, take.colour) == (TakeStatus.UNDECIDED, RED, GREEN)
    assert step.told == ((RED, "neutral_001 was not read back whole: cam02: frame 3 is damaged"),)
    assert "red" in press(step.state, Key.KEEP).refusal


def test_frames_that_could_not_be_written_change_the_verdict_and_the_prompt_stays() -> None:
    state = judged(recording(armed(), "neutral_001"), "neutral_001", GREEN)
    assert state.advance
    step = MACHINE.step(
        state, TakeWritten(at_s=6, take="neutral_001", colour=RED, sentence="The disk was slow.")
    )
    assert (step.state.place, step.state.takes[0].colour) == (0, RED)
    assert step.told == ((RED, "neutral_001: The disk was slow."),)


def test_a_failed_take_is_never_kept() -> None:
    state = after(
        recording(armed(), "neutral_001"),
        TakeFailed(at_s=4, take="neutral_001", error="No space left."),
    )
    assert (state.stage, state.place) == (Stage.ARMED, 0)
    assert "likeness recover" in press(state, Key.OVERRULE, reason="must have it").refusal
    assert press(state, Key.FLAG).state.takes[0].status == TakeStatus.FLAG


def test_retake_goes_back_to_the_prompt_of_any_take_and_keeps_it() -> None:
    state = taken(taken(armed(), "neutral_001"), "smile_001")
    back = press(state, Key.RETAKE, take="neutral_001").state
    assert (back.place, len(back.takes)) == (0, 2)
    assert back.takes[0].status == TakeStatus.RETAKE
    draining = judged(recording(state, "frown_001"), "frown_001")
    assert not press(draining, Key.RETAKE).state.advance


def test_stop_closes_the_take_once_and_stays_at_its_prompt() -> None:
    step = press(recording(armed(), "neutral_001"), Key.STOP, 4.0)
    assert step.tasks == (Task.CLOSE,)
    assert press(step.state, Key.STOP, 4.1).refusal == "neutral_001 is being closed already."
    state = written(judged(step.state, "neutral_001"), "neutral_001")
    assert (state.stage, state.place) == (Stage.ARMED, 0)
    # Its hold may be missing: it is green by what there is, and nobody has said that it is enough.
    done = after(state, TakeChecked(at_s=9, take="neutral_001"))
    assert [take.name for take in done.undecided] == ["neutral_001"]
    assert press(done, Key.KEEP).state.takes[0].status == TakeStatus.KEEP


def test_a_take_that_does_not_end_is_closed_and_at_last_given_up() -> None:
    state = recording(armed(), "neutral_001")
    step = MACHINE.step(state, Tick(at_s=8.5))
    assert step.tasks == (Task.CLOSE,)
    assert press(step.state, Key.DISARM, 7.0).refusal.endswith("stop it first.")
    given_up = press(step.state, Key.DISARM, 30.0)
    assert given_up.state.stage == Stage.IDLE
    assert given_up.state.takes[0].phase == TakePhase.FAILED


def test_a_take_that_does_not_start_leaves_the_array_armed() -> None:
    state = after(armed(), KeyPressed(at_s=0, key=Key.GO), Tick(at_s=3))
    assert (state.stage, state.current) == (Stage.RECORD, "")
    assert after(state, TakeNotStarted(at_s=3, error="no ring")).stage == Stage.ARMED
    assert after(state, Tick(at_s=7)).stage == Stage.ARMED


def test_nothing_is_armed_or_recorded_below_one_take_of_disk() -> None:
    full = after(RomState(), DiskLeft(at_s=0, takes=0))
    assert press(full, Key.ARM).refusal.startswith("The disk has no room for one more take")
    assert press(after(armed(), DiskLeft(at_s=1, takes=0)), Key.GO).refusal.startswith("The disk")
    checking = after(RomState(), KeyPressed(at_s=0, key=Key.ARM), DiskLeft(at_s=1, takes=0))
    done = MACHINE.step(checking, PreflightDone(at_s=2, colour=GREEN, sentence="Ready."))
    assert done.state.stage == Stage.PREFLIGHT
    assert press(done.state, Key.OVERRULE, reason="now").refusal.startswith("The disk")


def test_nothing_is_recorded_while_a_device_is_lost_but_a_take_goes_on() -> None:
    lost = DevicesLost(at_s=1, devices=("cam03",))
    assert press(after(armed(), lost), Key.GO).refusal == (
        "cam03 is lost: wait, or disarm and take what is broken out of the array."
    )
    during = MACHINE.step(recording(armed(), "neutral_001"), lost)
    assert during.state.stage == Stage.RECORD
    assert during.told == ((RED, "Lost: cam03."),)
    back = MACHINE.step(during.state, DevicesLost(at_s=2, devices=()))
    assert back.told == ((GREEN, "Back: cam03."),)


def test_a_red_preflight_is_overruled_only_with_a_reason() -> None:
    red = after(
        RomState(),
        KeyPressed(at_s=0, key=Key.ARM),
        PreflightDone(at_s=1, colour=RED, sentence="cam03 is out of focus."),
    )
    assert "preflight was red" in press(red, Key.GO).refusal
    assert press(red, Key.OVERRULE).refusal == "Overruling the preflight needs a reason."
    step = press(red, Key.OVERRULE, reason="it is not used")
    assert step.state.stage == Stage.ARMED
    assert step.state.preflight is not None
    assert step.state.preflight.sentence == "cam03 is out of focus."
    assert step.told == ((AMBER, "The preflight was red and is overruled: it is not used"),)
    assert press(red, Key.ARM).tasks == (Task.START,)


def test_prompts_are_skipped_and_come_back_when_they_are_recorded() -> None:
    state = press(armed(), Key.SKIP).state
    assert state.place == 1
    assert state.skipped == frozenset({"neutral"})
    state = recording(press(state, Key.JUMP, slate="neutral").state, "neutral_001")
    assert state.skipped == frozenset()
    kept = after(taken(armed(), "neutral_001"), KeyPressed(at_s=9, key=Key.PREVIOUS))
    assert "has a good take already" in press(kept, Key.SKIP).refusal


def test_the_ends_of_the_list_and_unknown_names_are_told() -> None:
    assert press(armed(), Key.PREVIOUS).refusal == "This is the first prompt."
    last = press(armed(), Key.JUMP, slate="frown").state
    assert press(last, Key.NEXT).refusal == "This is the last prompt."
    assert press(last, Key.JUMP, slate="grin").refusal == "No prompt has the slate 'grin'."
    assert press(last, Key.KEEP).refusal == "There is no take yet."
    assert press(last, Key.KEEP, take="grin_001").refusal == "There is no take 'grin_001'."


def test_a_take_whose_prompt_left_the_list_can_still_be_decided_about() -> None:
    old = TakeState(name="grin_001", slate="grin", number=1, phase=TakePhase.DONE, colour=RED)
    step = press(armed().with_take(old), Key.RETAKE)
    assert step.state.takes[0].status == TakeStatus.RETAKE
    assert step.told == ((AMBER, "grin is not in the shot list; choose a prompt."),)
