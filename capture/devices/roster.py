"""The roster: the devices that an array should have against those that are found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum

from capture.devices.backend import FoundDevice, backend_names, load_backend
from capture.errors import DeviceError, ExtraError

_REMEDIES = (
    ("subnet", "give the device, or this machine's interface, an address in the same subnet"),
    ("in use", "close the program that holds it, or switch the device off and on"),
    ("link", "look at its cable, the switch port and the interface of this machine"),
    ("permission", "let your user read and write it, or run as a user that may"),
)
_ANY_REMEDY = "switch the device off and on; look at its cable"


@dataclass(frozen=True, kw_only=True)
class ExpectedDevice:
    """A device that the array should have.

    Attributes:
        name: in the array.
        backend: that finds and opens it.
        serial: by which it is known wherever it is plugged in; empty: known by its address.
        address: where it should be; empty: anywhere.
    """

    name: str
    backend: str
    serial: str = ""
    address: str = ""

    @property
    def known_as(self) -> str:
        """What the backend is asked for: the serial, else the address."""
        return self.serial or self.address


class FindingKind(StrEnum):
    """How a device of the roster stands."""

    PRESENT = "present"
    MOVED = "moved"  # there, at another address than the roster says
    TROUBLED = "troubled"  # there, and may not work
    MISSING = "missing"
    EXTRA = "extra"  # found, and not in the roster


@dataclass(frozen=True, kw_only=True)
class Finding:
    """What became of one device.

    Attributes:
        kind: how it stands.
        name: in the array; of one that is extra, what it is known by.
        sentence: what was expected and what was found; empty when it is present and well.
        remedy: what to do about it; empty when there is nothing to do.
        found: the device; None when it is missing.
    """

    kind: FindingKind
    name: str
    sentence: str = ""
    remedy: str = ""
    found: FoundDevice | None = None

    def __str__(self) -> str:
        told = f"{self.name}: {self.sentence or self.kind}"
        return f"{told}; {self.remedy}" if self.remedy else told


@dataclass(frozen=True)
class Sighting:
    """What the backends found.

    Attributes:
        found: all devices, by backend.
        absent: by backend whose optional packages are not installed, what to install.
        failed: by backend that could not look, why.
    """

    found: tuple[FoundDevice, ...]
    absent: Mapping[str, str] = field(default_factory=dict)
    failed: Mapping[str, str] = field(default_factory=dict)

    @property
    def unseen(self) -> dict[str, str]:
        """By backend that did not look, why."""
        return {**self.absent, **self.failed}


def look(backends: Sequence[str] | None = None) -> Sighting:
    """Ask backends for their devices; one that cannot look stops none of the others.

    Args:
        backends: their names; None: all that are installed.

    Raises:
        SettingsError: naming a backend that there is not, and those there are.
    """
    found: list[FoundDevice] = []
    absent: dict[str, str] = {}
    failed: dict[str, str] = {}
    for name in backend_names() if backends is None else backends:
        try:
            found += load_backend(name).discover()
        except ExtraError as error:
            absent[name] = str(error)
        except DeviceError as error:
            failed[name] = str(error)
        except ImportError as error:  # of a third party, and broken
            failed[name] = f"could not be loaded: {error}"
    return Sighting(tuple(found), absent, failed)


def compare(expected: Sequence[ExpectedDevice], sighting: Sighting) -> tuple[Finding, ...]:
    """Hold the roster against what was found.

    Args:
        expected: the roster.
        sighting: what was found.

    Returns:
        One finding for each expected device, in order, then one for each that is extra. A device
        of a backend that the roster does not use is not extra: it belongs to somebody else.
    """
    taken: set[int] = set()
    findings = []
    for device in expected:
        at = _matching(device, sighting.found, taken)
        if at is None:
            findings.append(_missing(device, sighting, taken))
        else:
            taken.add(at)
            findings.append(_there(device, sighting.found[at]))
    used = {device.backend for device in expected}
    findings += [
        Finding(
            kind=FindingKind.EXTRA,
            name=found.serial or found.address,
            sentence=f"{found.model} at {found.address} is not in the roster",
            remedy="add it as [[device]] in the array file, or leave it: it will not be opened",
            found=found,
        )
        for at, found in enumerate(sighting.found)
        if at not in taken and found.backend in used
    ]
    return tuple(findings)


def all_there(findings: Sequence[Finding]) -> bool:
    """Whether no device is missing or troubled."""
    return not any(
        finding.kind in (FindingKind.MISSING, FindingKind.TROUBLED) for finding in findings
    )


def _matching(device: ExpectedDevice, found: Sequence[FoundDevice], taken: set[int]) -> int | None:
    for at, other in enumerate(found):
        same = other.serial == device.serial if device.serial else other.address == device.address
        if same and other.backend == device.backend and at not in taken:
            return at
    return None


def _there(device: ExpectedDevice, found: FoundDevice) -> Finding:
    if found.problems:
        kind = FindingKind.TROUBLED
        told = [problem.partition("; ")[0] for problem in found.problems]
        sentence = ", ".join(told)
        remedy = "; ".join(dict.fromkeys(_remedy(problem) for problem in found.problems))
    elif device.serial and device.address and device.address != found.address:
        kind = FindingKind.MOVED
        sentence = f"expected at {device.address}, found at {found.address}"
        remedy = f'it is opened by its serial all the same; write address = "{found.address}"'
    else:
        kind, sentence, remedy = FindingKind.PRESENT, "", ""
    return Finding(kind=kind, name=device.name, sentence=sentence, remedy=remedy, found=found)


def _missing(device: ExpectedDevice, sighting: Sighting, taken: set[int]) -> Finding:
    sought = f"serial {device.serial}" if device.serial else f"address {device.address}"
    remedy = "look at its power and cable, then run: likeness devices"
    if device.backend in sighting.unseen:
        sentence = f"expected {sought}; backend {device.backend} could not look"
        remedy = sighting.unseen[device.backend]
    elif (other := _elsewhere(device, sighting.found)) is not None:
        sentence = f"expected {sought} by backend {device.backend}, found by {other.backend}"
        remedy = f'write backend = "{other.backend}" in the array file'
    elif (other := _in_its_place(device, sighting.found, taken)) is not None:
        sentence = f"expected {sought} at {device.address}, found serial {other.serial} there"
        remedy = f'if the device was replaced, write serial = "{other.serial}" in the array file'
    elif not any(found.backend == device.backend for found in sighting.found):
        sentence = f"expected {sought}; backend {device.backend} found no device at all"
        remedy = "look at the switch, the interface of this machine and the firewall"
    else:
        sentence = f"expected {sought}; not found"
    return Finding(kind=FindingKind.MISSING, name=device.name, sentence=sentence, remedy=remedy)


def _elsewhere(device: ExpectedDevice, found: Sequence[FoundDevice]) -> FoundDevice | None:
    same = (other for other in found if device.serial and other.serial == device.serial)
    return next((other for other in same if other.backend != device.backend), None)


def _in_its_place(
    device: ExpectedDevice, found: Sequence[FoundDevice], taken: set[int]
) -> FoundDevice | None:
    if not device.address or not device.serial:
        return None
    for at, other in enumerate(found):
        if at not in taken and (other.backend, other.address) == (device.backend, device.address):
            return other
    return None


def _remedy(problem: str) -> str:
    """The remedy that the backend names after a semicolon, else the usual one."""
    named = problem.partition("; ")[2]
    if named:
        return named
    low = problem.lower()
    return next((remedy for word, remedy in _REMEDIES if word in low), _ANY_REMEDY)
