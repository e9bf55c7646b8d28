"""What of the Aravis backend needs neither Aravis nor a device."""

from __future__ import annotations

import ipaddress
import subprocess
import sys

import pytest

from capture.devices.aravis.formats import check_format, is_known, layout_of
from capture.devices.aravis.network import (
    address_problems,
    interface_of,
    interfaces,
    packet_pause_ns,
)
from capture.errors import DeviceError
from capture.frame_header import ImageLayout

BLOCKED = """
import sys
sys.modules["gi"] = None
from capture.devices.backend import load_backend
from capture.errors import ExtraError
for ask in (lambda b: b.discover(), lambda b: b.open("10.0.0.11", "cam01")):
    try:
        ask(load_backend("aravis"))
    except ExtraError as error:
        print(error)
"""


def test_without_pygobject_the_message_names_the_packages_and_the_extra() -> None:
    done = subprocess.run(
        [sys.executable, "-c", BLOCKED], capture_output=True, text=True, check=True
    )
    first, second = done.stdout.splitlines()
    assert first == second
    assert first == (
        "GigE Vision and USB3 Vision devices need Aravis (PyGObject is not installed); "
        "install it with: sudo apt-get install -y gir1.2-aravis-0.8 libgirepository1.0-dev "
        "libcairo2-dev pkg-config gcc && pip install 'likeness[aravis]'"
    )


@pytest.mark.parametrize(
    ("name", "layout"),
    [
        ("Mono8", ImageLayout(8, 6, 1, "uint8")),
        ("Mono10", ImageLayout(8, 6, 1, "uint16")),
        ("Mono12", ImageLayout(8, 6, 1, "uint16")),
        ("Mono16", ImageLayout(8, 6, 1, "uint16")),
        ("RGB8", ImageLayout(8, 6, 3, "uint8")),
    ],
)
def test_formats_that_are_taken_as_they_are(name: str, layout: ImageLayout) -> None:
    assert is_known(name)
    assert layout_of(name, 8, 6) == layout
    check_format("cam07", name, ["BayerRG8", name])


@pytest.mark.parametrize("name", ["Mono10p", "Mono12p", "Mono12Packed", "BayerRG8", "YUV422_8"])
def test_other_formats_are_refused_with_what_would_do(name: str) -> None:
    with pytest.raises(DeviceError) as caught:
        check_format("cam07", name, ["Mono8", name, "Mono12"])
    assert str(caught.value) == (
        f"cam07: asked for {name}, which is packed or coloured and not unpacked here; "
        'set PixelFormat = "Mono8" or Mono12 in its preset'
    )
    with pytest.raises(DeviceError, match=r"offers Mono8; set PixelFormat = .Mono8. in its"):
        check_format("cam07", name, ["Mono8"])
    with pytest.raises(DeviceError, match="offers none; none that it offers can be taken"):
        check_format("cam07", name, [])


def test_the_hosts_own_address_is_in_reach_and_a_strangers_is_not() -> None:
    loopback = interface_of("127.0.0.1")
    assert loopback is not None
    assert loopback.network.network == ipaddress.IPv4Network("127.0.0.0/8")
    assert loopback in interfaces()
    assert address_problems("127.0.0.9") == ()
    (problem,) = address_problems("203.0.113.7")
    assert problem.startswith("its address 203.0.113.7 is in no network of this host (")
    assert f"{loopback.name} 127.0.0.1/8" in problem


def test_a_paced_frame_takes_the_time_that_it_may() -> None:
    frame, packet, link = 2048 * 2048, 9000, 10_000.0
    pause = packet_pause_ns(frame, packet, 10_000_000, link)
    packets = -(-frame // (packet - 36)) + 2
    took_ns = packets * (pause + (packet + 38) * 8e3 / link)
    assert took_ns == pytest.approx(10_000_000, abs=packets)
    assert packet_pause_ns(frame, packet, 1_000_000, link) == 0  # the link is slower than that
