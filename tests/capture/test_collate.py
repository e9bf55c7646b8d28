"""Collation: whatever goes wrong, frames are filed under the trigger that exposed them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from capture.clock_model import ClockModel
from capture.collate import Collator, DeviceClock, TriggerTrain
from capture.devices.protocol import ClockKind, DeviceInfo, TriggerKind
from capture.devices.simulated import Fault, FaultKind, SimulatedSettings
from capture.errors import SettingsError
from capture.frame import FrameEvent
from capture.frame_header import ImageLayout
from capture.ledger import Oddity, Verdict
from capture.recorder import RecordSettings
from tests.capture.recording import array_of, cameras, misplaced, record, verdicts

PRE = RecordSettings().edge_triggers
PERIOD = RecordSettings().period_ns


def at(kind: FaultKind, trigger_index: int, amount_ns: int = 0) -> Fault:
    return Fault(kind, PRE + trigger_index, amount_ns)


def oddities(recording, device: str) -> list[Oddity]:  # type: ignore[no-untyped-def]
    return [r.oddity for r in recording.ledger.remarks if r.device == device]


@pytest.mark.parametrize("seed", range(6))
def test_without_faults_every_pair_is_ok_and_every_image_in_place(seed: int) -> None:
    recording, images = record(array_of(seed=seed))
    assert recording.ledger.counts()[Verdict.OK] == 80
    assert recording.ledger.remarks == ()
    assert len(images) == 80
    assert not misplaced(recording, images, cameras())


CASES = {
    "lost": ([at(FaultKind.LOSE_FRAME, 7)], {7: "lost"}, []),
    "lost in a row": ([at(FaultKind.LOSE_FRAME, k) for k in (7, 8, 9)],
                      dict.fromkeys((7, 8, 9), "lost"), []),
    "missed": ([at(FaultKind.MISS_TRIGGER, 7)], {7: "missed_trigger"}, []),
    "missed in a row": ([at(FaultKind.MISS_TRIGGER, k) for k in (3, 4)],
                        dict.fromkeys((3, 4), "missed_trigger"), []),
    "first lost": ([at(FaultKind.LOSE_FRAME, 0)], {0: "lost"}, []),
    "first missed": ([at(FaultKind.MISS_TRIGGER, 0)], {0: "missed_trigger"}, []),
    "last lost": ([at(FaultKind.LOSE_FRAME, 19)], {19: "lost"}, []),
    "last missed": ([at(FaultKind.MISS_TRIGGER, 19)], {19: "missed_trigger"}, []),
    "duplicate": ([at(FaultKind.DUPLICATE, 7)], {}, [Oddity.DUPLICATE]),
    "stale": ([at(FaultKind.STALE, 7)], {}, [Oddity.STALE]),
    "incomplete": ([at(FaultKind.INCOMPLETE, 7)], {7: "incomplete"}, []),
    "clock steps ahead": ([at(FaultKind.CLOCK_STEP, 7, 12_345_678_901)], {}, [Oddity.CLOCK_STEP]),
    "clock steps back": ([at(FaultKind.CLOCK_STEP, 7, -5_000_000_000)], {}, [Oddity.CLOCK_STEP]),
    "clock steps a third of a period": ([at(FaultKind.CLOCK_STEP, 7, PERIOD // 3)], {},
                                        [Oddity.CLOCK_STEP]),
    "clock steps two whole periods": ([at(FaultKind.CLOCK_STEP, 7, 2 * PERIOD)], {},
                                      [Oddity.CLOCK_STEP]),
    "clock steps back a whole period": ([at(FaultKind.CLOCK_STEP, 7, -PERIOD)], {},
                                        [Oddity.CLOCK_STEP]),
    "clock steps while a frame is lost": (
        [at(FaultKind.LOSE_FRAME, 7), at(FaultKind.CLOCK_STEP, 8, 999_999_999)],
        {7: "lost"}, [Oddity.CLOCK_STEP]),
    "numbers reset": ([at(FaultKind.ID_RESET, 7)], {}, [Oddity.ID_RESET]),
    "numbers reset and a trigger missed": (
        [at(FaultKind.MISS_TRIGGER, 6), at(FaultKind.ID_RESET, 7)], {6: "lost"}, [Oddity.ID_RESET]),
    "all at once": (
        [at(FaultKind.LOSE_FRAME, 2), at(FaultKind.MISS_TRIGGER, 5), at(FaultKind.DUPLICATE, 8),
         at(FaultKind.STALE, 11), at(FaultKind.INCOMPLETE, 14)],
        {2: "lost", 5: "missed_trigger", 14: "incomplete"}, [Oddity.DUPLICATE, Oddity.STALE]),
    "lost then missed": (
        [at(FaultKind.LOSE_FRAME, 7), at(FaultKind.MISS_TRIGGER, 8)],
        {7: "lost", 8: "missed_trigger"}, []),
    "silent": ([at(FaultKind.MISS_TRIGGER, k) for k in range(-PRE, 30)],
               dict.fromkeys(range(20), "missing"), []),
    "silent to the end": ([at(FaultKind.LOSE_FRAME, k) for k in range(15, 30)],
                          dict.fromkeys(range(15, 20), "missing"), []),
}  # fmt: skip


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("case", CASES)
def test_each_fault_gets_its_verdict_and_moves_no_other_frame(case: str, seed: int) -> None:
    faults, expected, odd = CASES[case]
    recording, images = record(array_of(seed=seed, faults={"cam02": faults}))
    assert verdicts(recording.ledger, "cam02") == expected
    assert oddities(recording, "cam02") == odd
    for other in ("cam00", "cam01", "cam03"):
        assert verdicts(recording.ledger, other) == {}
    assert sum(recording.ledger.counts().values()) == 80
    assert len(images) == 80 - len(expected)
    assert not misplaced(recording, images, cameras())


def check_random_faults(seed: int, faults_each: int) -> None:
    """Random faults of all kinds on six devices: every verdict and every image must be right."""
    rng = np.random.default_rng(seed)
    kinds = [
        FaultKind.LOSE_FRAME, FaultKind.MISS_TRIGGER, FaultKind.DUPLICATE, FaultKind.STALE,
        FaultKind.INCOMPLETE, FaultKind.CLOCK_STEP,
    ]  # fmt: skip
    faults: dict[str, list[Fault]] = {}
    for camera in cameras(6):
        edges = rng.choice(40, size=faults_each, replace=False)
        planned = [
            Fault(
                kinds[int(rng.integers(len(kinds)))], int(e), int(rng.integers(-(10**10), 10**10))
            )
            for e in edges
        ]
        # One reset a device: two in a row repeat a number, which is quarantined.
        faults[camera.name] = [replace(planned[0], kind=FaultKind.ID_RESET), *planned[1:]]
    recording, images = record(array_of(6, seed, faults), count=36)
    ledger = recording.ledger
    assert sum(ledger.counts().values()) == 36 * 6
    assert {(e.trigger_index, e.device) for e in ledger.entries if e.verdict == "ok"} == set(images)
    assert not misplaced(recording, images, cameras(6))
    hide = {FaultKind.LOSE_FRAME, FaultKind.MISS_TRIGGER, FaultKind.INCOMPLETE}
    for name, planned in faults.items():
        gone = {fault.edge - PRE for fault in planned if fault.kind in hide}
        assert set(verdicts(ledger, name)) == {k for k in gone if 0 <= k < 36}


@pytest.mark.parametrize("seed", range(25))
def test_the_ledger_is_exact_for_random_faults_on_all_devices(seed: int) -> None:
    check_random_faults(seed, 6)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(100, 500))
def test_the_ledger_is_exact_for_many_random_faults(seed: int) -> None:
    check_random_faults(seed, 8)


def test_frame_numbers_wrap_from_65535_to_1() -> None:
    settings = SimulatedSettings(id_bits=16)
    array = array_of(2, settings=settings)
    device = array.devices[0]
    device._number = 65530  # type: ignore[attr-defined]
    recording, images = record(array)
    ids = [e.frame_id for e in recording.ledger.entries if e.device == "cam00"]
    assert 65535 in ids
    assert 0 not in ids
    assert 1 in ids
    assert recording.ledger.counts()[Verdict.OK] == 40
    assert not misplaced(recording, images, cameras(2))


@pytest.mark.parametrize("latency_ms", [0.0, 30.0, 90.0])
def test_frames_that_arrive_periods_late_are_filed_all_the_same(latency_ms: float) -> None:
    array = array_of(3)
    slow = array.devices[1]
    slow._settings = replace(slow._settings, latency_ms=latency_ms)  # type: ignore[attr-defined]
    recording, images = record(array)
    assert recording.ledger.counts()[Verdict.OK] == 60
    assert not misplaced(recording, images, cameras(3))


def test_the_common_clock_agrees_over_devices_within_their_jitter() -> None:
    recording, _ = record(array_of(8), count=60)
    ledger = recording.ledger
    for k in range(60):
        times = [ledger.entry(k, name).t_ns - recording.train.time_ns(k) for name in ledger.devices]
        assert max(map(abs, times)) < 6000  # 6 sigma of a reading


def test_drift_is_measured() -> None:
    array = array_of(3)
    recording, _ = record(array, count=150)
    for device in array.devices:
        true = device._settings.clock.drift_ppm  # type: ignore[attr-defined]
        assert abs(recording.clocks[device.info.name].drift_ppm - true) < 1.0


INFO = DeviceInfo(
    name="cam00", serial="1", model="m", layout=ImageLayout(4, 4, 1, "uint8"), id_bits=16,
    triggers=(TriggerKind.HARDWARE,),
)  # fmt: skip


def collated(rows: list[tuple[int, float, float]]) -> Collator:
    """A device's frames: number, device time in periods, arrival in periods."""
    collator = Collator([INFO], TriggerTrain(0, 1000), {"cam00": DeviceClock(ClockModel(0, 0))})
    for row in rows:
        collator.add(frame(*row))
    return collator


