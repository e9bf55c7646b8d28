"""The common clock against simulated devices that follow PTP."""

from __future__ import annotations

import time

import pytest

from capture.devices.capabilities import PtpReading
from capture.devices.common_clock import CommonClock
from capture.devices.faults import Fault, FaultKind
from capture.devices.lines import RealTimeLine
from capture.devices.simulated import SimulatedBackend
from capture.errors import DeviceError

NEAR_NS = 20_000_000  # a busy machine reads a clock this much too late, at worst


def test_it_shows_what_a_locked_device_shows_and_outlives_its_death() -> None:
    backend = SimulatedBackend(RealTimeLine())
    devices = [backend.open(f"64x48?seed={n}", f"cam{n:02d}") for n in range(3)]
    try:
        devices[0].set_ptp(PtpReading("listening"))
        for device in devices:
            device.enable_ptp(True)
        clock = CommonClock(devices)
        for _ in range(2):
            sample = devices[2].latch()
            assert abs(clock(sample.before_ns) - sample.t_dev_ns) < NEAR_NS
            devices[1].inject(Fault(FaultKind.DEATH))
            assert clock.read()
    finally:
        for device in devices:
            device.close()


def test_before_any_device_is_locked_it_is_the_hosts() -> None:
    backend = SimulatedBackend(RealTimeLine())
    device = backend.open("64x48", "cam01")
    clock = CommonClock([device])
    now = time.monotonic_ns()
    assert (clock.read(), clock(now)) == (False, now)
    device.close()


def test_an_array_without_ptp_is_refused() -> None:
    with pytest.raises(DeviceError, match="take ahead_ms out of"):
        CommonClock([])
