"""Ledgers whose exposure times are known."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from capture.arrays import Floats
from capture.ledger import Ledger, LedgerEntry, Remark, Verdict

PERIOD_NS = 13_333_333
PERIOD_US = PERIOD_NS / 1000.0
START_NS = 1_764_000_000_000_000_000  # PTP counts from 1970: too large for a float
LAG_NS = 20_000_000


def names(count: int) -> tuple[str, ...]:
    """cam00, cam01, ..."""
    return tuple(f"cam{place:02d}" for place in range(count))


def quiet(frames: int = 150, devices: int = 6, sigma_us: float = 0.3, seed: int = 0) -> Floats:
    """(F, C) us: how far each exposure lies from its trigger; noise only."""
    return np.random.default_rng(seed).normal(0.0, sigma_us, (frames, devices))


def ledger_of(
    late_us: Floats,
    *,
    lost: Collection[tuple[int, int]] = (),
    remarks: tuple[Remark, ...] = (),
    lag_us: Floats | None = None,
    tick_ns: int = 1,
) -> Ledger:
    """The ledger of devices that exposed so many microseconds after their triggers.

    Args:
        late_us: (F, C).
        lost: (frame, device number) that has no frame.
        remarks: oddities.
        lag_us: (C,) extra time from exposure to arrival.
        tick_ns: in which the devices' clocks count.
    """
    frames, count = late_us.shape
    devices = names(count)
    lags = np.zeros(count) if lag_us is None else lag_us
    entries = []
    for k in range(frames):
        for c, device in enumerate(devices):
            if (k, c) in lost:
                entries.append(LedgerEntry(k, device, Verdict.LOST))
                continue
            t = START_NS + k * PERIOD_NS + round(1000 * late_us[k, c])
            arrival = t + LAG_NS + round(1000 * lags[c])
            entries.append(
                LedgerEntry(k, device, Verdict.OK, k, t // tick_ns * tick_ns, arrival, t)
            )
    return Ledger(devices, frames, tuple(entries), remarks)
