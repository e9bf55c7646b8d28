"""The roster against what was found: each device gets one finding with its remedy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from capture.devices.backend import FoundDevice
from capture.devices.roster import ExpectedDevice, FindingKind, Sighting, all_there, compare, look
from capture.errors import SettingsError

EXPECTED = tuple(
    ExpectedDevice(name=f"cam{n:02d}", backend="aravis", serial=f"S{n}", address=f"10.0.0.{n}")
    for n in range(1, 5)
)


def found(n: int, **changes: object) -> FoundDevice:
    one = FoundDevice(
        backend="aravis", address=f"10.0.0.{n}", serial=f"S{n}", model="Acme M1", transport="gige"
    )
    return replace(one, **changes)  # type: ignore[arg-type]


ALL = tuple(found(n) for n in range(1, 5))


def told(sighting: Sighting, expected: tuple[ExpectedDevice, ...] = EXPECTED) -> dict[str, str]:
    return {finding.name: str(finding) for finding in compare(expected, sighting)}


def test_all_present_is_all_there() -> None:
    findings = compare(EXPECTED, Sighting(ALL))
    assert [f.kind for f in findings] == [FindingKind.PRESENT] * 4
    assert all_there(findings)
    assert str(findings[0]) == "cam01: present"


@pytest.mark.parametrize(
    ("sighting", "name", "kind", "words"),
    [
        (Sighting(ALL[:3]), "cam04", "missing", ["serial S4", "not found", "power and cable"]),
        (
            Sighting((*ALL[:3], found(4, address="10.0.0.99"))),
            "cam04", "moved", ["10.0.0.4", "10.0.0.99", 'address = "10.0.0.99"'],
        ),
        (
            Sighting((*ALL[:3], found(4, serial="S9"))),
            "cam04", "missing", ["serial S9 there", "replaced", 'serial = "S9"'],
        ),
        (
            Sighting((*ALL[:3], found(4, backend="v4l2"))),
            "cam04", "missing", ["found by v4l2", 'backend = "v4l2"'],
        ),
        (
            Sighting((*ALL[:3], found(4, problems=("is in another subnet: 169.254.3.4",)))),
            "cam04", "troubled", ["169.254.3.4", "same subnet"],
        ),
        (
            Sighting((*ALL[:3], found(4, problems=("in use by another program",)))),
            "cam04", "troubled", ["in use", "close the program"],
        ),
        (
            Sighting((*ALL[:3], found(4, problems=("slow link: 100 Mbit/s",)))),
            "cam04", "troubled", ["100 Mbit/s", "cable"],
        ),
        (
            Sighting((*ALL[:3], found(4, problems=("dead; wake it", "slow link")))),
            "cam04", "troubled", ["cam04: dead, slow link; wake it; look at its cable"],
        ),
        (Sighting((*ALL, found(7))), "S7", "extra", ["Acme M1 at 10.0.0.7", "add it"]),
        (Sighting(()), "cam01", "missing", ["found no device at all", "switch"]),
        (
            Sighting((), absent={"aravis": "aravis needs PyGObject; install it with: x"}),
            "cam01", "missing", ["could not look", "install it with: x"],
        ),
        (
            Sighting((), failed={"aravis": "no interface is up"}),
            "cam01", "missing", ["could not look", "no interface is up"],
        ),
    ],
)  # fmt: skip
def test_a_finding_says_what_was_expected_what_was_found_and_what_to_do(
    sighting: Sighting, name: str, kind: str, words: list[str]
) -> None:
    finding = next(f for f in compare(EXPECTED, sighting) if f.name == name)
    assert finding.kind == kind
    assert all(word in str(finding) for word in words), str(finding)


def test_a_device_without_a_serial_is_known_by_its_address() -> None:
    device = ExpectedDevice(name="left", backend="v4l2", address="/dev/video0")
    there = found(1, backend="v4l2", address="/dev/video0", serial="usb-1")
    assert told(Sighting((there,)), (device,)) == {"left": "left: present"}
    gone = told(Sighting((replace(there, address="/dev/video2"),)), (device,))
    assert "address /dev/video0; not found" in gone["left"]


def test_devices_of_a_backend_that_the_roster_does_not_use_are_not_extra() -> None:
    other = found(1, backend="v4l2", address="/dev/video0", serial="laptop")
    assert len(compare(EXPECTED, Sighting((*ALL, other)))) == 4


def test_one_finding_for_each_device_whatever_is_found() -> None:
    random = np.random.default_rng(5)
    for _ in range(200):
        pool = [
            found(int(n), address=f"10.0.0.{int(random.integers(1, 7))}")
            for n in random.permutation(8)[: random.integers(0, 9)]
        ]
        findings = compare(EXPECTED, Sighting(tuple(pool)))
        assert [f.name for f in findings[:4]] == [d.name for d in EXPECTED]
        used = [id(f.found) for f in findings if f.found is not None]
        assert len(used) == len(set(used)) == len(pool)
        assert all(f.kind is FindingKind.EXTRA for f in findings[4:])


def test_an_unknown_backend_is_refused_by_name() -> None:
    with pytest.raises(SettingsError, match=r"no backend 'aravi'; did you mean 'aravis'\?"):
        look(["aravi"])
