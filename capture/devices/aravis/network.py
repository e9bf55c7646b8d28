"""What the host's network says: in whose reach an address lies, and how packets are paced."""

from __future__ import annotations

import fcntl
import ipaddress
import socket
import struct
from dataclasses import dataclass

_ADDRESS, _MASK, _MTU = 0x8915, 0x891B, 0x8921  # SIOCGIFADDR, SIOCGIFNETMASK, SIOCGIFMTU
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
