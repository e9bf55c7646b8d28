"""The book of faults: what a trigger becomes, against a literal count."""

from __future__ import annotations

import numpy as np
import pytest

from capture.devices.faults import Exposure, Fault, FaultBook, FaultKind
from capture.errors import SettingsError

PERIOD = 10_000_000


def run(book: FaultBook, triggers: int, first: int = 1, start: int = 0) -> list[Exposure]:
    """What is sent of exposures numbered from `first`, dated by the true time."""
    sent: list[Exposure] = []
    for k in range(start, start + triggers):
        t_ns = k * PERIOD
        sent += book.trigger(t_ns, Exposure(k, t_ns, first + k, t_ns, 1000.0)).sent
    return sent


def test_without_faults_everything_is_sent_as_it_is() -> None:
    assert run(FaultBook(16), 3) == [
        Exposure(k, k * PERIOD, 1 + k, k * PERIOD, 1000.0) for k in range(3)
    ]


@pytest.mark.parametrize(
    ("wraps_to", "after"), [(1, [65534, 65535, 1, 2]), (0, [65534, 65535, 0, 1])]
)
def test_numbers_wrap(wraps_to: int, after: list[int]) -> None:
    assert [sent.number for sent in run(FaultBook(16, wraps_to), 4, first=65534)] == after


def test_planned_faults_happen_after_every_start_and_injected_ones_once() -> None:
    book = FaultBook(16, planned=(Fault(FaultKind.LOSE_FRAME, 1),))
    book.inject(Fault(FaultKind.LOSE_FRAME, 3))
    assert [sent.place for sent in run(book, 5)] == [0, 2, 4]
    book.begin()
    assert [sent.place for sent in run(book, 5)] == [0, 2, 3, 4]


def test_the_next_trigger_is_the_one_after_the_call() -> None:
    for edge in (None, -1):
        book = FaultBook(16)
        run(book, 2)
        book.inject(Fault(FaultKind.LOSE_FRAME, edge))
        assert [sent.place for sent in run(book, 3, start=2)] == [3, 4]


def test_a_fault_injected_between_two_runs_hits_the_first_trigger_of_the_next() -> None:
    book = FaultBook(16)
    run(book, 4)
    book.inject(Fault(FaultKind.LOSE_FRAME))
    book.begin()
    assert [sent.place for sent in run(book, 3)] == [1, 2]


def test_a_freeze_that_is_cut_off_by_a_stop_is_over() -> None:
    book = FaultBook(16)
    book.inject(Fault(FaultKind.FREEZE, 2, triggers=100))
    assert len(run(book, 5)) == 2
    book.begin()
    assert len(run(book, 5)) == 5


def test_a_missed_trigger_takes_no_number_and_a_lost_frame_does() -> None:
    missed = run(FaultBook(16, planned=(Fault(FaultKind.MISS_TRIGGER, 1, triggers=2),)), 5)
    assert [(sent.place, sent.number) for sent in missed] == [(0, 1), (3, 2), (4, 3)]
    lost = run(FaultBook(16, planned=(Fault(FaultKind.LOSE_FRAME, 1, triggers=2),)), 5)
    assert [(sent.place, sent.number) for sent in lost] == [(0, 1), (3, 4), (4, 5)]


def test_numbers_that_begin_again_wait_for_an_exposure() -> None:
    faults = (Fault(FaultKind.ID_RESET, 2), Fault(FaultKind.MISS_TRIGGER, 2))
    assert [sent.number for sent in run(FaultBook(16, planned=faults), 5, first=70)] == [
        70, 71, 1, 2,
    ]  # fmt: skip


def test_numbers_jump_to_just_below_the_wrap() -> None:
    book = FaultBook(16, planned=(Fault(FaultKind.ID_JUMP, 1),))
    assert [sent.number for sent in run(book, 6)] == [1, 65532, 65533, 65534, 65535, 1]
    assert [s.number for s in run(FaultBook(64, planned=(Fault(FaultKind.ID_JUMP, 1),)), 6)] == [
        1, 65532, 65533, 65534, 65535, 65536,
    ]  # fmt: skip