def frame(frame_id: int, t_dev: float, t_host: float) -> FrameEvent:
    return FrameEvent("cam00", frame_id, round(1000 * t_dev), round(1000 * t_host), 0)


def test_a_device_that_restarts_numbers_and_clock_is_taken_up_again() -> None:
    before = [(100 + k, k, k + 0.5) for k in range(3)]
    after = [(1 + k, 0.3 + k - 1000, 5 + k + 0.5) for k in range(5)]  # triggers 5 to 9
    ledger = collated(before + after).ledger(0, 10)
    assert verdicts(ledger, "cam00") == {3: "lost", 4: "lost"}
    assert [r.oddity for r in ledger.remarks] == [Oddity.CLOCK_STEP, Oddity.ID_RESET]


def test_a_lost_frame_that_comes_late_is_stale() -> None:
    rows = [(1, 0, 0.5), (3, 2, 2.5), (2, 1, 2.6), (4, 3, 3.5)]
    ledger = collated(rows).ledger(0, 4)
    assert verdicts(ledger, "cam00") == {1: "lost"}
    assert [r.oddity for r in ledger.remarks] == [Oddity.STALE]


def test_a_clock_that_steps_before_the_first_frame_is_found_out_by_the_arrival() -> None:
    for step in (-7.0, 0.4, 25.0, 1e6):
        ledger = collated([(1 + k, k + step, k + 0.5) for k in range(10)]).ledger(0, 10)
        assert verdicts(ledger, "cam00") == {}
        assert [r.oddity for r in ledger.remarks] == [Oddity.CLOCK_STEP]


