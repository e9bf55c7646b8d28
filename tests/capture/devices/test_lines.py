"""Trigger lines: who tells devices to expose, and what is said when one does not."""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import pytest

from capture.devices.faults import Fault, FaultKind
from capture.devices.lines import (
    ActionLine,
    ActionSettings,
    HostLine,
    RealTimeLine,
    SoftwareLine,
)
from capture.devices.protocol import ActionKeys, TriggerKind
from capture.devices.simulated import (
    SimulatedDevice,
    SimulatedLine,
    SimulatedSettings,
    StreamingDevice,
    streaming_array,
)
from capture.errors import DeviceError, SettingsError
from capture.frame_header import ImageLayout
from tests.capture.recording import StampScene, cameras

SMALL = ImageLayout(32, 8, 1, "uint8")
PORT = 34_956  # of our own listeners, on addresses of the loopback


def test_a_host_line_waits_by_the_monotonic_clock_and_sends_nothing() -> None:
    line = HostLine()
    assert not line.fires
    t_ns = time.monotonic_ns() + 20_000_000
    line.fire(t_ns)
    assert line.now_ns() >= t_ns
    line.wait(t_ns - 10**9)  # the past: at once


def test_a_software_line_tells_each_device_and_reports_those_that_do_not_take_it() -> None:
    array = replace(streaming_array(3, SMALL), trigger=TriggerKind.SOFTWARE)
    array.prepare(10_000_000, 1000.0)
    for device in array.devices:
        device.acquire.start()
    told: list[str] = []
    line = SoftwareLine(array.devices, told.append)
    assert line.fires
    dead = array.devices[1]
    assert isinstance(dead, StreamingDevice)
    dead.inject(Fault(FaultKind.DEATH, 1))
    for k in range(3):
        line.fire(time.monotonic_ns() + k)
        time.sleep(0.002)
    time.sleep(0.03)
    assert [len(device.frames.poll()) for device in array.devices] == [3, 1, 3]
    assert told == ["cam01 did not take a software trigger: cam01: does not answer; reconnect it"]


def test_devices_that_cannot_be_told_are_named() -> None:
    wired = SimulatedDevice(cameras(1)[0], StampScene(), SimulatedLine(), SimulatedSettings())
    with pytest.raises(DeviceError, match="software triggers: cam00 cannot be told to expose"):
        SoftwareLine((wired,))
    with pytest.raises(DeviceError, match="action commands: cam00 cannot be sent any"):
        ActionLine((wired,), ActionSettings())
    with pytest.raises(SettingsError, match="must be above 0, found 20"):
        ActionSettings(timeout_ms=0.0)


class ActionDevice(StreamingDevice):
    """A simulated device that has an address."""

    action_address = ""


@dataclass
class Listener:
    """Answers action commands at an address of the loopback, as long as `answers` is set."""

    address: str
    answers: bool = True

    def __post_init__(self) -> None:
        self.packets: list[bytes] = []
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((self.address, PORT))
        self.thread = threading.Thread(target=self.serve)
        self.thread.start()

    def serve(self) -> None:
        while True:
            packet, sender = self.socket.recvfrom(2048)
            if not packet:
                return
            self.packets.append(packet)
            if self.answers:
                request = struct.unpack_from(">H", packet, 6)[0]
                self.socket.sendto(struct.pack(">HHHH", 0, 0x0101, 0, request), sender)

    def close(self) -> None:
        self.socket.sendto(b"", (self.address, PORT))
        self.thread.join()
        self.socket.close()


@pytest.fixture
def listeners() -> Iterator[list[Listener]]:
    made = [Listener(f"127.0.9.{place}") for place in (1, 2)]
    yield made
    for listener in made:
        listener.close()


def action_devices() -> list[ActionDevice]:
    line = RealTimeLine()
    devices = [
        ActionDevice(f"cam{place:02d}", SMALL, line, SimulatedSettings()) for place in (1, 2)
    ]
    for place, device in enumerate(devices, start=1):
        device.action_address = f"127.0.9.{place}"
    return devices


def test_action_commands_carry_keys_and_answers_are_counted(listeners: list[Listener]) -> None:
    told: list[str] = []
    settings = ActionSettings(keys=ActionKeys(group_key=7), timeout_ms=300.0, port=PORT)
    line = ActionLine(action_devices(), settings, told=told.append)
    line.fire(time.monotonic_ns())
    assert told == []
    listeners[1].answers = False
    line.fire(time.monotonic_ns())
    line.fire(time.monotonic_ns())
    listeners[1].answers = True
    line.fire(time.monotonic_ns())
    assert told == [
        "trigger 2: action command: no answer from 127.0.9.2",
        "trigger 4: cam02 accepts action commands again",
    ]
    assert (line.sent, dict(line.unanswered)) == (4, {"127.0.9.2": 2})
    keys = [struct.unpack_from(">III", packet, 8) for packet in listeners[0].packets]
    assert keys == [(1, 7, 0xFFFFFFFF)] * 4


def test_scheduled_commands_go_ahead_of_their_time_in_the_devices_clock(
    listeners: list[Listener],
) -> None:
    settings = ActionSettings(ahead_ms=30.0, timeout_ms=300.0, port=PORT)
    line = ActionLine(action_devices(), settings, common_ns=lambda t_ns: t_ns + 10**12)
    t_ns = time.monotonic_ns() + 40_000_000
    line.fire(t_ns)
    assert line.unanswered == {}
    [packet] = listeners[0].packets
    flags, at_ns = packet[1], struct.unpack_from(">Q", packet, 20)[0]
    assert (flags & 0x80, at_ns) == (0x80, t_ns + 10**12)
