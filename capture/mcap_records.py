"""Records of the MCAP file format, packed and parsed: those that a file of frames needs.

References:
    MCAP file format specification, https://mcap.dev/spec
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from enum import IntEnum
from pathlib import Path

from capture.errors import TakeError
from capture.frame_header import HEADER_BYTES, HEADER_TEXT

MAGIC = b"\x89MCAP0\r\n"
RECORD = struct.Struct("<BQ")  # opcode, length of what follows
CHUNK_HEAD = struct.Struct("<QQQIIQ")  # start, end, size, crc, name of compression: none, size
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
FOOTER = struct.Struct("<QQI")  # start of summary, of summary offsets, crc
MESSAGE_PREFIX_BYTES = RECORD.size + MESSAGE_HEAD.size + HEADER_BYTES  # before the pixels
LARGEST_CHANNEL = 1 << 20  # bytes of its record: a file can claim any length
_INDEX_BYTES = RECORD.size + 22  # of the message index that follows each chunk


class Op(IntEnum):
    """Kinds of records."""

    HEADER = 1
    FOOTER = 2
    SCHEMA = 3
    CHANNEL = 4
    MESSAGE = 5
    CHUNK = 6
    MESSAGE_INDEX = 7
    CHUNK_INDEX = 8
    STATISTICS = 11
    SUMMARY_OFFSET = 14
    DATA_END = 15


def record(opcode: Op, content: bytes) -> bytes:
    """Any record."""
    return RECORD.pack(opcode, len(content)) + content


DATA_END = record(Op.DATA_END, bytes(4))  # 0: no CRC of the data section


def header_record() -> bytes:
    """The first record of a file."""
    return record(Op.HEADER, _text("") + _text("likeness"))


def schema_record() -> bytes:
    """The schema: how a message is laid out, for a person to read."""
    text = _text("likeness.Frame") + _text("x-likeness-struct") + _text(HEADER_TEXT)
    return record(Op.SCHEMA, struct.pack("<H", 1) + text)


def channel_record(device: str, metadata: Mapping[str, str]) -> bytes:
    """The only channel of a file, its topic the device."""
    pairs = b"".join(_text(key) + _text(value) for key, value in metadata.items())
    head = struct.pack("<HH", 1, 1) + _text(device) + _text("x-likeness-frame")
    return record(Op.CHANNEL, head + struct.pack("<I", len(pairs)) + pairs)


def chunk_head(time: int, size: int, crc: int) -> bytes:
    """The front of a chunk that holds `size` bytes of records, all of one time."""
    head = CHUNK_HEAD.pack(time, time, size, crc, 0, size)
    return RECORD.pack(Op.CHUNK, len(head) + size) + head


def message_head(sequence: int, time: int, size: int) -> bytes:
    """The front of a message of `size` bytes."""
    head = MESSAGE_HEAD.pack(1, sequence & 0xFFFFFFFF, time, time)
    return RECORD.pack(Op.MESSAGE, len(head) + size) + head


def message_index(time: int) -> bytes:
    """The index of a chunk that holds one message."""
    return record(Op.MESSAGE_INDEX, struct.pack("<HIQQ", 1, 16, time, 0))


def summary(
    start: int, schema: bytes, channel: bytes, chunks: Sequence[tuple[int, int, int]]
) -> bytes:
    """All that follows the data: schema, channel, statistics, chunk index, offsets and footer.

    Args:
        start: where in the file it will stand.
        schema: the schema's record.
        channel: the channel's record.
        chunks: time, offset and length of each chunk record.
    """
    index = b"".join(_chunk_index(*chunk) for chunk in chunks)
    statistics = _statistics([time for time, _, _ in chunks])
    groups = [(Op.SCHEMA, schema), (Op.CHANNEL, channel)]
    groups += [(Op.STATISTICS, statistics), (Op.CHUNK_INDEX, index)]
    body, offsets, at = b"", b"", start
    for opcode, group in groups:
        if group:
            offsets += record(Op.SUMMARY_OFFSET, struct.pack("<BQQ", opcode, at, len(group)))
        body, at = body + group, at + len(group)
    footer = RECORD.pack(Op.FOOTER, FOOTER.size) + struct.pack("<QQ", start, start + len(body))
    crc = zlib.crc32(body + offsets + footer)
    return body + offsets + footer + struct.pack("<I", crc) + MAGIC


def parse_channel(content: bytes, path: Path) -> dict[str, str]:
    """The metadata of a channel record's content.

    Raises:
        TakeError: naming the file, when it is damaged.
    """
    try:
        at, texts = 4, []
        for _ in range(2):
            text, at = _read_text(content, at)
        at += 4
        while at < len(content):
            text, at = _read_text(content, at)
            texts.append(text)
        return dict(zip(texts[::2], texts[1::2], strict=True))
    except (struct.error, UnicodeDecodeError, ValueError) as error:
        raise TakeError(f"{path}: damaged channel record: {error}") from error


def _statistics(times: Sequence[int]) -> bytes:
    count = len(times)
    first, last = min(times, default=0), max(times, default=0)
    content = struct.pack("<QHIIIIQQ", count, 1, 1, 0, 0, count, first, last)
    return record(Op.STATISTICS, content + struct.pack("<IHQ", 10, 1, count))


def _chunk_index(time: int, offset: int, length: int) -> bytes:
    size = length - RECORD.size - CHUNK_HEAD.size
    content = struct.pack("<QQQQ", time, time, offset, length)
    content += struct.pack("<IHQ", 10, 1, offset + length)
    return record(Op.CHUNK_INDEX, content + struct.pack("<QIQQ", _INDEX_BYTES, 0, size, size))


def _text(text: str) -> bytes:
    data = text.encode()
    return struct.pack("<I", len(data)) + data


def _read_text(content: bytes, at: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", content, at)
    if at + 4 + length > len(content):
        raise ValueError("a string reaches beyond its record")
    return content[at + 4 : at + 4 + length].decode(), at + 4 + length
