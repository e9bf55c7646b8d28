"""The exposure time, where a device has the kernel's standard control for it."""

from __future__ import annotations

from capture.devices.v4l2.controls import list_controls, read_control, write_control
from capture.devices.v4l2.node import Node
from capture.errors import DeviceError

_AUTO, _ABSOLUTE, _AUTO_PRIORITY = 0x009A0901, 0x009A0902, 0x009A0903
_MANUAL = 1
_UNIT_US = 100.0


def set_exposure(node: Node, exposure_us: float) -> float:
    """Switch to manual exposure and set it; automatic exposure may no longer lower the rate either.

    Returns:
        What the device uses, us; -1 when it has no such control.

    Raises:
        DeviceError: when the time is out of its range, or the driver refuses.
    """
    by_id = {info.id: info for info in list_controls(node).values()}
    if _ABSOLUTE not in by_id:
        return -1.0
    if _AUTO in by_id and _MANUAL in by_id[_AUTO].menu:
        write_control(node, by_id[_AUTO], by_id[_AUTO].menu[_MANUAL])
    if _AUTO_PRIORITY in by_id:
        write_control(node, by_id[_AUTO_PRIORITY], False)
    control = by_id[_ABSOLUTE]
    step = max(control.step, 1)
    units = control.minimum + round((exposure_us / _UNIT_US - control.minimum) / step) * step
    if not control.minimum <= units <= control.maximum:
        raise DeviceError(
            f"asked for an exposure of {exposure_us:.0f} us, offers "
            f"{control.minimum * _UNIT_US:.0f} to {control.maximum * _UNIT_US:.0f} us"
        )
    write_control(node, control, units)
    return float(read_control(node, control)) * _UNIT_US