def test_a_stalled_host_does_not_make_missed_triggers_into_a_clock_step() -> None:
    rows = [(1, 0, 0.5), (2, 1, 1.5), (3, 2, 6.4), (4, 5, 6.5), (5, 6, 6.6), (6, 7, 7.5)]
    rows += [(7, 8, 8.5), (8, 9, 9.5)]
    ledger = collated(rows).ledger(0, 10)
    assert verdicts(ledger, "cam00") == {3: "missed_trigger", 4: "missed_trigger"}
    assert ledger.remarks == ()


def test_a_number_given_twice_is_quarantined() -> None:
    rows = [(1, 0, 0.5), (2, 1, 1.5), (2, 2, 2.5), (3, 3, 3.5)]
    ledger = collated(rows).ledger(0, 4)
    assert verdicts(ledger, "cam00") == {2: "quarantined"}
    assert [r.oddity for r in ledger.remarks] == [Oddity.DUPLICATE]


def test_some_lost_and_some_missed_is_counted_and_said() -> None:
    ledger = collated([(1, 0, 0.5), (3, 4, 4.5)]).ledger(0, 5)
    assert verdicts(ledger, "cam00") == {1: "lost", 2: "missed_trigger", 3: "missed_trigger"}
    assert ledger.entry(1, "cam00").note == "lost and missed in an unknown order"


