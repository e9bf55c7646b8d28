"""Finding the whole frames of a file, whatever happened to the rest of it.

Frames of a device all have the same length, so behind a damaged one the next is looked for where it
should be, and if it is not there, by the bytes that a chunk of that length begins with. A frame
counts as whole when its CRC is right.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from capture import mcap_records as records
from capture.crc import Crc32Joiner, crc32
from capture.errors import TakeError
from capture.frame_header import HEADER_BYTES, FrameHeader, ImageLayout
from capture.mcap import (
    FrameReader,
    check_frame,
    file_head,
    frame_bytes,
    has_sound_front,
    header_in,
    log_time_ns,
)
from capture.mcap_records import CHUNK_HEAD, MESSAGE_PREFIX_BYTES, RECORD, Op
from capture.mcap_summary import find_summary

_FRONT_BYTES = RECORD.size + CHUNK_HEAD.size + MESSAGE_PREFIX_BYTES
_HEADER_AT = _FRONT_BYTES - HEADER_BYTES
_DATA_END = records.DATA_END[: RECORD.size]
_INDEX_BYTES = len(records.message_index(0))
_SCHEMA = records.schema_record()
_WINDOW = 1 << 20
_FARTHEST = 10_000  # triggers without a frame, before a header that has no CRC is believed


@dataclass(frozen=True)
class Damage:
    """A stretch of a file in which there is no whole frame.

    Attributes:
        offset: where it begins.
        size: bytes.
        triggers: of the frames that it held, as far as can be told.
        frames: how many it held, as far as can be told.
        torn: whether it is the front of a single frame, with nothing behind it.
    """

    offset: int
    size: int
    triggers: tuple[int, ...]
    frames: int
    torn: bool


@dataclass(frozen=True, eq=False)
class Salvage:
    """What a file holds.

    Attributes:
        path: the file.
        device: whose frames.
        layout: size and pixel type of the frames.
        headers: of the whole frames, in the order of the file.
        offsets: where the chunk of each begins.
        damages: the stretches without a whole frame.
        closed_well: whether the file needs nothing.
        in_order: whether everything up to the last whole frame is as it was written.
    """

    path: Path
    device: str
    layout: ImageLayout
    headers: tuple[FrameHeader, ...]
    offsets: tuple[int, ...]
    damages: tuple[Damage, ...]
    closed_well: bool
    in_order: bool

    @property
    def end(self) -> int:
        """Where the last whole frame ends: behind its chunk, before its index."""
        if self.offsets:
            return self.offsets[-1] + frame_bytes(self.layout)
        return len(file_head(self.device, self.layout)[0])


def salvage(path: Path, device: str, layout: ImageLayout, place: int) -> Salvage:
    """Find the whole frames of a file; it is only read.

    Args:
        path: the file.
        device: whose frames it should hold.
        layout: size and pixel type that they should have.
        place: of the device in the take's list.
    """
    with path.open("rb", buffering=0) as file:
        return _Search(file.fileno(), path, layout, place).run(device)


def layout_of(path: Path) -> tuple[str, ImageLayout] | None:
    """Device and layout that a file's own head names; None when its head is damaged."""
    try:
        reader = FrameReader(path)
    except TakeError:
        return None
    return reader.device, reader.layout


