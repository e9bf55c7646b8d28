"""Clock models: lines recovered from readings and arrivals that are off."""

from __future__ import annotations

import numpy as np
import pytest

from capture.clock_model import model_of_arrivals, model_of_samples
from capture.devices.protocol import ClockSample
from capture.errors import DeviceError


def test_the_reading_answered_soonest_counts() -> None:
    slow, fast = ClockSample(5_000, 100, 900), ClockSample(6_000, 1_000, 1_100)
    model = model_of_samples([slow, fast])
    assert (model.dev_ns, model.host_ns) == (6_000, 1_050)


@pytest.mark.parametrize("seed", range(8))
def test_the_lower_edge_of_arrivals_is_the_clock_and_the_shortest_delay(seed: int) -> None:
    rng = np.random.default_rng(seed)
    drift = float(rng.uniform(-100, 100)) * 1e-6
    true = np.arange(0, 60 * 10**9, 13_333_333)
    dev = [int(t * (1 + drift)) + 10**12 for t in true.tolist()]
    late = 2_000_000 + rng.exponential(800_000, len(true))
    late[rng.integers(len(true), size=40)] += 50_000_000  # the host stalls at times
    host = [int(t + d) for t, d in zip(true.tolist(), late, strict=True)]
    model = model_of_arrivals(dev, host)
    assert abs(model.drift_ppm - drift * 1e6) < 2.0
    error = [model.to_host(d) - (int(t) + 2_000_000) for d, t in zip(dev, true, strict=True)]
    assert max(map(abs, error)) < 150_000
    assert all(model.to_host(d) <= h + 1 for d, h in zip(dev, host, strict=True))


def test_one_arrival_gives_a_line_of_rate_1() -> None:
    model = model_of_arrivals([7_000], [9_000])
    assert (model.to_host(8_000), model.rate) == (10_000, 1.0)


def test_no_arrivals_are_refused() -> None:
    with pytest.raises(DeviceError, match="pairs of times, found 0 and 0"):
        model_of_arrivals([], [])