def test_a_ledger_of_some_triggers_is_the_part_of_the_whole() -> None:
    gone = {3, 9, 20, 21, 35}
    rows = [(1 + k, k, k + 0.5) for k in range(60) if k not in gone]
    whole, window = collated(rows).ledger(0, 60), collated(rows).ledger(9, 20)
    for k in range(20):
        here, there = window.entry(k, "cam00"), whole.entry(9 + k, "cam00")
        assert (here.verdict, here.frame_id, here.t_dev_ns) == (
            there.verdict, there.frame_id, there.t_dev_ns,
        )  # fmt: skip
    assert verdicts(window, "cam00") == {0: "lost", 11: "lost", 12: "lost"}


def test_remarks_are_of_the_triggers_they_came_at() -> None:
    rows = [(1 + k, k + (5000 if k >= 7 else 0), k + 0.5) for k in range(20)]
    collator = collated(rows)
    assert [r.trigger_index for r in collator.ledger(0, 20).remarks] == [7]
    assert [r.trigger_index for r in collator.ledger(7, 5).remarks] == [0]
    assert collator.ledger(0, 7).remarks == collator.ledger(8, 12).remarks == ()


def test_forgetting_leaves_later_triggers_as_they_were() -> None:
    rows = [(1 + k, k + (5000 if k >= 31 else 0), k + 0.5) for k in range(80) if k % 9]
    collator, other = collated(rows), collated(rows)
    collator.forget(30)
    before, after = collator.ledger(30, 50), other.ledger(30, 50)
    assert (before.entries, before.remarks) == (after.entries, after.remarks)
    assert collator.clocks(30, 50) == other.clocks(30, 50)
    assert collator.add(frame(81, 5080, 80.5)) == other.add(frame(81, 5080, 80.5)) == 80


def test_a_device_found_again_is_placed_by_its_new_clock_and_its_absence_is_missing() -> None:
    collator = collated([(100 + k, k, k + 0.5) for k in range(3)])
    collator.restart("cam00", DeviceClock(ClockModel(-777_000, 0)))
    for k in range(10, 15):
        assert collator.add(frame(k - 9, k - 777, k + 0.5)) == k
    ledger = collator.ledger(0, 15)
    assert verdicts(ledger, "cam00") == dict.fromkeys(range(3, 10), "missing")
    assert ledger.remarks == ()


def test_numbers_that_count_from_0_wrap_to_0() -> None:
    info = replace(INFO, id_bits=32, first_id=0)
    collator = Collator([info], TriggerTrain(0, 1000), {"cam00": DeviceClock(ClockModel(0, 0))})
    for k in range(4):
        assert collator.add(frame((2**32 - 2 + k) % 2**32, k, k + 0.5)) == k
    assert collator.ledger(0, 4).remarks == ()


def test_a_clock_that_is_believed_shows_what_a_fitted_one_hides() -> None:
    late = [(1 + k, k + 0.1, k + 0.5) for k in range(10)]
    fitted = collated(late).ledger(0, 10)
    believed = Collator(
        [INFO], TriggerTrain(0, 1000), {"cam00": DeviceClock(ClockModel(0, 0), fitted=False)}
    )
    for row in late:
        believed.add(frame(*row))
    assert [e.t_ns for e in fitted.entries] == [1000 * k for k in range(10)]
    assert [e.t_ns for e in believed.ledger(0, 10).entries] == [1000 * k + 100 for k in range(10)]


