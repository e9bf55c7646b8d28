"""What only some devices behind Aravis can do: a device's class has the parts that it has."""

from __future__ import annotations

import functools
import time

from capture.devices.aravis.connection import Connection
from capture.devices.aravis.device import AravisDevice
from capture.devices.aravis.features import Features
from capture.devices.aravis.library import aravis
from capture.devices.capabilities import PtpReading
from capture.devices.protocol import ClockSample, TriggerKind
from capture.devices.watchdog import Watchdog
from capture.errors import DeviceError

_OPEN_S = 15.0
_PARTING_S = 2.0
# Names since 2015, and before. The old clock counts ticks of its own, the new one nanoseconds.
_LATCHES = (
    ("TimestampLatch", "TimestampLatchValue"),
    ("GevTimestampControlLatch", "GevTimestampValue"),
)
_PTP_SWITCHES = ("PtpEnable", "GevIEEE1588")
_PTP_LATCHES = ("PtpDataSetLatch", "GevIEEE1588DataSetLatch")
_PTP_STATES = ("PtpStatus", "GevIEEE1588Status", "GevIEEE1588StatusLatched")
_PTP_OFFSETS = ("PtpOffsetFromMaster", "GevIEEE1588OffsetFromMaster")
_PTP_MASTERS = ("PtpGrandmasterClockID", "PtpParentClockID", "GevIEEE1588ParentClockId")


class _Latch(AravisDevice):
    """A device whose clock can be read."""

    def latch(self) -> ClockSample:
        """Read the device's clock."""
        return self._ask(self._latch)

    def _latch(self) -> ClockSample:
        connection = self._connection
        command, value = _latch_names(connection.features)
        before = time.monotonic_ns()
        connection.command(command)
        after = time.monotonic_ns()
        ticks = int(connection.features.read(value))
        if command == _LATCHES[1][0]:
            ticks = ticks * 10**9 // connection.ticks_per_s()
        return ClockSample(ticks, before, after)


class _Ptp(AravisDevice):
    """A device whose clock can follow IEEE 1588."""

    def enable_ptp(self, on: bool) -> None:
        """Switch it on or off; a device that is on already is left to find its master."""
        self._ask(lambda: self._enable_ptp(on))

    def ptp(self) -> PtpReading:
        """The state now."""
        return self._ask(lambda: _read_ptp(self._connection.features))

    def _enable_ptp(self, on: bool) -> None:
        features = self._connection.features
        name = features.first(*_PTP_SWITCHES)
        if bool(features.read(name)) != on:
            features.write(name, on)

    def _ptp_reading(self) -> PtpReading | None:
        try:
            return self.ptp()
        except DeviceError:
            return None


class _Software(AravisDevice):
    """A device that exposes when it is told to."""

    def fire(self) -> None:
        """Expose now."""
        self._ask(self._connection.triggers.fire)


class _Action(AravisDevice):
    """A device that answers action commands."""

    @property
    def action_address(self) -> str:
        """Its IP address."""
        return self._connection.address


def open_device(asked: str, name: str) -> AravisDevice:
    """Open a device, as what it is.

    Args:
        asked: its IP address, serial number or device id.
        name: that it shall have in the array.

    Raises:
        DeviceError: when it is not there, or is in use.
    """
    aravis()
    control = Watchdog(name)
    try:
        connection = control.call(lambda: Connection(name, asked), _OPEN_S)
        try:
            kind = control.call(lambda: _kind(connection), _OPEN_S)
            return kind(name, connection, control)
        except DeviceError:
            # Said, not left to the last hold: whoever keeps the error would keep the device.
            control.post(connection.drop).wait(_PARTING_S)
            raise
    except DeviceError:
        control.close()
        raise


def _kind(connection: Connection) -> type[AravisDevice]:
    features, triggers = connection.features, connection.triggers.kinds()
    return _class_of(
        bool(_latch_names(features)[0]),
        bool(features.first(*_PTP_SWITCHES)),
        TriggerKind.SOFTWARE in triggers,
        TriggerKind.ACTION in triggers and connection.gige,
    )


@functools.cache
def _class_of(latch: bool, ptp: bool, software: bool, action: bool) -> type[AravisDevice]:
    has = ((latch, _Latch), (ptp, _Ptp), (software, _Software), (action, _Action))
    parts = tuple(part for there, part in has if there)
    return type("AravisDevice", parts, {}) if parts else AravisDevice


def _latch_names(features: Features) -> tuple[str, str]:
    for command, value in _LATCHES:
        if features.has(command) and features.has(value):
            return command, value
    return "", ""


def _read_ptp(features: Features) -> PtpReading:
    if not features.read(features.first(*_PTP_SWITCHES)):
        return PtpReading("disabled")
    latch = features.first(*_PTP_LATCHES)
    if latch:
        features.run(latch)
    state, offset = features.first(*_PTP_STATES), features.first(*_PTP_OFFSETS)
    master = features.first(*_PTP_MASTERS)
    grandmaster = features.read(master) if master else ""
    if isinstance(grandmaster, int):
        grandmaster = f"{grandmaster % (1 << 64):016x}"
    return PtpReading(
        str(features.read(state)).lower() if state else "unknown",
        int(features.read(offset)) if offset else None,
        str(grandmaster),
    )
