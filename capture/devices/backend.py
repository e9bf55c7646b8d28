"""Backends: how devices of one kind are found and opened. One module or package each.

A third party adds one by an entry point in the group `likeness.devices`, which names an object that
implements `Backend`.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import metadata
from typing import Protocol, cast, runtime_checkable

from capture.devices.protocol import Device, TriggerLine
from capture.errors import SettingsError
from capture.names import known_hint

BACKEND_GROUP = "likeness.devices"


@dataclass(frozen=True, kw_only=True)
class FoundDevice:
    """A device that was found.

    Attributes:
        backend: by whom.
        address: by which the backend opens it: an IP address or device id, a path.
        serial: by which it is known again, wherever it is plugged in.
        model: maker and model.
        transport: "gige", "usb3", "v4l2", "simulated" or "replay"; a third party's own word.
        link_mbps: what its link carries, Mbit/s; None unknown.
        problems: why it may not work, in words: another subnet, in use by another program.
    """

    backend: str
    address: str
    serial: str
    model: str
    transport: str
    link_mbps: float | None = None
    problems: tuple[str, ...] = ()


class Backend(Protocol):
    """How devices of one kind are found and opened."""

    @property
    def name(self) -> str:
        """As in array files and on the command line."""

    def discover(self) -> tuple[FoundDevice, ...]:
        """The devices that are there, in a stable order.

        Raises:
            ExtraError: when what the backend needs is not installed.
            DeviceError: when looking for them failed.
        """

    def open(self, address: str, name: str) -> Device:
        """Open a device.

        Args:
            address: of a `FoundDevice`, or its serial; or whatever else the backend says.
            name: that it shall have in the array.

        Raises:
            ExtraError: when what the backend needs is not installed.
            DeviceError: when it is not there, or is in use.
        """


@runtime_checkable
class LineOwner(Protocol):
    """A backend whose devices are triggered by a line of its own, as simulated ones are."""

    def line(self) -> TriggerLine:
        """The line to which all devices that this backend opens are wired."""


def backend_names() -> tuple[str, ...]:
    """Names of the backends that are installed."""
    return tuple(sorted(entry.name for entry in metadata.entry_points(group=BACKEND_GROUP)))


def load_backend(name: str) -> Backend:
    """The backend of that name.

    Raises:
        SettingsError: naming the backends that are installed.
    """
    found = {entry.name: entry for entry in metadata.entry_points(group=BACKEND_GROUP)}
    if name not in found:
        raise SettingsError(f"no backend {name!r}; {known_hint(name, sorted(found))}")
    return cast(Backend, found[name].load())
