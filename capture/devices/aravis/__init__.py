"""GigE Vision and USB3 Vision devices, by way of Aravis, which is loaded on first use."""

from __future__ import annotations

from capture.devices.aravis import finding
from capture.devices.aravis.device import AravisDevice
from capture.devices.aravis.parts import open_device
from capture.devices.backend import FoundDevice

__all__ = ["AravisBackend", "AravisDevice", "backend"]


class AravisBackend:
    """How devices behind Aravis are found and opened."""

    name = finding.BACKEND

    def discover(self) -> tuple[FoundDevice, ...]:
        """The devices that answer, by serial number. Takes a second."""
        return finding.discover()

    def open(self, address: str, name: str) -> AravisDevice:
        """Open a device.

        Args:
            address: its IP address, serial number or device id.
            name: that it shall have in the array.
        """
        return open_device(address, name)


backend = AravisBackend()
