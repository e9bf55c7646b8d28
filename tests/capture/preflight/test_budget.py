"""Budgets: too little is refused with the number, enough is said once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from capture.devices.protocol import DeviceInfo, TriggerKind
from capture.devices.simulated import streaming_array
from capture.frame_header import ImageLayout
from capture.judgement import Colour
from capture.preflight.budget import (
    SharedLink,
    host_links,
    link_findings,
    memory_findings,
    needed_mbps,
    network_findings,
    ring_bytes,
    timing_findings,
)
from capture.preflight.finding import Finding, ordered, steps, worst

BIG = ImageLayout(2048, 2048, 1, "uint8")
GIGE = DeviceInfo(
    name="cam00", serial="1", model="m", layout=BIG, id_bits=16, triggers=(TriggerKind.HARDWARE,),
    transport="gige", address="10.88.0.11", link_mbps=1000.0,
)  # fmt: skip


def array(count: int, **changes: object) -> list[DeviceInfo]:
    return [replace(GIGE, name=f"cam{c:02d}", **changes) for c in range(count)]  # type: ignore[arg-type]


def test_gigabit_cannot_carry_4_megapixels_at_75_hz() -> None:
    (finding,) = link_findings([GIGE], 75.0)
    assert needed_mbps(GIGE, 75.0) == pytest.approx(2516.6, abs=0.1)
    assert (finding.colour, finding.device) == (Colour.RED, "cam00")
    assert finding.sentence == (
        "The link of cam00 must carry 2517 Mbit/s of pixels at 75 Hz and carries 944: at most "
        "28.1 Hz."
    )
    assert finding.remedy.startswith("1. Set rate_hz to 25 or less")


@pytest.mark.parametrize(("rate_hz", "colour"), [(25.0, "green"), (27.0, "amber"), (29.0, "red")])
def test_colours_follow_what_is_left(rate_hz: float, colour: str) -> None:
    assert worst(link_findings([GIGE], rate_hz)) == colour


def test_a_shared_uplink_is_summed() -> None:
    infos = array(4, link_mbps=5000.0)
    uplink = SharedLink("uplink of switch 1", 9440.0, tuple(info.name for info in infos))
    (finding,) = link_findings(infos, 75.0, [uplink])
    assert (finding.colour, finding.device) == (Colour.RED, "")
    assert "Uplink of switch 1, shared by 4 devices, must carry 10066 Mbit/s" in finding.sentence
    assert worst(link_findings(infos, 60.0, [uplink])) == Colour.GREEN


def test_unknown_links_are_said_to_be_unknown() -> None:
    (finding,) = link_findings(array(2, link_mbps=None), 75.0)
    assert finding.colour == Colour.GREEN
    assert finding.sentence == "Links carry 5033 Mbit/s at 75 Hz; not known of 2 devices."


def test_exposure_and_readout_must_fit_the_period() -> None:
    devices = streaming_array(2, ImageLayout(32, 32, 1, "uint8")).devices
    assert worst(timing_findings(devices, 75.0, 3000.0, 10_000.0)) == Colour.GREEN
    found = timing_findings(devices, 75.0, 3000.0, 11_000.0)
    assert [finding.device for finding in found] == ["cam00", "cam01"]
    assert "needs 14000 us for a frame" in found[0].sentence
    assert "period is 13333 us: it would miss triggers" in found[0].sentence
    assert "Set exposure_us to 2283 or less, or rate_hz to 71 or less." in found[0].remedy


def test_the_ring_must_fit_into_memory(tmp_path: Path) -> None:
    (tmp_path / "self").mkdir()
    (tmp_path / "meminfo").write_text("MemTotal: 9 kB\nMemAvailable:   20000000 kB\n")
    (tmp_path / "self" / "status").write_text("RssShmem:\t 5000000 kB\n")
    need = ring_bytes(array(16), {f"cam{c:02d}": 300 for c in range(16)})
    assert need == 16 * 300 * 2048 * 2048
    assert memory_findings(need, tmp_path)[0].colour == Colour.GREEN  # a quarter is there already
    (finding,) = memory_findings(2 * need, tmp_path)
    assert finding.colour == Colour.RED
    assert "takes 40.3 GB, 35.1 GB more than now; 20.5 GB are free" in finding.sentence
    assert memory_findings(need, tmp_path / "nowhere") == []


def test_small_buffers_of_the_host_are_told(tmp_path: Path) -> None:
    folder = tmp_path / "sys" / "net" / "core"
    folder.mkdir(parents=True)
    devices = streaming_array(1, ImageLayout(32, 32, 1, "uint8")).devices
    devices[0].info = replace(devices[0].info, transport="gige")  # type: ignore[misc]
    (folder / "rmem_max").write_text("212992\n")
    (finding,) = network_findings(devices, 75.0, tmp_path)
    assert finding.colour == Colour.AMBER
    assert "sysctl -w net.core.rmem_max=33554432" in finding.remedy
    (folder / "rmem_max").write_text("33554432\n")
    assert network_findings(devices, 75.0, tmp_path)[0].colour == Colour.GREEN
    other = streaming_array(1, ImageLayout(32, 32, 1, "uint8")).devices
    assert network_findings(other, 75.0, tmp_path) == []


def test_links_that_this_machine_tells_of(tmp_path: Path) -> None:
    routes = "Iface Destination Gateway Flags RefCnt Use Metric Mask\n"
    routes += "eth0 00000000 0100000A 3 0 0 0 00000000\neth1 0000580A 00000000 1 0 0 0 00FFFFFF\n"
    (tmp_path / "proc" / "net").mkdir(parents=True)
    (tmp_path / "proc" / "net" / "route").write_text(routes)
    for name, speed in (("eth0", "1000"), ("eth1", "10000")):
        (tmp_path / "sys" / "class" / "net" / name).mkdir(parents=True)
        (tmp_path / "sys" / "class" / "net" / name / "speed").write_text(speed)
    bus = tmp_path / "sys" / "devices" / "pci0000:00" / "0000:00:14.0" / "usb2" / "2-1" / "2-1:1.0"
    bus.mkdir(parents=True)
    for node in ("video0", "video2"):
        (tmp_path / "sys" / "class" / "video4linux" / node).mkdir(parents=True)
        (tmp_path / "sys" / "class" / "video4linux" / node / "device").symlink_to(bus)
    infos = array(2)
    usb = [
        replace(GIGE, name=n, transport="v4l2", address=f"/dev/{n}") for n in ("video0", "video2")
    ]
    found = host_links([*infos, *usb], tmp_path)
    assert found == [
        SharedLink("interface eth1", 9440.0, ("cam00", "cam01")),
        SharedLink("USB controller 0000:00:14.0", 3600.0, ("video0", "video2")),
    ]
    assert host_links(infos, tmp_path / "nowhere") == []
    assert host_links([replace(GIGE, address="weird")], tmp_path) == []


def test_findings_are_ordered_and_steps_numbered() -> None:
    found = [Finding("a", "", colour, "s") for colour in (Colour.GREEN, Colour.RED, Colour.AMBER)]
    assert [finding.colour for finding in ordered(found)] == ["red", "amber", "green"]
    assert worst([]) == Colour.GREEN
    assert steps(("One.",)) == "One."
    assert steps(("One.", "Two.")) == "1. One. 2. Two."
