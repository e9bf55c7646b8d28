"""GigE Vision's control protocol, the two parts of it that we send ourselves.

Action commands, which tell many devices to expose at once, now or at a set time of their common
clock; and the reading of a register, by which a device that another program holds can be asked.

References:
    Packet layouts as in Wireshark's dissector of GVCP.
"""

from __future__ import annotations

import ipaddress
import itertools
import select
import socket
import struct
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from capture.devices.protocol import ActionKeys
from capture.errors import DeviceError

GVCP_PORT = 3956
CONTROL_REGISTER = 0x0A00  # who controls the device
LINK_SPEED_REGISTER = 0x0670  # of its first interface, Mbit/s; since version 2.0

_KEY = 0x42
_HEADER = struct.Struct(">BBHHH")  # key, flags, command, length of what follows, request id
_ANSWER = struct.Struct(">HHHH")  # status, command, length, request id
_ACK_WANTED, _SCHEDULED = 0x01, 0x80
_READ_REGISTER, _ACTION = 0x0080, 0x0100
_TRIES = 3
_WORDS = {
    0x8001: "does not know the command",
    0x8002: "refused a parameter",
    0x8003: "has no such register",
    0x8006: "is held by another program",
    0x8007: "is busy",
    0x8013: "has no synchronized clock",
    0x8015: "has too many actions scheduled",
    0x8016: "got the command after its time",
}
_ids = itertools.count(1)


@dataclass(frozen=True)
class ActionResult:
    """What became of an action command.

    Attributes:
        sent_ns: when it was sent, by the host's monotonic clock.
        answered: addresses of the devices that accepted it.
        silent: addresses of those that did not answer.
        refused: by address, why, in words.
    """

    sent_ns: int
    answered: tuple[str, ...]
    silent: tuple[str, ...] = ()
    refused: Mapping[str, str] = field(default_factory=dict)

    @property
    def complete(self) -> bool:
        """Whether every device accepted it."""
        return not self.silent and not self.refused

    def __str__(self) -> str:
        if self.complete:
            return f"all {len(self.answered)} devices accepted the action command"
        parts = [f"{address} {why}" for address, why in self.refused.items()]
        if self.silent:
            parts.append(f"no answer from {', '.join(self.silent)}")
        return f"action command: {'; '.join(parts)}"


def action_packet(
    keys: ActionKeys, request: int, *, at_ns: int | None = None, want_answer: bool = True
) -> bytes:
    """The bytes of an action command.

    Args:
        keys: which devices act.
        request: number of the request, 1 to 65535.
        at_ns: when they act, by their clock, as it stands in the packet; None: at once.
        want_answer: whether devices shall answer.

    Raises:
        DeviceError: when the time does not fit 64 bits.
    """
    if at_ns is not None and not 0 <= at_ns < 1 << 64:
        raise DeviceError(f"the time of an action must fit 64 bits, found {at_ns}")
    body = struct.pack(">III", keys.device_key, keys.group_key, keys.group_mask)
    flags = _ACK_WANTED if want_answer else 0
    if at_ns is not None:
        flags |= _SCHEDULED
        body += struct.pack(">Q", at_ns)
    return _HEADER.pack(_KEY, flags, _ACTION, len(body), request) + body


def send_action(
    addresses: Sequence[str],
    keys: ActionKeys,
    *,
    at_ns: int | None = None,
    timeout_s: float = 0.2,
    broadcast: Iterable[str] = (),
    port: int = GVCP_PORT,
) -> ActionResult:
    """Send an action command, and collect one answer a device.

    Args:
        addresses: IP addresses of the devices that shall answer.
        keys: which devices act.
        at_ns: when they act, by their synchronized clock; None: at once, on arrival.
        timeout_s: how long to wait for answers.
        broadcast: addresses that reach all devices at once, one a network; without any, each device
            is sent a packet of its own, one after the other.
        port: of the devices.

    Raises:
        DeviceError: when there is nobody to send to, or the host cannot send.
    """
    wanted = [_ip(address) for address in dict.fromkeys(addresses)]
    targets = [_ip(address) for address in broadcast] or wanted
    if not targets:
        raise DeviceError("an action command needs at least one address")
    request = _next_id()
    packet = action_packet(keys, request, at_ns=at_ns)
    status: dict[str, int] = {}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        sent_ns = time.monotonic_ns()
        for target in targets:
            _send(sender, packet, target, port)
        deadline = time.monotonic() + timeout_s
        while len(status) < len(wanted):
            found = _answer(sender, _ACTION + 1, request, deadline)
            if found is None:
                break
            address, code, _ = found
            if address in wanted:
                status[address] = code
    return ActionResult(
        sent_ns,
        tuple(address for address in wanted if status.get(address) == 0),
        tuple(address for address in wanted if address not in status),
        {address: _words(status[address]) for address in wanted if status.get(address)},
    )


def read_register(
    address: str, register: int, *, timeout_s: float = 0.2, port: int = GVCP_PORT
) -> int:
    """Read a register of 32 bits; a device answers whoever controls it.

    Args:
        address: IP address of the device.
        register: its address in the device.
        timeout_s: how long to wait for each of three tries.
        port: of the device.

    Raises:
        DeviceError: when it does not answer, or refuses, saying why.
    """
    target = _ip(address)
    request = _next_id()
    packet = _HEADER.pack(_KEY, _ACK_WANTED, _READ_REGISTER, 4, request)
    packet += struct.pack(">I", register)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for _ in range(_TRIES):
            _send(sender, packet, target, port)
            found = _answer(sender, _READ_REGISTER + 1, request, time.monotonic() + timeout_s)
            if found is None:
                continue
            _, code, body = found
            if code:
                raise DeviceError(f"{address}: register 0x{register:04x}: it {_words(code)}")
            if len(body) < 4:
                raise DeviceError(f"{address}: answered with {len(body)} bytes, expected 4")
            return int.from_bytes(body[:4], "big")
    raise DeviceError(f"{address}: no answer within {_TRIES * timeout_s:.1f} s")


def _ip(address: str) -> str:
    try:
        return str(ipaddress.IPv4Address(address))
    except ValueError as error:
        raise DeviceError(
            f"expected an IPv4 address such as 10.0.0.11, found {address!r}"
        ) from error


def _next_id() -> int:
    return (next(_ids) - 1) % 0xFFFF + 1  # 0 is no request


def _send(sender: socket.socket, packet: bytes, target: str, port: int) -> None:
    try:
        sender.sendto(packet, (target, port))
    except OSError as error:
        raise DeviceError(f"{target}: cannot send to it: {error.strerror}") from error


def _answer(
    sender: socket.socket, command: int, request: int, deadline: float
) -> tuple[str, int, bytes] | None:
    """The next answer to a request: who, status, what; None when the deadline has passed."""
    while True:
        left = deadline - time.monotonic()
        if left <= 0 or not select.select([sender], [], [], left)[0]:
            return None
        try:
            data, (address, _) = sender.recvfrom(2048)
        except ConnectionError:  # a host that is there has nobody at that port
            continue
        if len(data) < _ANSWER.size:
            continue
        code, kind, length, number = _ANSWER.unpack_from(data)
        if kind == command and number == request:
            return address, code, data[_ANSWER.size : _ANSWER.size + length]


def _words(code: int) -> str:
    return _WORDS.get(code, f"answered with status 0x{code:04x}")
