"""The summary at the end of a file of frames, read: where its chunks are.

References:
    MCAP file format specification, https://mcap.dev/spec
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from typing import NamedTuple

from capture.mcap_records import FOOTER, MAGIC, RECORD, Op

_ONCE_BYTES = 1 << 16  # of all in a summary that there is once
_CHUNK_INDEX_BYTES = RECORD.size + 74


class Summary(NamedTuple):
    """The summary of a file, its CRC checked.

    Attributes:
        start: where in the file it begins.
        content: its records, up to the footer.
        ended: whether the file ends behind the footer as it should.
    """

    start: int
    content: bytes
    ended: bool


def find_summary(read: Callable[[int, int], bytes], size: int, chunk_bytes: int) -> Summary | None:
    """The summary of a file; None when there is none whose CRC is right.

    Args:
        read: gives the bytes at an offset, at most so many.
        size: of the file.
        chunk_bytes: of the chunk of one frame: a summary that claims more than the frames of this
            file can need is not read.
    """
    tail = RECORD.size + FOOTER.size + len(MAGIC)
    footer = read(max(0, size - tail), tail)
    if len(footer) < tail or RECORD.unpack_from(footer) != (Op.FOOTER, FOOTER.size):
        return None
    start, _, crc = FOOTER.unpack_from(footer, RECORD.size)
    length = size - tail - start
    if not 0 < start <= size - tail or length > _longest_summary(start, chunk_bytes):
        return None
    content = read(start, length)
    if zlib.crc32(content + footer[: RECORD.size + FOOTER.size - 4]) != crc:
        return None
    return Summary(start, content, footer.endswith(MAGIC))


def parse_chunks(summary_bytes: bytes) -> list[tuple[int, int]]:
    """Offset and length of each chunk, from a summary whose CRC was checked."""
    chunks, at = [], 0
    while at + RECORD.size <= len(summary_bytes):
        opcode, length = RECORD.unpack_from(summary_bytes, at)
        if at + RECORD.size + length > len(summary_bytes):
            break
        if opcode == Op.CHUNK_INDEX and length >= 32:
            offset, size = struct.unpack_from("<QQ", summary_bytes, at + RECORD.size + 16)
            chunks.append((int(offset), int(size)))
        at += RECORD.size + length
    return chunks


def _longest_summary(data_bytes: int, chunk_bytes: int) -> int:
    """No summary is longer, of a file with `data_bytes` before it in chunks of `chunk_bytes`."""
    return _ONCE_BYTES + data_bytes // chunk_bytes * _CHUNK_INDEX_BYTES
