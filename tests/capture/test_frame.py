"""Clocks, and the models that undo them."""

from __future__ import annotations

import numpy as np
import pytest

from capture.clock_model import ClockModel, fit_model, model_of_samples
from capture.devices.protocol import ClockSample
from capture.errors import DeviceError, SettingsError, TakeError
from capture.frame import Clock
from capture.frame_header import ImageLayout

EPOCH_NS = 1_790_000_000_123_456_789  # whole nanoseconds of today do not fit a float


def test_a_clock_without_error_shows_the_true_time() -> None:
    assert Clock().read(EPOCH_NS) == EPOCH_NS


def test_offset_and_drift_add_up() -> None:
    assert Clock(offset_ns=500, drift_ppm=40.0).read(10**9) == 10**9 + 500 + 40_000


def test_jitter_is_seeded_and_of_the_size_asked_for() -> None:
    clock = Clock(jitter_ns=1000.0, seed=3)
    error = np.array([clock.read(t) - t for t in range(0, 10**9, 10**6)])
    assert [clock.read(t) - t for t in range(0, 10**7, 10**6)] == error[:10].tolist()
    assert 900 < error.std() < 1100
    assert abs(error.mean()) < 120
    assert [Clock(jitter_ns=1000.0, seed=4).read(t) for t in (0, 1)] != [
        clock.read(0),
        clock.read(1),
    ]


@pytest.mark.parametrize("seed", range(5))
def test_a_fitted_model_undoes_the_clock(seed: int) -> None:
    rng = np.random.default_rng(seed)
    clock = Clock(
        offset_ns=int(rng.integers(-(10**12), 10**12)),
        drift_ppm=float(rng.uniform(-100, 100)),
        jitter_ns=1000.0,
        seed=seed,
    )
    host = [EPOCH_NS + 13_333_333 * k for k in range(150)]
    model = fit_model([clock.read(t) for t in host], host)
    assert abs(model.drift_ppm - clock.drift_ppm) < 1.0
    assert 700 < model.jitter_ns < 1300
    steady = Clock(offset_ns=clock.offset_ns, drift_ppm=clock.drift_ppm)
    assert max(abs(model.to_host(steady.read(t)) - t) for t in host) < 1000


def test_a_model_of_readings_errs_by_less_than_half_the_shortest_round_trip() -> None:
    rng = np.random.default_rng(0)
    clock = Clock(offset_ns=77_000_000_000)
    samples = []
    for k in range(20):
        before = EPOCH_NS + k * 10**6
        trip = int(rng.integers(100_000, 2_000_000))
        samples.append(
            ClockSample(clock.read(before + int(rng.uniform(0, trip))), before, before + trip)
        )
    shortest = min(sample.after_ns - sample.before_ns for sample in samples)
    error = model_of_samples(samples).to_host(clock.read(EPOCH_NS)) - EPOCH_NS
    assert abs(error) <= shortest / 2


def test_one_pair_gives_a_line_of_rate_one() -> None:
    assert fit_model([5], [9]) == ClockModel(5, 9)


def test_what_has_no_line_is_refused() -> None:
    with pytest.raises(DeviceError, match="needs pairs of times, found 0 and 0"):
        fit_model([], [])
    with pytest.raises(DeviceError, match="stands still or runs backwards"):
        fit_model([5, 5, 5], [0, 10, 20])
    with pytest.raises(DeviceError, match="at least one reading"):
        model_of_samples([])
    with pytest.raises(SettingsError, match=r"drift_ppm must lie in -1000\.\.1000, found 5000"):
        Clock(drift_ppm=5000)
    with pytest.raises(SettingsError, match="jitter_ns must be 0 or more, found -1"):
        Clock(jitter_ns=-1)


@pytest.mark.parametrize("size", [(10**9, 1), (1 << 15, 1 << 15), (0, 5), (5, -1)])
def test_a_size_that_no_image_has_is_refused(size: tuple[int, int]) -> None:
    with pytest.raises(TakeError, match=f"{size[0]} x {size[1]}"):
        ImageLayout(*size, 1, "uint8")
