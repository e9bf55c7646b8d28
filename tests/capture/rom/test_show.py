"""Views: what the operator and the talent see at each instant of a take."""

from __future__ import annotations

import pytest

from capture.judgement import Colour
from capture.rom.events import DevicesLost, DiskLeft, Key, KeyPressed
from capture.rom.show import Sight, draw
from capture.rom.state import RomState
from capture.rom.view import Cue, View
from capture.take_notes import OperatorNote
from tests.capture.rom.situations import MACHINE, after, armed, judged, press, recording, taken


def view(state: RomState, at_s: float = 0.0) -> View:
    return draw(
        Sight(
            checking="sync (10 of 14)",
            at_s=at_s,
            session="monday",
            machine=MACHINE,
            state=state,
            note=lambda _: OperatorNote(),
            fractions={"smile_001": 0.25},
            devices=(),
            disk=None,
            findings=(),
            messages=(),
        )
    )


def test_a_check_says_how_far_it_is() -> None:
    checking = press(RomState(), Key.ARM).state
    assert view(checking).headline == (
        "The devices are being started and checked: sync (10 of 14)."
    )


@pytest.mark.parametrize(
    ("at_s", "number"), [(10.0, 3), (10.9, 3), (11.1, 2), (12.0, 1), (12.99, 1), (13.4, 1)]
)
def test_the_countdown_shows_whole_seconds_and_never_nought(at_s: float, number: int) -> None:
    state = press(armed(), Key.GO, 10.0).state
    shown = view(state, at_s)
    assert (shown.countdown, shown.cue) == (number, Cue.READY)
    assert shown.headline == "Neutral: get ready."


@pytest.mark.parametrize(
    ("elapsed_s", "cue", "fraction", "hold"),
    [
        (0.0, Cue.NEUTRAL, 0.0, 0.0),
        (0.49, Cue.NEUTRAL, 0.245, 0.0),
        (0.5, Cue.HOLD, 0.25, 0.0),
        (1.0, Cue.HOLD, 0.5, 0.5),
        (1.5, Cue.RELAX, 0.75, 1.0),
        (2.0, Cue.RELAX, 1.0, 1.0),
        (2.5, Cue.RELAX, 1.0, 1.0),
    ],
)
def test_cues_follow_the_hold_window_of_the_prompt(
    elapsed_s: float, cue: Cue, fraction: float, hold: float
) -> None:
    shown = view(recording(armed(), "neutral_001"), 3.0 + elapsed_s)
    assert shown.cue == cue
    assert shown.fraction == pytest.approx(fraction)
    assert shown.hold_fraction == pytest.approx(hold)
    assert shown.countdown is None


def test_the_headline_says_what_to_do_next() -> None:
    start = armed()
    assert view(start).headline == "Ready. Go records Neutral."
    lost = after(start, DevicesLost(at_s=0, devices=("cam03", "cam04")))
    assert view(lost).headline == "Lost: cam03, cam04. Nothing is recorded without them."
    full = after(start, DiskLeft(at_s=0, takes=0))
    assert view(full).headline.startswith("The disk has no room for one more take")
    red = taken(start, "neutral_001", Colour.RED)
    assert view(red).headline == (
        "neutral_001 is red. Go takes it again; or overrule it with a reason."
    )
    amber = taken(start, "neutral_001", Colour.AMBER)
    assert view(amber).headline == "Ready. Go records Smile. 1 take to decide about."
    state = recording(amber, "smile_001")
    assert view(state).headline == "smile_001 is being recorded."
    assert view(judged(state, "smile_001")).headline == "smile_001 is being written."


def test_each_line_of_the_list_tells_what_became_of_it() -> None:
    state = taken(armed(), "neutral_001", Colour.RED)
    state = taken(state, "neutral_002")
    state = recording(state, "smile_001")
    shown = view(state, 4.0)
    assert [(line.takes, line.status, line.colour) for line in shown.prompts] == [
        (2, "keep", Colour.GREEN), (1, "undecided", None), (0, "", None),
    ]  # fmt: skip
    assert [(take.name, take.superseded, take.fraction) for take in shown.takes] == [
        ("neutral_001", True, 1.0), ("neutral_002", False, 1.0), ("smile_001", False, 0.25),
    ]  # fmt: skip
    assert shown.current is not None
    assert shown.current.name == "smile_001"
    assert shown.next_prompt is not None
    assert shown.next_prompt.slate == "frown"
    assert not shown.finished


def test_offers_are_the_keys_that_would_not_be_refused() -> None:
    red = taken(armed(), "neutral_001", Colour.RED)
    offers = view(red).offers
    assert {Key.GO, Key.RETAKE, Key.OVERRULE, Key.FLAG, Key.DISARM} <= offers
    assert not offers & {Key.KEEP, Key.PREVIOUS, Key.STOP, Key.ABORT}
    counting = view(after(red, KeyPressed(at_s=0, key=Key.GO))).offers
    assert {Key.ABORT, Key.STOP, Key.DISARM} <= counting
    assert not counting & {Key.GO, Key.ARM, Key.NEXT, Key.SKIP, Key.JUMP}
