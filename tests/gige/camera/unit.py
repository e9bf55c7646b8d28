"""A device from when it is switched on until it is switched off: its parts, wired together."""

from __future__ import annotations

import socket
import struct
import time

from tests.gige.camera.agenda import Agenda
from tests.gige.camera.bank import Bank, Register
from tests.gige.camera.clock import DeviceClock
from tests.gige.camera.commands import Commands
from tests.gige.camera.description import describe
from tests.gige.camera.faults import Faults
from tests.gige.camera.features import CHUNK_SWITCHES, SETTINGS_START
from tests.gige.camera.settings import Settings
from tests.gige.camera.setup import Setup
from tests.gige.camera.stream import Stream
from tests.gige.camera.trigger import Trigger
from tests.gige.camera.wire import (
    CAPABILITIES,
    EXTENDED_IDS_ON,
    FIRE_TEST,
    LATCH_TIME,
    RESET_TIME,
    Refused,
    Reg,
    Status,
)

_XML_START = 0x40000
_QUEUE = 16  # action commands that wait for their time


class Unit:
    """One life of a device."""

    def __init__(self, setup: Setup, out: socket.socket) -> None:
        self.setup, self.bank, self.faults, self.agenda = setup, Bank(), Faults(), Agenda()
        self.clock = DeviceClock(setup, time.monotonic_ns())
        self._blocks()
        self.settings = Settings(setup, self.bank, lambda: self.trigger.acquiring)
        self.stream = Stream(self.bank, self.settings, self.faults, out)
        self.stream.mark = int.from_bytes(socket.inet_aton(setup.address)[2:], "big")
        self.stream.path_mtu = setup.path_mtu
        self.trigger = Trigger(self.settings, self.clock, self.faults, self.agenda, self.stream)
        self.trigger.first_id, self.trigger.readout_us = setup.first_id, setup.readout_us
        self.commands = Commands(self.bank, self.faults, self.stream.resend, self.act)
        self.commands.lost_control = self.trigger.stop
        self.waiting_actions = 0
        self.reset_asked = False
        self._fill(out.getsockname()[1])
        self._bootstrap()
        self._vendor()

    def act(self, at_ns: int | None) -> Status:
        """Carry an action out, now or at a time by the device's clock."""
        now_ns = time.monotonic_ns()
        if at_ns is None:
            self.trigger.edge("Action1", now_ns)
            return Status.SUCCESS
        if not self.clock.follows(now_ns):
            return Status.NO_REFERENCE_TIME
        if self.waiting_actions >= _QUEUE:
            return Status.OVERFLOW
        true_ns = self.clock.when(at_ns, now_ns)
        if true_ns < now_ns:
            self.trigger.edge("Action1", now_ns)
            return Status.ACTION_LATE
        self.waiting_actions += 1
        self.agenda.at(true_ns, lambda: self._scheduled(true_ns))
        return Status.SUCCESS

    def _scheduled(self, true_ns: int) -> None:
        self.waiting_actions -= 1
        self.trigger.edge("Action1", true_ns)

    def _blocks(self) -> None:
        self.bank.block(0, 0xA000)
        self.bank.block(SETTINGS_START, 0x1000)
        self.bank.block(CHUNK_SWITCHES, 0x100)

    def _fill(self, source_port: int) -> None:
        setup, put, text = self.setup, self.bank.put, self.bank.put_bytes
        address = socket.inet_aton(setup.address)
        put(Reg.VERSION, 0x00020000)
        put(Reg.DEVICE_MODE, 0x80000001)
        put(Reg.MAC_HIGH, 0x0200)
        text(Reg.MAC_LOW, address)
        put(Reg.IP_OPTIONS, 0b111)
        put(Reg.IP_CURRENT, 0b101)
        text(Reg.ADDRESS, address)
        put(Reg.MASK, 0xFF000000)
        text(Reg.MAKER, b"Likeness")
        text(Reg.MODEL, setup.model.encode()[:31])
        text(Reg.DEVICE_VERSION, b"1")
        text(Reg.SERIAL, setup.serial.encode()[:15])
        xml = describe(self.settings.table)
        self.bank.block(_XML_START, -(-len(xml) // 4) * 4, xml)
        text(Reg.XML_URL, f"Local:own.xml;{_XML_START:x};{len(xml):x}".encode() + b"\0")
        put(Reg.INTERFACES, 1)
        put(Reg.LINK_SPEED, setup.link_mbps)
        put(Reg.STREAM_CHANNELS, 1)
        put(Reg.ACTION_SIGNALS, 1)
        put(Reg.CAPABILITY, CAPABILITIES)
        put(Reg.TICKS_LOW, 1_000_000_000)
        put(Reg.PACKET_SIZE, 1500)
        put(Reg.STREAM_SOURCE_PORT, source_port)
        put(Reg.ACTION_QUEUE, _QUEUE)

    def _bootstrap(self) -> None:
        register = self.bank.register
        register(Register(Reg.TIME_CONTROL, writable=True, wrote=self._time_control))
        register(Register(Reg.STREAM_PORT, writable=True))
        register(Register(Reg.STREAM_ADDRESS, writable=True))
        register(Register(Reg.STREAM_CONFIGURATION, writable=True))
        register(Register(Reg.GVCP_CONFIGURATION, writable=True))
        register(
            Register(
                Reg.PACKET_SIZE, writable=True, check=self._packet_size, wrote=self._test_packet
            )
        )
        register(Register(Reg.GVSP_CONFIGURATION, writable=True, check=self._id_mode))
        self.settings.on_read("GevIEEE1588Status", self._ptp_state)

    def _vendor(self) -> None:
        on = self.settings.on_write
        on("AcquisitionStart", lambda _: self.trigger.start(time.monotonic_ns()))
        on("AcquisitionStop", lambda _: self.trigger.stop())
        on("TriggerSoftware", lambda _: self._software())
        on("TimestampLatch", lambda _: self._time_control(LATCH_TIME))
        on("TimestampReset", lambda _: self._time_control(RESET_TIME))
        on("GevIEEE1588", self._ptp)
        on("PtpEnable", self._ptp)
        on("PtpDataSetLatch", lambda _: self._ptp_latch())
        on("DeviceReset", lambda _: self._reset())
        self.settings.on_read("PayloadSize", self.stream.payload_bytes)
        self._ptp_latch()

    def _software(self) -> None:
        self.trigger.edge("Software", time.monotonic_ns())

    def _reset(self) -> None:
        self.reset_asked = True

    def _time_control(self, value: int) -> None:
        now_ns = time.monotonic_ns()
        if value & RESET_TIME:
            self.clock.reset(now_ns)
        if value & LATCH_TIME:
            self.bank.put(Reg.TIME_HIGH, self.clock.read(now_ns), 8)

    def _ptp(self, on: int) -> None:
        self.clock.enable(bool(on), time.monotonic_ns())
        self.settings.put("GevIEEE1588", on)
        self.settings.put("PtpEnable", on)

    def _ptp_state(self) -> int:
        return self.clock.state(time.monotonic_ns())

    def _ptp_latch(self) -> None:
        follows = self.clock.follows(time.monotonic_ns())
        self.settings.put("PtpStatus", self._ptp_state())
        self.settings.put("PtpOffsetFromMaster", self.clock.offset_ns if follows else 0)
        self.settings.put("PtpGrandmasterClockID", self.clock.grandmaster if follows else 0)

    def _packet_size(self, data: bytes) -> None:
        size = struct.unpack(">I", data)[0] & 0xFFFF
        if not 220 <= size <= 9000 or size % 4:
            raise Refused(Status.INVALID_PARAMETER)

    def _test_packet(self, value: int) -> None:
        self.bank.put(Reg.PACKET_SIZE, value & ~FIRE_TEST)
        if value & FIRE_TEST:
            self.stream.fire_test()

    def _id_mode(self, data: bytes) -> None:
        asked = int.from_bytes(data, "big") & EXTENDED_IDS_ON
        if (
            self.trigger.acquiring
            and asked != self.bank.get(Reg.GVSP_CONFIGURATION) & EXTENDED_IDS_ON
        ):
            raise Refused(Status.BUSY)
