"""Which devices there are, and why one of them may not work."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Protocol
from weakref import WeakValueDictionary

from capture.devices.aravis.library import aravis
from capture.devices.aravis.network import address_problems
from capture.devices.backend import FoundDevice
from capture.devices.gvcp import CONTROL_REGISTER, LINK_SPEED_REGISTER, read_register
from capture.errors import DeviceError

BACKEND = "aravis"
_GIGE = "GigEVision"
_lock = threading.Lock()  # Aravis has one list of devices
# By address, the devices that are open in this program; one that is dropped is open no more.
_ours: WeakValueDictionary[str, Named] = WeakValueDictionary()
_last: tuple[Listed, ...] = ()


class Named(Protocol):
    """Whoever has a device open."""

    name: str


@dataclass(frozen=True)
class Listed:
    """A device in Aravis's list.

    Attributes:
        device_id: by which Aravis opens it.
        address: its IP address; the device id for USB3.
        serial: its serial number.
        model: maker and model.
        gige: whether it speaks GigE Vision.
    """

    device_id: str
    address: str
    serial: str
    model: str
    gige: bool


def listed(*, anew: bool = True) -> tuple[Listed, ...]:
    """The devices that answer, by serial number.

    Args:
        anew: ask again, which takes a second; False: what answered the last time.
    """
    global _last
    with _lock:
        if anew or not _last:
            library = aravis()
            library.update_device_list()
            found = []
            for place in range(library.get_n_devices()):
                gige = library.get_device_protocol(place) == _GIGE
                device_id = str(library.get_device_id(place))
                maker, model = library.get_device_vendor(place), library.get_device_model(place)
                found.append(
                    Listed(
                        device_id,
                        str(library.get_device_address(place)) if gige else device_id,
                        str(library.get_device_serial_nbr(place)),
                        f"{maker} {model}",
                        gige,
                    )
                )
            _last = tuple(sorted(found, key=lambda one: (one.serial, one.device_id)))
        return _last


def discover() -> tuple[FoundDevice, ...]:
    """The devices that answer, by serial number, with what speaks against each."""
    return tuple(
        FoundDevice(
            backend=BACKEND,
            address=one.address,
            serial=one.serial,
            model=one.model,
            transport="gige" if one.gige else "usb3",
            link_mbps=link_mbps(one.address) if one.gige else None,
            problems=_problems(one),
        )
        for one in listed()
    )


def seek(asked: str) -> Listed | None:
    """The device of an address, serial number or device id; None when no such device answers."""
    for anew in (False, True):
        for one in listed(anew=anew):
            if asked in (one.address, one.serial, one.device_id):
                return one
    return None


def link_mbps(address: str) -> float | None:
    """What a device's network link carries, as the device says; None when it does not."""
    if address_problems(address):
        return None
    try:
        return float(read_register(address, LINK_SPEED_REGISTER)) or None
    except DeviceError:
        return None


def held(address: str) -> bool:
    """Whether some program controls a device, as the device says; False when it does not answer."""
    try:
        return read_register(address, CONTROL_REGISTER) != 0
    except DeviceError:
        return False


def remember(address: str, owner: Named) -> None:
    """Note that a device is open in this program.

    Raises:
        DeviceError: when it is already.
    """
    with _lock:
        if address in _ours:
            raise DeviceError(
                f"{owner.name}: {address} is already open in this program as {_ours[address].name}"
            )
        _ours[address] = owner


def forget(address: str, owner: Named) -> None:
    """Note that it no longer is; nothing, when another has it by now."""
    with _lock:
        if _ours.get(address) is owner:
            del _ours[address]


def _problems(one: Listed) -> tuple[str, ...]:
    if not one.gige:
        return ()
    problems = address_problems(one.address)
    with _lock:
        ours = one.address in _ours
    if not problems and not ours and held(one.address):
        return ("in use by another program; close that program",)
    return problems
