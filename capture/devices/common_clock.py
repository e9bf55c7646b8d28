"""`CommonClock`: the clock that all devices follow by PTP, as a time to set action commands for."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence

from capture.devices.capabilities import Latching, PtpClocked
from capture.devices.protocol import Device
from capture.errors import DeviceError

_EVERY_S = 1.0  # clocks of a host are off by up to 50 us a second against a grandmaster
_UNASKED_S = 10.0  # after which nobody follows it any more
_READINGS = 3


class CommonClock:
    """What the common clock shows at a time of the host's.

    It is read from a device that is locked, again every second for as long as it is asked, in a
    thread of its own: reading takes a while, and a device that is gone must not keep a trigger.
    Before any device is locked it shows the host's time.
    """

    def __init__(self, devices: Sequence[Device]) -> None:
        """Hold the devices whose clock can be read.

        Args:
            devices: of the array.

        Raises:
            DeviceError: when none has a clock that follows PTP and can be read.
        """
        self._devices = [
            device
            for device in devices
            if isinstance(device, Latching) and isinstance(device, PtpClocked)
        ]
        if not self._devices:
            raise DeviceError(
                "scheduled action commands need devices whose clocks follow PTP and can be read; "
                "take ahead_ms out of [action], or use a hardware trigger"
            )
        self._offset_ns = 0
        self._asked_s = time.monotonic()
        self._lock = threading.Lock()
        self._follower: threading.Thread | None = None
        self.read()

    def __call__(self, t_ns: int) -> int:
        """What the common clock shows at the host's time `t_ns`; never waits."""
        self._asked_s = time.monotonic()
        with self._lock:
            if self._follower is None or not self._follower.is_alive():
                self._follower = threading.Thread(
                    target=self._follow, name="likeness-common-clock", daemon=True
                )
                self._follower.start()
        return t_ns + self._offset_ns

    def read(self) -> bool:
        """Read it from the first device that is locked; False when none is."""
        for device in self._devices:
            try:
                if not device.ptp().locked:
                    continue
                samples = [device.latch() for _ in range(_READINGS)]
            except DeviceError:
                continue
            best = min(samples, key=lambda sample: sample.after_ns - sample.before_ns)
            self._offset_ns = best.t_dev_ns - (best.before_ns + best.after_ns) // 2
            return True
        return False

    def _follow(self) -> None:
        while time.monotonic() - self._asked_s < _UNASKED_S:
            self.read()
            time.sleep(_EVERY_S)
