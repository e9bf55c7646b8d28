"""What the console shows: words that carry the meaning without colour, within the width."""

from __future__ import annotations

from dataclasses import replace

import pytest

from capture.judgement import Colour
from capture.rom.state import Stage
from capture.rom.view import Cue
from tests.tools.terminal.views import armed, device
from tools.terminal import cards
from tools.terminal.keys import KEYS


def test_a_tile_says_the_colour_in_words_with_age_losses_and_memory() -> None:
    text = cards.device_tiles(armed().devices, 78).plain
    assert "cam01 green 0.0s   0  3%" in text
    assert "cam03 RED   2.1s   7  3%" in text
    assert "cam10 amber 0.0s   7  3%" in text


@pytest.mark.parametrize("width", [26, 40, 78, 118, 198])
@pytest.mark.parametrize("count", [1, 3, 16, 32])
def test_every_device_has_a_tile_within_the_width(width: int, count: int) -> None:
    text = cards.device_tiles([device(f"cam{n:02d}") for n in range(count)], width).plain
    assert all(len(line) <= width for line in text.split("\n"))
    assert all(text.count(f"cam{n:02d} ") == 1 for n in range(count))


@pytest.mark.parametrize(
    ("age_s", "not_ok", "words"),
    [
        (None, 0, "    -   0"),
        (0.5, 999, " 0.5s 999"),
        (12.3, 1000, "  12s  1k"),
        (9999.0, 99_999, " 999s 99k"),
    ],
)
def test_a_tile_keeps_its_width(age_s: float | None, not_ok: int, words: str) -> None:
    one = replace(device("cam01", age_s=age_s), not_ok=not_ok, taken=500)
    text = cards.device_tiles([one], 78).plain
    assert f"cam01 green{words} 99%" in text


def test_the_bar_has_a_hold_that_fills() -> None:
    view = replace(armed(), stage=Stage.RECORD, cue=Cue.HOLD, fraction=0.5)
    bar = cards.hold_bar(view, 56).plain
    assert bar.startswith("HOLD ")
    assert bar[16:] == "━" * 10 + "█" * 10 + "░" * 10 + "─" * 10
    # The end is reached, and no cell more.
    full = cards.hold_bar(replace(view, fraction=1.0, cue=Cue.RELAX), 56).plain
    assert full[16:] == "━" * 10 + "█" * 20 + "━" * 10


def test_the_big_number_counts_down_and_then_the_seconds_left() -> None:
    assert cards.big_number(armed()) == ""
    assert cards.big_number(replace(armed(), stage=Stage.COUNTDOWN, countdown=3)) == "3"
    assert cards.big_number(replace(armed(), stage=Stage.RECORD, fraction=0.25)) == "1.5"


def test_a_take_says_verdict_decision_rating_progress_and_note_and_brackets_are_text() -> None:
    text = cards.take_list(armed(), "smile_002", 120, 5).plain
    newest, oldest = text.split("\n")
    assert newest.startswith(">smile_002 green  ****")
    assert "checking 45%" in newest
    assert '"good [teeth]"' in newest
    assert oldest.startswith(" smile_001 RED retake  (old) cam03 sent nothing")


def test_the_list_stays_around_the_chosen_take() -> None:
    one = armed().takes[0]
    takes = tuple(replace(one, name=f"smile_{n:03d}") for n in range(1, 31))
    view = replace(armed(), takes=takes)
    for name in ("smile_001", "smile_015", "smile_030"):
        lines = cards.take_list(view, name, 60, 5).plain.split("\n")
        assert len(lines) == 5
        assert sum(line.startswith(f">{name}") for line in lines) == 1
        assert all(len(line) <= 60 for line in lines)


def test_the_chosen_take_says_in_full_why_it_is_red() -> None:
    why = "The program ended before it was written and read back; run `likeness recover`."
    red = replace(armed().takes[0], colour=Colour.RED, sentence=why)
    others = tuple(replace(red, name=f"jaw_{n:03d}", colour=Colour.GREEN) for n in range(1, 9))
    view = replace(armed(), takes=(*others, replace(red, name="smile_009")))
    lines = cards.take_list(view, "smile_009", 40, 5).plain.split("\n")
    assert len(lines) == 5
    assert why in " ".join(line.strip() for line in lines)
    assert lines[-1].startswith(" jaw_00")
    last = cards.take_list(view, "smile_009", 40, 1).plain
    assert last.startswith(">smile_009 RED")


def test_messages_name_devices_in_trouble_first_and_findings_with_remedies() -> None:
    view = replace(armed(), stage=Stage.PREFLIGHT)
    lines = cards.message_lines(view, 80, 10).plain.split("\n")
    assert lines[:2] == [
        "cam03 is red: silent for 2.1 s",
        "cam10 is amber: 60 of 100 frames of memory in use",
    ]
    assert lines[2] == "red: cam07: link carries 1 Gbit/s -> use 10GigE"
    assert lines[3:5] == ["!! Lost: cam03.", "The array is armed."]


def test_many_devices_in_trouble_share_a_line() -> None:
    many = [device(f"cam{n:02d}", Colour.AMBER, "silent for 60 ms") for n in range(1, 17)]
    one = device("cam17", Colour.RED, "no frame yet", None)
    assert cards.device_troubles([*many, one]) == [
        "cam17 is red: no frame yet",
        "cam01, cam02, cam03 and 13 more are amber: silent for 60 ms",
    ]


def test_the_top_line_tells_stage_progress_and_room_on_disk() -> None:
    text = cards.top_line(armed(), 80).plain
    assert text.startswith(" ARMED  anna_day1   0/2 prompts done   94 takes left")
    assert "check amber" in text
    assert len(cards.top_line(armed(), 30).plain) == 30


def test_the_key_line_fits_two_lines_of_80_and_dims_what_would_be_refused() -> None:
    hints = cards.key_hints(armed(), 78)
    lines = hints.plain.split("\n")
    assert len(lines) == 2
    assert all(len(line) <= 78 for line in lines)
    assert all(f"{hint.shown} {hint.word}" in hints.plain for hint in KEYS)
    dim = {hints.plain[s.start : s.end] for s in hints.spans if s.style == "dim"}
    assert "k" in dim
    assert "space" not in dim


def test_colours_have_words_everywhere() -> None:
    for colour in Colour:
        tile = cards.device_tiles([device("cam01", colour, "why")], 40).plain
        assert str(colour) in tile.lower()
