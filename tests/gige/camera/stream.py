"""Frames as packets (GVSP): what is sent, what is kept for a second time, what is sent wrongly."""

from __future__ import annotations

import socket
import struct
from collections import OrderedDict
from dataclasses import dataclass

from tests.gige.camera.bank import Bank
from tests.gige.camera.faults import Defect, Faults, Resend
from tests.gige.camera.features import CHUNK_BYTES, CHUNK_IDS
from tests.gige.camera.pixels import FORMATS, Stamp, draw
from tests.gige.camera.settings import Settings
from tests.gige.camera.wire import (
    CHUNKS,
    EXTENDED_IDS_ON,
    IMAGE,
    IMAGE_AND_CHUNKS,
    IP_UDP_BYTES,
    PacketId,
    Part,
    Reg,
    Status,
    packet_header,
)

_KEPT = 64  # frames whose packets can be asked for again


@dataclass(frozen=True)
class Exposure:
    """A frame that was exposed.

    Attributes:
        number: of the frame, from 0 since the device was switched on.
        frame_id: on the wire.
        t_ns: true time of the trigger.
        t_dev_ns: the same by the device's clock.
        exposure_us: how long.
        line_status: levels of the inputs.
    """

    number: int
    frame_id: int
    t_ns: int
    t_dev_ns: int
    exposure_us: float
    line_status: int


class Stream:
    """Sends frames to whoever the registers name."""

    def __init__(self, bank: Bank, settings: Settings, faults: Faults, out: socket.socket) -> None:
        self._bank, self._settings, self._faults, self._out = bank, settings, faults, out
        self._kept: OrderedDict[int, list[tuple[Part, bytes]]] = OrderedDict()
        self.mark = 0
        self.path_mtu = 9000
        self.chunk_type = IMAGE_AND_CHUNKS
        self.asked = 0  # packets asked for again
        self.resent = 0

    @property
    def extended(self) -> bool:
        """Whether frame numbers of 64 bits are in use."""
        return bool(self._bank.get(Reg.GVSP_CONFIGURATION) & EXTENDED_IDS_ON)

    def payload_bytes(self) -> int:
        """Bytes of a frame, chunks included."""
        width, height = self._settings.get("Width"), self._settings.get("Height")
        image = width * height * (1 if self._bits() == 8 else 2)
        if not self._settings.get("ChunkModeActive"):
            return image
        return image + 8 + sum(CHUNK_BYTES[name] + 8 for name in self._chunks())

    def send(self, exposure: Exposure) -> str:
        """Send a frame; what became of it, in a word."""
        parts = self._parts(exposure)
        self._kept[exposure.frame_id] = parts
        while len(self._kept) > _KEPT:
            self._kept.popitem(last=False)
        if self._faults.dead or self._faults.due(Defect.LOSE, exposure.number):
            return "lost"
        dropped = self._faults.dropped(exposure.number)
        for _ in range(2 if self._faults.due(Defect.REPEAT, exposure.number) else 1):
            for number, (part, body) in enumerate(parts):
                if number not in dropped:
                    self._send(PacketId(exposure.frame_id, number, self.extended), part, body)
        return "dropped" if dropped else "sent"

    def resend(self, first: PacketId, last: int) -> None:
        """Answer a request for packets, as well as the faults allow."""
        self.asked += last - first.packet + 1
        parts = self._kept.get(first.frame)
        mode = self._faults.resend
        if self._faults.dead or mode is Resend.SILENT:
            return
        for number in range(first.packet, last + 1):
            of = PacketId(first.frame, number, first.extended)
            if parts is None or number >= len(parts) or mode is Resend.UNAVAILABLE:
                self._send(of, Part.PAYLOAD, b"", Status.PACKET_UNAVAILABLE)
                continue
            part, body = parts[number]
            if mode is Resend.WRONG_FRAME:
                of = PacketId(self.next_id(next(reversed(self._kept))), number, first.extended)
            elif mode is Resend.WRONG_DATA and part is Part.PAYLOAD:
                body = self._neighbour(parts, number)
            self._send(of, part, body)
            self.resent += 1

    def next_id(self, frame_id: int) -> int:
        """The number after one: 16 bits wrap to 1, for 0 is no number."""
        return frame_id + 1 if self.extended or frame_id < 0xFFFF else 1

    def fire_test(self) -> None:
        """Send a test packet of the size that is set; the path loses it when it is too large."""
        size = self._bank.get(Reg.PACKET_SIZE) & 0xFFFF
        if size <= self.path_mtu:
            self._write(b"\0" * (size - IP_UDP_BYTES))

    def _bits(self) -> int:
        return FORMATS[self._settings.chosen("PixelFormat")][1]

    def _chunks(self) -> list[str]:
        return [name for name in CHUNK_BYTES if self._settings.chunk_on(name)]

    def _parts(self, exposure: Exposure) -> list[tuple[Part, bytes]]:
        settings = self._settings
        width, height = settings.get("Width"), settings.get("Height")
        stamp = Stamp(self.mark, exposure.frame_id, exposure.t_ns)
        data = draw(stamp, width, height, self._bits())
        kind = IMAGE
        if settings.get("ChunkModeActive"):
            kind = self.chunk_type
            data += struct.pack(">II", CHUNK_IDS["Image"], len(data))
            for name in self._chunks():
                value = _chunk(name, exposure)
                data += value + struct.pack(">II", CHUNK_IDS[name], len(value))
        leader = struct.pack(">HHQ", 0, kind, exposure.t_dev_ns)
        if kind != CHUNKS:
            leader += struct.pack(
                ">IIIIIHH", settings.get("PixelFormat"), width, height, 0, 0, 0, 0
            )
        trailer = struct.pack(">HHI", 0, kind, height)
        overhead = IP_UDP_BYTES + (20 if self.extended else 8)
        step = (self._bank.get(Reg.PACKET_SIZE) & 0xFFFF) - overhead
        blocks = [(Part.PAYLOAD, data[at : at + step]) for at in range(0, len(data), step)]
        return [(Part.LEADER, leader), *blocks, (Part.TRAILER, trailer)]

    def _neighbour(self, parts: list[tuple[Part, bytes]], number: int) -> bytes:
        size = len(parts[number][1])
        other = number - 1 if number > 1 else number + 1
        return parts[other][1][:size].ljust(size, b"\0")

    def _send(self, of: PacketId, part: Part, body: bytes, status: int = 0) -> None:
        self._write(packet_header(of, part, status) + body)

    def _write(self, packet: bytes) -> None:
        port = self._bank.get(Reg.STREAM_PORT) & 0xFFFF
        if port and not self._faults.dead:
            address = socket.inet_ntoa(self._bank.get_bytes(Reg.STREAM_ADDRESS, 4))
            self._out.sendto(packet, (address, port))


def _chunk(name: str, exposure: Exposure) -> bytes:
    if name == "ExposureTime":
        return struct.pack(">d", exposure.exposure_us)
    if name == "Timestamp":
        return struct.pack(">Q", exposure.t_dev_ns)
    if name == "FrameID":
        return struct.pack(">Q", exposure.frame_id)
    return struct.pack(">I", exposure.line_status)
