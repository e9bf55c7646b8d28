"""Video4Linux: devices that the kernel's video drivers serve, USB (UVC) devices among them.

`backend` is what the entry point `v4l2` names. Nothing but the standard library and numpy is used.
"""

from __future__ import annotations

from capture.devices.backend import FoundDevice
from capture.devices.protocol import Device
from capture.devices.v4l2.device import open_device
from capture.devices.v4l2.discovery import discover


class V4l2Backend:
    """Finds and opens devices of the kernel's video drivers."""

    name = "v4l2"

    def discover(self) -> tuple[FoundDevice, ...]:
        """All capture nodes, in the order of their numbers."""
        return discover()

    def open(self, address: str, name: str) -> Device:
        """Open a device.

        Args:
            address: its node (/dev/video0, or a link to one), its serial or its bus address.
            name: that it shall have in the array.

        Raises:
            DeviceError: when it is not there, is of another kind, or is in use.
        """
        return open_device(address, name)


backend = V4l2Backend()
