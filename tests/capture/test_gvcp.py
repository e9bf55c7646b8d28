from __future__ import annotations

import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest

from capture.devices.gvcp import ActionResult, action_packet, read_register, send_action
from capture.devices.protocol import ActionKeys
from capture.errors import DeviceError

KEYS = ActionKeys(device_key=0x01020304, group_key=5, group_mask=0xF0)


class Responder:
    """A device that answers on a loopback address of its own, as it is told to."""

    def __init__(self, address: str, port: int, *, status: int = 0, silent: int = 0) -> None:
        self.status, self.silent = status, silent  # `silent`: so many requests get no answer
        self.junk: list[bytes] = []  # sent before each answer
        self.registers: dict[int, int] = {}
        self.received: list[bytes] = []
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((address, port))
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    @property
    def port(self) -> int:
        return int(self._socket.getsockname()[1])

    def close(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as waker:
            waker.sendto(b"", self._socket.getsockname())
        self._thread.join()
        self._socket.close()

    def _serve(self) -> None:
        while True:
            data, sender = self._socket.recvfrom(2048)
            if not data:
                return
            self.received.append(data)
            if len(self.received) <= self.silent:
                continue
            for junk in self.junk:
                self._socket.sendto(junk, sender)
            _, _, command, _, request = struct.unpack_from(">BBHHH", data)
            body = b""
            if command == 0x80:
                (register,) = struct.unpack_from(">I", data, 8)
                body = struct.pack(">I", self.registers.get(register, 0))
            head = struct.pack(">HHHH", self.status, command + 1, len(body), request)
            self._socket.sendto(head + body, sender)


@contextmanager
def responders(*kinds: dict[str, int]) -> Iterator[list[Responder]]:
    with ExitStack() as stack:
        made: list[Responder] = []
        for number, kind in enumerate(kinds, start=1):
            port = made[0].port if made else 0
            made.append(Responder(f"127.0.0.{number}", port, **kind))
            stack.callback(made[-1].close)
        yield made


def test_the_bytes_of_an_action_command() -> None:
    now = action_packet(KEYS, 0x1234)
    assert now.hex(" ") == "42 01 01 00 00 0c 12 34 01 02 03 04 00 00 00 05 00 00 00 f0"
    later = action_packet(KEYS, 7, at_ns=0x0102030405060708)
    assert later[:8].hex(" ") == "42 81 01 00 00 14 00 07"
    assert later[8:20] == now[8:]
    assert later[20:].hex() == "0102030405060708"
    assert action_packet(KEYS, 1, want_answer=False)[1] == 0
    with pytest.raises(DeviceError, match="must fit 64 bits, found -1"):
        action_packet(KEYS, 1, at_ns=-1)


def test_every_device_answers_once() -> None:
    with responders({}, {}, {}) as made:
        addresses = ["127.0.0.1", "127.0.0.2", "127.0.0.3"]
        result = send_action(addresses, KEYS, at_ns=10**18, timeout_s=5.0, port=made[0].port)
        assert result.answered == tuple(addresses)
        assert result.complete
        assert str(result) == "all 3 devices accepted the action command"
        packets = {one.received[0] for one in made}
        assert len(packets) == 1  # the same request went to all
        assert packets.pop()[8:] == struct.pack(">IIIQ", 0x01020304, 5, 0xF0, 10**18)


def test_the_silent_and_the_refusing_are_named() -> None:
    with responders({}, {"silent": 9}, {"status": 0x8016}) as made:
        result = send_action(
            ["127.0.0.1", "127.0.0.2", "127.0.0.3"], KEYS, timeout_s=0.2, port=made[0].port
        )
    assert result.answered == ("127.0.0.1",)
    assert result.silent == ("127.0.0.2",)
    assert result.refused == {"127.0.0.3": "got the command after its time"}
    assert not result.complete
    assert str(result) == (
        "action command: 127.0.0.3 got the command after its time; no answer from 127.0.0.2"
    )


def test_answers_to_other_requests_and_noise_do_not_count() -> None:
    with responders({}) as made:
        made[0].junk = [b"", b"abc", struct.pack(">HHHH", 0, 0x101, 0, 0), bytes(2000)]
        assert send_action(["127.0.0.1"], KEYS, timeout_s=5.0, port=made[0].port).complete
    with responders({"silent": 9}) as made:
        made[0].silent, made[0].junk = 9, []
        result = send_action(["127.0.0.1"], KEYS, timeout_s=0.1, port=made[0].port)
    assert result.silent == ("127.0.0.1",)


def test_one_packet_to_a_common_address_reaches_who_listens_there() -> None:
    with responders({}) as made:
        result = send_action(
            ["127.0.0.1", "127.0.0.9"], KEYS, timeout_s=0.2, broadcast=["127.0.0.1"],
            port=made[0].port,
        )  # fmt: skip
        assert len(made[0].received) == 1
    assert result == ActionResult(result.sent_ns, ("127.0.0.1",), ("127.0.0.9",))


def test_a_register_is_read_again_when_an_answer_is_lost() -> None:
    with responders({"silent": 2}) as made:
        made[0].registers[0x0A00] = 2
        assert read_register("127.0.0.1", 0x0A00, timeout_s=0.1, port=made[0].port) == 2
        assert len(set(made[0].received)) == 1  # the same request each time


def test_a_register_that_cannot_be_read_says_why() -> None:
    with responders({"status": 0x8006}, {"silent": 9}) as made:
        port = made[0].port
        with pytest.raises(DeviceError, match=r"127.0.0.1: register 0x0a00: it is held by another"):
            read_register("127.0.0.1", 0x0A00, timeout_s=5.0, port=port)
        with pytest.raises(DeviceError, match=r"127.0.0.2: no answer within 0.2 s"):
            read_register("127.0.0.2", 0x0A00, timeout_s=0.05, port=port)


@pytest.mark.parametrize("address", ["", "cam01", "10.0.0.300", "10.0.0.1; rm"])
def test_what_is_no_address_is_refused(address: str) -> None:
    with pytest.raises(DeviceError, match="expected an IPv4 address such as"):
        send_action([address], KEYS)


def test_an_action_for_nobody_is_refused() -> None:
    with pytest.raises(DeviceError, match="at least one address"):
        send_action([], KEYS)