def test_a_host_that_is_late_by_turns_does_not_hide_a_missed_trigger() -> None:
    lags = [0.1, 0.8, 0.9, 0.8, 0.7, 0.9, 0.8, 0.1]  # the last is sooner than most, and no jump
    rows = [(1 + k, k, k + lag) for k, lag in enumerate(lags[:-1])]
    rows += [(8, 8, 8 + lags[-1]), (9, 9, 9.2)]
    ledger = collated(rows).ledger(0, 10)
    assert verdicts(ledger, "cam00") == {7: "missed_trigger"}
    assert ledger.remarks == ()


@pytest.mark.parametrize("late", [0.4, 0.55, 0.7, 0.9, 1.4, 3.0])
def test_a_first_frame_that_the_host_dates_late_makes_no_later_one_stale(late: float) -> None:
    """A cold start: later frames come sooner after their exposure than any frame before."""
    rows = [(1, late, late + 0.1), *((1 + k, k, k + 0.1) for k in range(1, 40))]
    ledger = collated(rows).ledger(0, 40)
    first = min(e.trigger_index for e in ledger.entries if e.verdict == Verdict.OK)
    placed = [e.trigger_index for e in ledger.entries if e.frame_id > 0]
    assert placed == list(range(first, 40))
    assert {r.oddity for r in ledger.remarks} <= {Oddity.CLOCK_STEP}


@pytest.mark.parametrize("seed", range(5))
def test_dates_that_are_off_by_half_a_period_move_no_frame(seed: int) -> None:
    rng = np.random.default_rng(seed)
    off = rng.uniform(0.0, 0.6, 300)
    rows = [(1 + k, k + off[k], k + off[k] + 0.05) for k in range(300)]
    steps_told = {}
    for clock in (ClockKind.OWN, ClockKind.HOST):
        collator = Collator(
            [replace(INFO, clock=clock)], TriggerTrain(0, 1000),
            {"cam00": DeviceClock(ClockModel(0, 0), fitted=clock == ClockKind.OWN)},
        )  # fmt: skip
        places = [collator.add(frame(*row)) for row in rows]
        assert places == list(range(places[0] or 0, (places[0] or 0) + 300))
        remarks = collator.ledger(0, 300).remarks
        assert {r.oddity for r in remarks} <= {Oddity.CLOCK_STEP}
        steps_told[clock] = len(remarks)
    # The host's own clock does not jump by a third of a period: its driver was late.
    assert steps_told[ClockKind.HOST] < 30 < steps_told[ClockKind.OWN]


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2, 3))])
def test_a_device_that_was_silent_for_an_hour_is_filed_with_the_others(seed: int) -> None:
    """The generator and the clocks are off by a hundred millionths: 3.6 periods in that time."""
    rng = np.random.default_rng(seed)
    period, hour = 100_000_000, 36_000
    true_ns = period * (1 + rng.choice([-1e-4, 1e-4]))
    infos = [replace(INFO, name=name, id_bits=32) for name in ("cam00", "cam01", "cam02")]
    drifts = dict(zip((info.name for info in infos), rng.uniform(-4e-5, 4e-5, 3), strict=True))
    clocks = {info.name: DeviceClock(ClockModel(0, 0)) for info in infos}
    collator = Collator(infos, TriggerTrain(0, period), clocks)
    missed = 0
    for k in range(hour + 1200):
        for place, (name, drift) in enumerate(drifts.items()):
            if place == 1 and 1000 <= k < hour + 1000:
                missed += 1
                continue
            t_ns = round(k * true_ns + rng.normal(0, 1000))
            late_ns = 20_000_000 + round(abs(rng.normal(0, 2e6)))
            event = FrameEvent(
                name, 1 + k - (missed if place == 1 else 0), round(t_ns * (1 + drift)),
                t_ns + late_ns, 0,
            )  # fmt: skip
            assert collator.add(event) == k
        if k % 5 == 0:
            collator.follow()
        if k % 256 == 0:
            collator.forget(k - 300)
    assert collator.ledger(hour + 900, 200).remarks == ()


def test_a_train_without_a_period_is_refused() -> None:
    with pytest.raises(SettingsError, match="found 0 ns"):
        TriggerTrain(0, 0)