def test_a_clock_steps_and_drifts_from_the_trigger_on_without_a_second_step() -> None:
    planned = (
        Fault(FaultKind.CLOCK_STEP, 2, 500),
        Fault(FaultKind.CLOCK_DRIFT, 3, drift_ppm=100.0),
        Fault(FaultKind.CLOCK_DRIFT, 5, drift_ppm=-200.0),
    )
    off = [sent.t_dev_ns - sent.t_ns for sent in run(FaultBook(16, planned=planned), 8)]
    assert off == [0, 0, 500, 500, 1500, 2500, 1500, 500]  # 100 ppm of 10 ms are 1000 ns


def test_the_dead_stay_silent_until_they_are_revived_and_then_begin_anew() -> None:
    book = FaultBook(16, planned=())
    book.inject(Fault(FaultKind.DEATH, 2))
    assert [sent.number for sent in run(book, 6, first=900)] == [900, 901]
    assert book.dead
    book.revive(back_ns=6 * PERIOD)
    back = run(book, 3, first=900, start=6)
    assert [(sent.number, sent.t_dev_ns) for sent in back] == [
        (1, 0), (2, PERIOD), (3, 2 * PERIOD),
    ]  # fmt: skip


def test_a_stale_frame_is_that_of_two_triggers_ago() -> None:
    sent = run(FaultBook(16, planned=(Fault(FaultKind.STALE, 3),)), 5)
    assert [exposure.place for exposure in sent] == [0, 1, 2, 3, 1, 4]


def test_where_a_recording_has_a_gap_nothing_is_sent_and_triggers_are_counted() -> None:
    book = FaultBook(16, planned=(Fault(FaultKind.MISS_TRIGGER, 1), Fault(FaultKind.LOSE_FRAME, 2)))
    assert not book.trigger(0, None).exposed
    assert not book.trigger(PERIOD, None).exposed  # nothing there to be missed: no number shifts
    assert run(book, 1, start=2) == []
    assert [sent.number for sent in run(book, 1, start=3)] == [4]


@pytest.mark.parametrize("seed", range(20))
def test_any_mixture_counts_as_a_literal_count_does(seed: int) -> None:
    rng = np.random.default_rng(seed)
    kinds = (FaultKind.LOSE_FRAME, FaultKind.MISS_TRIGGER, FaultKind.FREEZE, FaultKind.DUPLICATE)
    planned = tuple(
        Fault(kinds[int(rng.integers(4))], int(edge), triggers=int(rng.integers(1, 4)))
        for edge in rng.choice(60, size=10, replace=False)
    )
    expected, number = [], 10
    for k in range(60):
        here = {f.kind for f in planned if f.edge <= k < f.edge + f.triggers}  # type: ignore[operator]
        if FaultKind.MISS_TRIGGER in here:
            continue
        if not here & {FaultKind.LOSE_FRAME, FaultKind.FREEZE}:
            expected += [(k, number)] * (2 if FaultKind.DUPLICATE in here else 1)
        number += 1
    sent = run(FaultBook(16, planned=planned), 60, first=10)
    assert [(exposure.place, exposure.number) for exposure in sent] == expected


def test_faults_that_cannot_be_are_refused() -> None:
    with pytest.raises(SettingsError, match="counted from 0, or None or -1 for the next one"):
        Fault(FaultKind.LOSE_FRAME, -2)
    with pytest.raises(SettingsError, match="at least 1 trigger, found 0"):
        Fault(FaultKind.FREEZE, triggers=0)
    with pytest.raises(SettingsError, match=r"drift_ppm must lie in -1000\.\.1000, found 2000"):
        Fault(FaultKind.CLOCK_DRIFT, drift_ppm=2000.0)
    book = FaultBook(16)
    run(book, 5)
    with pytest.raises(SettingsError, match="trigger 4 has passed; the next one is 5"):
        book.inject(Fault(FaultKind.LOSE_FRAME, 4))
