"""Finding video devices, and knowing each again wherever its node is.

A device is known by the maker's serial number where it has one (USB), else by where it is plugged
in. A device with several capture nodes has one identity for each, told apart by its index.
"""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

from capture.devices.backend import FoundDevice
from capture.devices.v4l2 import ioctls
from capture.devices.v4l2.buffers import busy
from capture.devices.v4l2.node import KernelNode, capture_problem, node_caps, said
from capture.devices.v4l2.stream_settings import format_problem, offered_formats
from capture.errors import DeviceError

SYSFS = Path("/sys/class/video4linux")


@dataclass(frozen=True)
class NodeIdentity:
    """By what a node's device is known again.

    Attributes:
        serial: of the maker, else the bus address, with the index of a further node.
        model: maker and model.
        bus: where it is plugged in.
        link_mbps: of a USB device; None otherwise.
    """

    serial: str
    model: str
    bus: str
    link_mbps: float | None


def discover() -> tuple[FoundDevice, ...]:
    """All capture nodes, in the order of their numbers; what may not work is said in words."""
    found = [each for path in _node_paths() if (each := _look(path)) is not None]
    counts = Counter(each.serial for each in found)
    return tuple(
        each
        if not each.serial or counts[each.serial] == 1
        else replace(
            each,
            problems=(
                *each.problems,
                f"{counts[each.serial]} devices have the serial {each.serial}; "
                "open it by its node, under /dev/v4l/by-path where there is one",
            ),
        )
        for each in found
    )


def find_path(address: str) -> str:
    """The node of a device, by its node, its serial or its bus address.

    Raises:
        DeviceError: when there is none, or more than one.
    """
    if address.startswith("/"):
        return address
    known = {path: identity for path in _node_paths() if (identity := _identity_at(path))}
    for field in ("serial", "bus"):
        paths = [path for path, each in known.items() if getattr(each, field) == address]
        if len(paths) > 1 and field == "serial":
            raise DeviceError(
                f"{address}: {len(paths)} devices have this serial ({', '.join(paths)}); "
                "open one by its node"
            )
        if paths:
            return paths[0]
    there = ", ".join(each.serial for each in known.values()) or "none"
    raise DeviceError(f"no video device {address!r}; found: {there}")


def identify(path: str, capability: ioctls.Capability) -> NodeIdentity:
    """By what the device behind an open node is known again."""
    entry = SYSFS / Path(os.path.realpath(path)).name
    bus = capability.bus_info.decode("utf-8", "replace")
    model = capability.card.decode("utf-8", "replace")
    usb = _usb_folder(entry)
    serial, speed = (_text(usb / "serial"), _text(usb / "speed")) if usb else ("", "")
    serial = serial or bus or entry.name
    index = _text(entry / "index")
    if index not in ("", "0"):
        serial = f"{serial}-index{index}"
    return NodeIdentity(serial, model, bus, float(speed) if speed.isdecimal() else None)


def _look(path: str) -> FoundDevice | None:
    """One node; None when it is no capture node."""
    model = _text(SYSFS / Path(path).name / "name")
    try:
        node = KernelNode(path)
    except OSError as error:
        return FoundDevice(
            backend="v4l2", address=path, serial="", model=model, transport="v4l2",
            problems=(f"cannot be opened: {said(error)}",),
        )  # fmt: skip
    try:
        capability = ioctls.Capability()
        node.call(ioctls.QUERYCAP, capability)
        if not node_caps(capability) & (ioctls.CAP_CAPTURE | ioctls.CAP_CAPTURE_MPLANE):
            return None
        problem = capture_problem(capability)
        problems = [problem] if problem else [format_problem(offered_formats(node))]
        if not problem and busy(node):
            problems.append("in use by another program")
        identity = identify(path, capability)
    except OSError as error:
        return FoundDevice(
            backend="v4l2", address=path, serial="", model=model, transport="v4l2",
            problems=(f"does not answer: {said(error)}",),
        )  # fmt: skip
    finally:
        node.close()
    return FoundDevice(
        backend="v4l2", address=path, serial=identity.serial, model=identity.model,
        transport="v4l2", link_mbps=identity.link_mbps,
        problems=tuple(each for each in problems if each),
    )  # fmt: skip


def _identity_at(path: str) -> NodeIdentity | None:
    try:
        node = KernelNode(path)
    except OSError:
        return None
    try:
        capability = ioctls.Capability()
        node.call(ioctls.QUERYCAP, capability)
    except OSError:
        return None
    finally:
        node.close()
    if not node_caps(capability) & (ioctls.CAP_CAPTURE | ioctls.CAP_CAPTURE_MPLANE):
        return None
    return identify(path, capability)


def _node_paths() -> list[str]:
    nodes = [path for path in Path("/dev").glob("video*") if path.name[5:].isdecimal()]
    return [str(path) for path in sorted(nodes, key=lambda path: int(path.name[5:]))]


def _usb_folder(entry: Path) -> Path | None:
    """The folder of the USB device that a node belongs to; None for other buses."""
    try:
        place = (entry / "device").resolve(strict=True)
    except OSError:
        return None
    for folder in (place, *place.parents):
        if (folder / "idVendor").exists():
            return folder
    return None


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
