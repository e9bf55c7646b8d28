"""The ledger's sums, its file, and the judgement drawn from it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from capture.errors import SettingsError, TakeError
from capture.judgement import Colour, judge
from capture.ledger import (
    Ledger,
    LedgerEntry,
    Oddity,
    Remark,
    Verdict,
    all_present,
    read_ledger,
    write_ledger,
)  # fmt: skip
from tests.capture.refusals import refusal

NAMES = ("cam00", "cam01", "cam02")


def ledger(
    broken: dict[tuple[int, str], Verdict], spread_ns: int = 0, triggers: int = 10
) -> Ledger:
    entries = []
    for k in range(triggers):
        for place, name in enumerate(NAMES):
            verdict = broken.get((k, name), Verdict.OK)
            t_ns = 1000 * k + (spread_ns if place == 1 else 0)
            entries.append(
                LedgerEntry(k, name, verdict, 7, 8, 9, t_ns) if verdict == Verdict.OK
                else LedgerEntry(k, name, verdict, note="why")
            )  # fmt: skip
    return Ledger(NAMES, triggers, tuple(entries))


def test_every_pair_has_exactly_one_verdict() -> None:
    whole = ledger({(3, "cam01"): Verdict.LOST})
    assert sum(whole.counts().values()) == 30
    assert whole.counts()[Verdict.LOST] == 1
    assert whole.entry(3, "cam01").verdict == Verdict.LOST
    assert list(whole.incomplete()) == [3]
    for entries in (whole.entries[:-1], whole.entries[::-1], whole.entries + whole.entries[-1:]):
        with pytest.raises(
            TakeError, match="exactly one verdict for each of 10 triggers x 3 devices"
        ):
            replace(whole, entries=entries)


def test_the_file_survives_the_round_trip(tmp_path: Path) -> None:
    remarks = (Remark("cam00", Oddity.STALE, 4, 77), Remark("cam01", Oddity.CLOCK_STEP, -1, 3))
    whole = replace(ledger({(3, "cam01"): Verdict.MISSED_TRIGGER}), remarks=remarks)
    write_ledger(tmp_path / "ledger.csv", whole)
    again = read_ledger(tmp_path / "ledger.csv")
    assert (again.devices, again.triggers) == (NAMES, 10)
    assert again.entries == whole.entries
    assert again.remarks == remarks


def test_a_damaged_file_is_refused_with_the_line(tmp_path: Path) -> None:
    path = tmp_path / "ledger.csv"
    write_ledger(path, all_present(NAMES, 4))
    lines = path.read_text().splitlines()
    for number, line, words in (
        (0, "a,b", "expected a ledger with columns trigger_index, device"),
        (3, "0,cam02,perhaps,0,-1,-1,-1,", "ledger.csv:4: not a line of a ledger"),
        (3, "0,cam02", "ledger.csv:4: not a line of a ledger"),
        (3, "", "ledger.csv:4: not a line of a ledger"),
        (3, lines[2], "expected exactly one verdict"),
    ):
        path.write_text("\n".join([*lines[:number], line, *lines[number + 1 :]]) + "\n")
        with pytest.raises(TakeError) as caught:
            read_ledger(path)
        assert words in str(caught.value)
    path.write_text(lines[0] + "\n")
    with pytest.raises(TakeError, match="holds no verdict"):
        read_ledger(path)


@settings(max_examples=80, deadline=None)
@given(st.binary(max_size=200))
def test_any_bytes_are_refused_and_never_crash(
    tmp_path_factory: pytest.TempPathFactory, data: bytes
) -> None:
    path = tmp_path_factory.mktemp("ledger") / "ledger.csv"
    write_ledger(path, all_present(NAMES, 1))
    head = path.read_bytes().splitlines(keepends=True)[0]
    path.write_bytes(head + data)
    assert "ledger.csv" in refusal(lambda: read_ledger(path))


@pytest.mark.parametrize(
    ("broken", "spread_ns", "hold", "colour", "words"),
    [
        ({}, 0, None, "green", "All 10 frame sets of 3 devices are complete."),
        ({(3, "cam01"): Verdict.LOST}, 0, None, "amber",
         "1 of 10 frame sets are not complete (frame 3 of cam01 was lost in transport). "
         "The take can be used."),
        ({(3, "cam01"): Verdict.LOST, (7, "cam02"): Verdict.MISSED_TRIGGER}, 0, None, "amber",
         "cam02 missed the trigger of frame 7"),
        ({(3, "cam01"): Verdict.LOST, (3, "cam02"): Verdict.LOST}, 0, None, "amber", "1 of 10"),
        ({(3, "cam01"): Verdict.LOST, (4, "cam02"): Verdict.LOST}, 0, None, "red",
         "some of them neighbours"),
        ({(3, "cam01"): Verdict.LOST}, 0, (2, 5), "red", "in the hold"),
        ({(3, "cam01"): Verdict.LOST}, 0, (4, 5), "amber", "can be used"),
        ({(k, "cam01"): Verdict.MISSING for k in (1, 3, 5, 7)}, 0, None, "red",
         "cam01 sent nothing for frame 5 and 1 more). Take it again."),
        ({}, 9_000, None, "green", "complete"),
        ({}, 20_000, None, "amber", "Devices exposed up to 20 us apart. The take can be used."),
        ({}, 2_000_000, None, "red", "Devices exposed up to 2000 us apart. Take it again."),
    ],
)  # fmt: skip
def test_the_judgement_is_one_colour_and_one_sentence(
    broken: dict[tuple[int, str], Verdict],
    spread_ns: int,
    hold: tuple[int, int] | None,
    colour: str,
    words: str,
) -> None:
    verdict = judge(ledger(broken, spread_ns), hold)
    assert verdict.colour == colour
    assert words in verdict.sentence
    assert verdict.spread_ns == spread_ns


def test_a_jump_of_a_clock_makes_amber() -> None:
    odd = replace(ledger({}), remarks=(Remark("cam01", Oddity.CLOCK_STEP, 2, 5),))
    assert judge(odd).colour == Colour.AMBER
    assert "The clock or the frame numbers of cam01 jumped." in judge(odd).sentence
    only_extra = replace(ledger({}), remarks=(Remark("cam01", Oddity.DUPLICATE, 2, 5),))
    assert judge(only_extra).colour == Colour.GREEN


def test_a_hold_outside_the_take_is_refused() -> None:
    with pytest.raises(SettingsError, match=r"hold must lie within frames 0\.\.9, found \(3, 10\)"):
        judge(ledger({}), (3, 10))
