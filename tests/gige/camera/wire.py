"""What goes over the wire: commands, status words, addresses of registers, packet layouts."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum

GVCP_PORT = 3956
GVCP_HEADER = struct.Struct(">BBHHH")  # 0x42, flags, command, length, request id
ACK_HEADER = struct.Struct(">HHHH")  # status, command, length, request id
COMMAND_KEY = 0x42
FLAG_ACK = 0x01
FLAG_EXTENDED_IDS = 0x10
FLAG_SCHEDULED = 0x80
IP_UDP_BYTES = 28


class Command(IntEnum):
    """Commands; the answer to each has the next higher number."""

    DISCOVERY = 0x0002
    FORCE_IP = 0x0004
    PACKET_RESEND = 0x0040
    READ_REGISTER = 0x0080
    WRITE_REGISTER = 0x0082
    READ_MEMORY = 0x0084
    WRITE_MEMORY = 0x0086
    ACTION = 0x0100


class Status(IntEnum):
    """Status words of answers and of stream packets."""

    SUCCESS = 0x0000
    NOT_IMPLEMENTED = 0x8001
    INVALID_PARAMETER = 0x8002
    INVALID_ADDRESS = 0x8003
    WRITE_PROTECT = 0x8004
    BAD_ALIGNMENT = 0x8005
    ACCESS_DENIED = 0x8006
    BUSY = 0x8007
    PACKET_UNAVAILABLE = 0x800C
    NO_REFERENCE_TIME = 0x8013
    OVERFLOW = 0x8015
    ACTION_LATE = 0x8016


class Refused(Exception):  # noqa: N818 - a status, not a mishap
    """A command that the device does not carry out."""

    def __init__(self, status: Status) -> None:
        super().__init__(status.name)
        self.status = status


class Reg(IntEnum):
    """Bootstrap registers."""

    VERSION = 0x0000
    DEVICE_MODE = 0x0004
    MAC_HIGH = 0x0008
    MAC_LOW = 0x000C
    IP_OPTIONS = 0x0010
    IP_CURRENT = 0x0014
    ADDRESS = 0x0024
    MASK = 0x0034
    GATEWAY = 0x0044
    MAKER = 0x0048
    MODEL = 0x0068
    DEVICE_VERSION = 0x0088
    MAKER_INFO = 0x00A8
    SERIAL = 0x00D8
    USER_NAME = 0x00E8
    XML_URL = 0x0200
    INTERFACES = 0x0600
    LINK_SPEED = 0x0670
    MESSAGE_CHANNELS = 0x0900
    STREAM_CHANNELS = 0x0904
    ACTION_SIGNALS = 0x0908
    ACTION_DEVICE_KEY = 0x090C
    STREAM_CAPABILITY = 0x092C
    CAPABILITY = 0x0934
    HEARTBEAT = 0x0938
    TICKS_HIGH = 0x093C
    TICKS_LOW = 0x0940
    TIME_CONTROL = 0x0944
    TIME_HIGH = 0x0948
    TIME_LOW = 0x094C
    GVCP_CONFIGURATION = 0x0954
    GVSP_CONFIGURATION = 0x0960
    PTP_STATUS = 0x096C
    ACTION_QUEUE = 0x0970
    PRIVILEGE = 0x0A00
    STREAM_PORT = 0x0D00
    PACKET_SIZE = 0x0D04
    PACKET_DELAY = 0x0D08
    STREAM_ADDRESS = 0x0D18
    STREAM_SOURCE_PORT = 0x0D1C
    STREAM_OPTIONS = 0x0D20
    STREAM_CONFIGURATION = 0x0D24
    ACTION_GROUP_KEY = 0x9800
    ACTION_GROUP_MASK = 0x9804


DISCOVERY_BYTES = 0xF8
EXTENDED_IDS_ON = 1 << 30  # of GVSP_CONFIGURATION
PTP_ON = 1 << 0  # of GVCP_CONFIGURATION
FIRE_TEST = 1 << 31  # of PACKET_SIZE
LATCH_TIME, RESET_TIME = 2, 1  # of TIME_CONTROL
# Names of the capability bits, lowest first: concatenation, write memory, packet resend, action.
CAPABILITIES = 0b1 | 0b10 | 0b100 | 1 << 6 | 1 << 28 | 1 << 30


class Part(IntEnum):
    """What a stream packet holds."""

    LEADER = 1
    TRAILER = 2
    PAYLOAD = 3


IMAGE, CHUNKS, IMAGE_AND_CHUNKS = 0x0001, 0x0004, 0x4001


@dataclass(frozen=True)
class PacketId:
    """Which packet of which frame.

    Attributes:
        frame: number of the frame.
        packet: within it, from 0, the leader.
        extended: whether numbers of 64 bits are in use.
    """

    frame: int
    packet: int
    extended: bool


def packet_header(of: PacketId, part: Part, status: int = 0) -> bytes:
    """The header of a stream packet."""
    if of.extended:
        return struct.pack(">HHIQI", status, 0, (0x80 | part) << 24, of.frame, of.packet)
    return struct.pack(">HHI", status, of.frame, part << 24 | of.packet)


def read_resend(flags: int, body: bytes) -> tuple[PacketId, int]:
    """A request to send packets again: the first of them, and the number of the last."""
    if flags & FLAG_EXTENDED_IDS:
        _channel, _, first, last, frame = struct.unpack_from(">HHIIQ", body)
        return PacketId(frame, first, True), last
    _channel, frame, first, last = struct.unpack_from(">HHII", body)
    return PacketId(frame, first & 0xFFFFFF, False), last & 0xFFFFFF
