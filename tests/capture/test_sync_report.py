"""The sync report finds offsets, jumps, drift and jitter that were put in, and nothing else."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from capture.clock_model import ClockModel, fit_model
from capture.devices.protocol import ClockSample
from capture.errors import SettingsError
from capture.frame import Clock
from capture.judgement import Colour
from capture.ledger import Ledger, Oddity, Remark
from capture.sync_report import SyncReport, set_times, sync_report
from tests.capture.recording import array_of, record
from tests.capture.sync_cases import PERIOD_NS, PERIOD_US, START_NS, ledger_of, names, quiet

CRYSTAL = ClockModel(0, 0)


def report(ledger: Ledger, basis: str = "ptp", ppm: float = 0.0) -> SyncReport:
    clocks = {name: replace(CRYSTAL, rate=1.0 + ppm * 1e-6) for name in ledger.devices}
    return sync_report(ledger, clocks, PERIOD_NS, basis)


def kinds(made: SyncReport) -> list[tuple[str, tuple[str, ...]]]:
    return [(finding.kind, finding.devices) for finding in made.findings]


@pytest.mark.parametrize("seed", range(20))
def test_a_quiet_array_is_green_and_has_no_findings(seed: int) -> None:
    made = report(ledger_of(quiet(seed=seed, devices=16)))
    assert made.colour == Colour.GREEN, made.sentence
    assert kinds(made) == []
    assert re.fullmatch(r"All 16 devices exposed within [12]\.\d us\.", made.sentence)


def test_numbers_are_those_of_the_literal_form() -> None:
    late = quiet(frames=60, devices=5, sigma_us=3.0, seed=4)
    late[:, 2] += 8.0
    lost = {(7, 1), (30, 4)}
    made = report(ledger_of(late, lost=lost))
    rows = [late[k] for k in range(60) if k not in (7, 30)]
    spreads = [max(row) - min(row) for row in rows]
    assert made.sets == 58
    assert made.spread_median_us == pytest.approx(np.median(spreads), abs=0.01)
    assert made.spread_p95_us == pytest.approx(np.percentile(spreads, 95), abs=0.01)
    assert made.spread_max_us == pytest.approx(max(spreads), abs=0.01)
    apart = [row[2] - np.median(row) for row in rows]
    device = made.devices[2]
    assert (device.device, device.frames) == ("cam02", 60)
    assert device.offset_us == pytest.approx(np.median(apart), abs=0.01)
    assert device.jitter_us == pytest.approx(
        np.sqrt(np.mean((apart - np.median(apart)) ** 2)), abs=0.01
    )
    assert made.period_measured_us == pytest.approx(PERIOD_US, abs=0.1)


@pytest.mark.parametrize(
    ("offset_us", "colour"), [(6.0, "green"), (43.0, "amber"), (400.0, "amber"), (1500.0, "red")]
)
def test_one_device_off_is_named_with_its_offset(offset_us: float, colour: str) -> None:
    late = quiet()
    late[:, 3] += offset_us
    made = report(ledger_of(late))
    assert made.colour == colour
    assert made.devices[3].offset_us == pytest.approx(offset_us, abs=0.3)
    if offset_us > 10:
        assert kinds(made) == [("offset", ("cam03",))]
        assert made.sentence.startswith("cam03 exposes ")
        assert "after the others" in made.sentence
        assert made.sentence.endswith("Take it again." if colour == "red" else "can be used.")


def test_one_device_a_period_late_is_red_whatever_its_phase_says() -> None:
    late = quiet()
    late[:, 1] += PERIOD_US + 30
    made = report(ledger_of(late))
    assert kinds(made) == [("period_late", ("cam01",))]
    assert made.sentence == (
        "cam01 is one trigger late: its frames lie +13.36 ms from the others', its images show "
        "another instant. Take it again."
    )
    assert made.findings[0].remedies[0].startswith("Run the flash check")


def test_frames_that_arrive_a_period_later_are_suspected() -> None:
    made = report(ledger_of(quiet(), lag_us=np.array([0, 0, 0, PERIOD_US, 500.0, 0])))
    assert kinds(made) == [("arrives_late", ("cam03",))]
    assert made.colour == Colour.AMBER


@pytest.mark.parametrize("basis", ["ptp", "model"])
@pytest.mark.parametrize(("cut", "size_us"), [(75, 40.0), (20, -200.0), (140, 2000.0)])
def test_a_step_of_one_clock_is_found_where_it_was(basis: str, cut: int, size_us: float) -> None:
    late = quiet(seed=3)
    late[cut + 1 :, 4] += size_us
    if basis == "model":
        late[:, 4] -= np.polyval(np.polyfit(np.arange(150), late[:, 4], 1), np.arange(150))
    made = report(ledger_of(late), basis)
    assert ("device_step", ("cam04",)) in kinds(made)
    step = next(f for f in made.findings if f.kind == "device_step")
    assert f"after frame {cut}." in step.sentence
    assert {name for _, devices in kinds(made) for name in devices} == {"cam04"}
    assert step.colour == ("red" if abs(size_us) > 1000 else "amber")


def test_a_step_of_all_clocks_leaves_the_spread_alone() -> None:
    late = quiet()
    late[60:] += 700.0
    made = report(ledger_of(late))
    assert kinds(made)[0] == ("array_step", ())
    assert "by 700 us after frame 59" in made.findings[0].sentence
    assert made.spread_max_us < 3
    assert made.colour == Colour.AMBER


def test_one_late_trigger_is_no_step() -> None:
    late = quiet()
    late[60] += 700.0
    assert kinds(report(ledger_of(late))) == []


def test_jumps_that_the_collator_saw_are_told() -> None:
    one = (Remark("cam02", Oddity.CLOCK_STEP, 40, 41),)
    assert kinds(report(ledger_of(quiet(), remarks=one))) == [("device_step", ("cam02",))]
    all_of_them = tuple(Remark(name, Oddity.CLOCK_STEP, 40, 41) for name in names(6))
    assert kinds(report(ledger_of(quiet(), remarks=all_of_them))) == [("array_step", ())]


def test_a_clock_that_does_not_follow_runs_away() -> None:
    late = quiet()
    late[:, 5] += 50e-6 * PERIOD_US * np.arange(150)  # 50 ppm over 2 s: 99 us
    made = report(ledger_of(late))
    assert kinds(made) == [("runaway", ("cam05",))]
    assert made.devices[5].drift_ppm == pytest.approx(50.0, abs=0.5)
    assert "+50.0 parts in a million" in made.sentence


def test_drift_beyond_100_ppm_is_told_and_below_is_not() -> None:
    ledger = ledger_of(quiet())
    clocks = {name: replace(CRYSTAL, rate=1 + 60e-6) for name in ledger.devices}
    assert kinds(sync_report(ledger, clocks, PERIOD_NS, "model")) == []
    clocks["cam01"] = replace(CRYSTAL, rate=1 - 130e-6)
    made = sync_report(ledger, clocks, PERIOD_NS, "model")
    assert kinds(made) == [("drift", ("cam01",))]
    assert made.devices[1].drift_ppm == pytest.approx(-130)
    assert "runs -130 parts in a million off" in made.sentence


def test_jitter_and_odd_frames_are_told_apart() -> None:
    late = quiet()
    late[:, 0] = np.random.default_rng(1).normal(0, 30, 150)
    late[83, 3] += 240.0
    made = report(ledger_of(late))
    assert kinds(made) == [("odd_frames", ("cam03",)), ("jitter", ("cam00",))] or kinds(made) == [
        ("jitter", ("cam00",)),
        ("odd_frames", ("cam03",)),
    ]
    odd = next(f for f in made.findings if f.kind == "odd_frames")
    assert odd.sentence == "1 frame of cam03 lie up to 240 us from their place, worst frame 83."
    assert (made.devices[3].worst_index, made.worst_index) == (83, 83)


def test_two_groups_are_told_as_one_thing() -> None:
    late = quiet(devices=8)
    late[:, :3] -= 300.0
    made = report(ledger_of(late))
    assert kinds(made) == [("groups", ("cam00", "cam01", "cam02"))]
    assert "cam00, cam01 and cam02 expose 300 us before the others" in made.sentence


def test_a_wrong_rate_and_a_coarse_clock() -> None:
    late = quiet() + (0.001 * PERIOD_US * np.arange(150))[:, None]
    made = report(ledger_of(late))
    assert kinds(made) == [("period", ())]
    assert "74.925 Hz instead of 75.000 Hz" in made.sentence
    made = report(ledger_of(quiet(), tick_ns=1_000_000))
    assert {kind for kind, _ in kinds(made)} == {"coarse_clock"}


def test_a_device_without_frames_leaves_no_set() -> None:
    ledger = ledger_of(quiet(frames=20), lost={(k, 2) for k in range(20)})
    made = report(ledger)
    assert kinds(made) == [("silent", ("cam02",))]
    assert made.colour == Colour.RED
    assert made.sentence.startswith("cam02 has no good frame in the take. No frame set is complete")
    json.dumps(made.document(), allow_nan=False)


def test_few_frames_are_no_trouble() -> None:
    for frames in (1, 2, 3, 7):
        made = report(ledger_of(quiet(frames=frames)))
        assert made.colour == Colour.GREEN
        json.dumps(made.document(), allow_nan=False)


def model_case(delays_us: list[float], seed: int) -> SyncReport:
    """Own clocks fitted to the triggers, and readings of them taken half a second before."""
    rng = np.random.default_rng(seed)
    start = 10_000_000_000
    triggers = [start + k * PERIOD_NS for k in range(150)]
    clocks: dict[str, ClockModel] = {}
    readings: dict[str, list[ClockSample]] = {}
    for place, (name, delay) in enumerate(zip(names(len(delays_us)), delays_us, strict=True)):
        clock = Clock(
            offset_ns=int(rng.integers(0, 10**12)), drift_ppm=float(rng.uniform(-40, 40)),
            jitter_ns=1000.0, seed=seed * 100 + place,
        )  # fmt: skip
        exposed = [clock.read(t + round(1000 * delay)) for t in triggers]
        clocks[name] = fit_model(exposed, triggers)
        readings[name] = []
        for k in range(16):
            before = start - 500_000_000 + k * 2_000_000
            trip = int(rng.integers(60_000, 400_000))
            read = clock.read(before + round(trip * float(rng.uniform(0.2, 0.8))))
            readings[name].append(ClockSample(read, before, before + trip))
    ledger = ledger_of(quiet(devices=len(delays_us), seed=seed))
    return sync_report(ledger, clocks, PERIOD_NS, "model", readings)


@pytest.mark.parametrize("seed", range(10))
def test_readings_bound_a_constant_delay_of_a_fitted_clock(seed: int) -> None:
    delays = [0.0, 0.0, 900.0, 0.0, -4000.0, 0.0]
    made = model_case(delays, seed)
    for device, delay in zip(made.devices, delays, strict=True):
        assert abs(device.offset_us - delay) <= device.offset_error_us
        assert 5 < device.offset_error_us < 150
    assert ("offset", ("cam04",)) in kinds(made)
    assert ("offset", ("cam02",)) in kinds(made)
    assert {name for _, devices in kinds(made) for name in devices} == {"cam02", "cam04"}


@pytest.mark.parametrize("seed", range(10))
def test_readings_of_a_good_array_raise_no_alarm(seed: int) -> None:
    made = model_case([0.0] * 6, seed)
    assert kinds(made) == []
    assert made.colour == Colour.GREEN
    assert "A constant delay of one device is seen only above " in made.sentence


def test_a_fitted_clock_does_not_claim_an_offset() -> None:
    made = report(ledger_of(quiet()), "model")
    assert all(np.isnan(device.offset_us) for device in made.devices)
    assert made.document()["devices"][0]["offset_us"] is None
    assert "cannot be seen without PTP: run the flash check." in made.sentence


def test_a_simulated_take_is_green_and_its_drift_is_found() -> None:
    array = array_of(5, seed=3)
    recording, _ = record(array, 60)
    made = sync_report(recording.ledger, recording.clocks, PERIOD_NS, "model")
    assert made.colour == Colour.GREEN, made.findings
    assert made.findings == ()
    assert all(0.3 < device.jitter_us < 3 for device in made.devices)
    assert max(abs(device.drift_ppm) for device in made.devices) < 41


def test_wrong_calls_are_refused() -> None:
    ledger = ledger_of(quiet(frames=3))
    with pytest.raises(SettingsError, match="basis must be one of ptp, host, model, found 'gps'"):
        sync_report(ledger, {}, PERIOD_NS, "gps")
    with pytest.raises(SettingsError, match="needs a period above 0"):
        sync_report(ledger, {}, 0, "ptp")


def test_times_since_1970_keep_their_nanoseconds() -> None:
    times = set_times(ledger_of(np.array([[0.0, 0.001], [0.002, 0.0]])))
    assert START_NS > 2**53
    np.testing.assert_allclose(times.spread_us, [0.001, 0.002], atol=1e-9)