class _Search:
    """One walk through a file."""

    def __init__(self, handle: int, path: Path, layout: ImageLayout, place: int) -> None:
        self._handle, self._path, self._layout, self._place = handle, path, layout, place
        self._size = os.fstat(handle).st_size
        self._data_end = self._size  # or where the summary says that the frames end
        self._chunk_bytes = frame_bytes(layout)
        self._stride = self._chunk_bytes + _INDEX_BYTES
        self._pattern = RECORD.pack(Op.CHUNK, self._chunk_bytes - RECORD.size)
        self._joiner = Crc32Joiner(layout.nbytes)
        self._chunk = memoryview(bytearray(self._chunk_bytes))
        self._headers: list[FrameHeader] = []
        self._offsets: list[int] = []
        self._damages: list[Damage] = []
        self._in_order = True  # so far
        self._summary_sound = False

    def run(self, device: str) -> Salvage:
        """Walk from the first frame to the end of the file."""
        head = file_head(device, self._layout)[0]
        self._in_order = self._read(0, len(head)) == head
        self._data_end = self._end_by_footer()
        at = len(head)
        if not self._in_order and not self._plausible(at):
            first = self._find(0)
            at = self._data_end if first is None else first
        while at < self._data_end:
            if self._whole(at):
                at = self._behind_frame(at)
            elif self._read(at, len(_DATA_END)) == _DATA_END:
                self._data_end = at
            else:
                following = self._following(at)
                self._in_order = self._in_order and following == self._data_end == self._size
                at = self._damaged(at, following)
        data_ended = self._read(self._data_end, len(records.DATA_END)) == records.DATA_END
        closed_well = (
            self._in_order and not self._damages and data_ended and self._reader_agrees(device)
        )
        if self._data_end < self._size and not (self._summary_sound and data_ended):
            end = self._data_end
            self._damages.append(Damage(end, self._size - end, (), 0, torn=False))
        return Salvage(
            self._path, device, self._layout, tuple(self._headers), tuple(self._offsets),
            tuple(self._told()), closed_well, self._in_order,
        )  # fmt: skip

    def _end_by_footer(self) -> int:
        """Where the frames end by the summary; the end of the file where none is sound."""
        found = find_summary(self._read, self._size, self._chunk_bytes)
        if found is None or not found.content:
            return self._size
        self._summary_sound = found.ended
        return found.start - len(records.DATA_END)

    def _whole(self, at: int) -> bool:
        """Whether the frame at `at` is whole; then `_chunk` holds it."""
        return self._fill(at) == self._chunk_bytes and not check_frame(self._chunk, self._joiner)

    def _behind_frame(self, at: int) -> int:
        """Take the frame in `_chunk`; where to go on behind it."""
        header = header_in(self._chunk)
        self._in_order = self._in_order and has_sound_front(self._chunk)
        self._headers.append(header)
        self._offsets.append(at)
        at += self._chunk_bytes
        there = self._read(at, _INDEX_BYTES)
        if there == records.message_index(log_time_ns(header)):
            return at + _INDEX_BYTES
        if len(there) < _INDEX_BYTES:  # torn
            return self._damaged(at, self._size, frames=0) if there else at
        if self._plausible(at + _INDEX_BYTES):
            self._in_order = False
            return self._damaged(at, at + _INDEX_BYTES, frames=0)
        following = self._find(at)
        self._in_order = self._in_order and following is None
        return self._damaged(at, self._data_end if following is None else following)

    def _following(self, at: int) -> int:
        """Where to go on behind a frame that is not whole."""
        if self._plausible(at + self._stride):
            return at + self._stride
        following = self._find(at + 1)
        return self._data_end if following is None else following

    def _plausible(self, at: int) -> bool:
        """Whether a frame, whole or not, begins at `at`, or the data end there."""
        front = self._read(at, _FRONT_BYTES)
        begun = front.startswith((self._pattern, _DATA_END)) or _marked(front)
        return begun or at == self._data_end or self._whole(at)

    def _find(self, at: int) -> int | None:
        """The next place where a chunk of our length begins and a frame's mark stands in it."""
        while at < self._data_end:
            window = self._read(at, _WINDOW + len(self._pattern) - 1)
            found = window.find(self._pattern)
            while found >= 0:
                front = self._read(at + found, _FRONT_BYTES)
                if _marked(front):
                    return at + found
                found = window.find(self._pattern, found + 1)
            at += _WINDOW
        return None

    def _damaged(self, at: int, following: int, frames: int | None = None) -> int:
        last = following >= self._data_end
        if frames is None:
            frames = self._frames_between(at, following, last)
        trigger = self._trigger(at) if frames else None
        triggers = () if trigger is None else (trigger,)
        torn = last and frames == 1 and following - at < self._chunk_bytes
        self._damages.append(Damage(at, following - at, triggers, frames, torn))
        return following

    def _frames_between(self, at: int, following: int, last: bool) -> int:
        size = following - at
        if not last:
            return max(1, round(size / self._stride))
        begun = self._read(at, len(self._pattern))
        torn = self._pattern.startswith(begun) or self._plausible(at)
        if not torn and _SCHEMA in self._read(at, _WINDOW):
            return 0  # a summary whose front is damaged
        return size // self._stride + (torn and size % self._stride > 0)

    def _trigger(self, at: int) -> int | None:
        """The trigger index in the header of a frame that is not whole, if it can be believed."""
        there = self._fill(at)
        if there < _FRONT_BYTES:
            return None
        try:
            header = header_in(self._chunk)
        except TakeError:
            return None
        if there == self._chunk_bytes and crc32(self._chunk[_FRONT_BYTES:]) == header.pixel_crc:
            return None  # the pixels are whole, so it is the header that is damaged
        return header.trigger_index if header.device_index == self._place else None

    def _told(self) -> Iterator[Damage]:
        """The damages, with the triggers that the frames around them leave possible."""
        for damage in self._damages:
            before = [h.trigger_index for h, at in self._frames() if at < damage.offset]
            after = [h.trigger_index for h, at in self._frames() if at > damage.offset]
            yield replace(damage, triggers=_possible(damage, before, after))

    def _frames(self) -> Iterator[tuple[FrameHeader, int]]:
        return zip(self._headers, self._offsets, strict=True)

    def _reader_agrees(self, device: str) -> bool:
        try:
            reader = FrameReader(self._path)
        except TakeError:
            return False
        return reader.closed_well and (reader.device, list(reader.offsets)) == (
            device, self._offsets,
        )  # fmt: skip

    def _fill(self, at: int) -> int:
        count = 0
        try:
            while count < self._chunk_bytes:
                more = os.preadv(self._handle, [self._chunk[count:]], at + count)
                if not more:
                    break
                count += more
        except OSError:  # a bad place of the disk is damage like any other
            return 0
        return count

    def _read(self, at: int, size: int) -> bytes:
        try:
            return os.pread(self._handle, size, at)
        except OSError:
            return bytes(max(0, min(size, self._size - at)))


def _marked(front: bytes) -> bool:
    """Whether a frame's header stands where it does in a chunk."""
    return front[_HEADER_AT : _HEADER_AT + 4] == b"LKF1"


def _possible(damage: Damage, before: Sequence[int], after: Sequence[int]) -> tuple[int, ...]:
    """Frames come in the order of their triggers: what lies between must be what is missing."""
    low = before[-1] if before else -1
    between = range(low + 1, after[0]) if after else None
    if between is not None and len(between) == damage.frames:
        return tuple(between)
    ahead = range(low + 1, low + _FARTHEST) if between is None else between
    return tuple(k for k in damage.triggers if k in ahead)
