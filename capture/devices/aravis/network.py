"""What the host's network says: in whose reach an address lies, and what would slow it down."""

from __future__ import annotations

import fcntl
import ipaddress
import socket
import struct
from dataclasses import dataclass
from pathlib import Path

_ADDRESS, _MASK, _MTU = 0x8915, 0x891B, 0x8921  # SIOCGIFADDR, SIOCGIFNETMASK, SIOCGIFMTU
_RECEIVE_LIMIT = Path("/proc/sys/net/core/rmem_max")
ENOUGH_RECEIVE_BYTES = 10_000_000
ORDINARY_PACKET = 1500
_HEADERS, _WIRE = 36, 38  # bytes: IP, UDP and GVSP inside a packet; Ethernet around it


@dataclass(frozen=True)
class Interface:
    """A network interface of the host.

    Attributes:
        name: as the system calls it.
        network: its address and mask.
        mtu: the longest packet it takes, bytes.
    """

    name: str
    network: ipaddress.IPv4Interface
    mtu: int


def interfaces() -> tuple[Interface, ...]:
    """The host's interfaces that have an IPv4 address."""
    found = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asker:
        for _, name in socket.if_nameindex():
            try:
                address = socket.inet_ntoa(_ask(asker, name, _ADDRESS)[4:8])
                mask = socket.inet_ntoa(_ask(asker, name, _MASK)[4:8])
                (mtu,) = struct.unpack("i", _ask(asker, name, _MTU)[:4])
            except OSError:  # it has no address, or has just gone
                continue
            found.append(Interface(name, ipaddress.IPv4Interface(f"{address}/{mask}"), mtu))
    return tuple(found)


def interface_of(address: str) -> Interface | None:
    """The interface in whose network an address lies; None when it lies in none."""
    there = ipaddress.IPv4Address(address)
    fitting = [one for one in interfaces() if there in one.network.network]
    return max(fitting, key=lambda one: one.network.network.prefixlen, default=None)


def address_problems(address: str) -> tuple[str, ...]:
    """Why a device with this address may not work, in words."""
    if interface_of(address) is not None:
        return ()
    ours = ", ".join(f"{one.name} {one.network}" for one in interfaces())
    return (
        f"its address {address} is in no network of this host ({ours}); "
        f"give it an address of one of these, or the host one of its",
    )


def host_problems() -> tuple[str, ...]:
    """What of the host's settings loses packets at high rates, in words."""
    try:
        limit = int(_RECEIVE_LIMIT.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return ()
    if limit >= ENOUGH_RECEIVE_BYTES:
        return ()
    return (
        f"the host buffers at most {limit / 1e6:.1f} MB of packets (net.core.rmem_max); "
        f"run: sudo sysctl -w net.core.rmem_max={ENOUGH_RECEIVE_BYTES}",
    )


def packet_problems(packet_bytes: int, mtu: int) -> tuple[str, ...]:
    """What is wrong with a packet size that was read back from a device, in words."""
    if packet_bytes > ORDINARY_PACKET:
        return ()
    if mtu > ORDINARY_PACKET:
        return (
            f"packets of {packet_bytes} bytes although the host takes {mtu}: "
            f"check the switch, and the device's limit",
        )
    return (
        f"packets of {packet_bytes} bytes cost the host six times the work of 9000; "
        f"set MTU 9000 on the host's interface, the switch and the device",
    )


def packet_pause_ns(frame_bytes: int, packet_bytes: int, spread_ns: int, link_mbps: float) -> int:
    """The pause between packets with which a frame takes a given time; 0 on a link no faster.

    Args:
        frame_bytes: what is sent for each frame.
        packet_bytes: of a packet, headers included.
        spread_ns: how long a frame shall take.
        link_mbps: what the device's link carries.
    """
    packets = -(-frame_bytes // max(packet_bytes - _HEADERS, 1)) + 2  # one opens, one closes it
    packet_ns = (packet_bytes + _WIRE) * 8e3 / link_mbps
    return max(int(spread_ns / packets - packet_ns), 0)


def _ask(asker: socket.socket, name: str, question: int) -> bytes:
    answer = fcntl.ioctl(asker.fileno(), question, struct.pack("16s240x", name.encode()))
    return answer[16:32]
