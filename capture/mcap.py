"""Frames on disk: one MCAP file a device, one uncompressed chunk a frame.

Written by ourselves, because a writer that copies a frame several times cannot keep up with a
camera. A message is a 64-byte header and the raw pixels; the schema text in the file says so. Any
MCAP reader opens the file; ours also reads a file that was cut, to its last whole frame.

References:
    MCAP file format specification, https://mcap.dev/spec
"""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

import numpy as np

from capture import mcap_records as records
from capture.arrays import Image
from capture.crc import Crc32Joiner, crc32
from capture.disk_faults import Disk
from capture.durable import AppendFile
from capture.errors import TakeError, WorkError
from capture.frame_header import HEADER_BYTES, FrameHeader, ImageLayout, raw_pixels
from capture.mcap_records import CHUNK_HEAD, MAGIC, MESSAGE_PREFIX_BYTES, RECORD, Op
from capture.mcap_summary import find_summary, parse_chunks

_CHUNK_FRONT_BYTES = RECORD.size + CHUNK_HEAD.size
_FRONT_BYTES = _CHUNK_FRONT_BYTES + MESSAGE_PREFIX_BYTES  # of a chunk, before its pixels


def partial_file(path: Path) -> Path:
    """What the file of frames is called until it is closed."""
    return path.with_name(path.name + ".partial")


def file_head(device: str, layout: ImageLayout) -> tuple[bytes, bytes, bytes]:
    """What stands before the first frame of a device's file, and in it the schema and channel."""
    metadata = {
        "device": device,
        "width": str(layout.width),
        "height": str(layout.height),
        "channels": str(layout.channels),
        "dtype": layout.dtype,
        "order": "RGB" if layout.channels == 3 else "mono",
        "byteorder": "little",
    }
    schema, channel = records.schema_record(), records.channel_record(device, metadata)
    return MAGIC + records.header_record() + schema + channel, schema, channel


def file_end(
    offset: int, schema: bytes, channel: bytes, chunks: Sequence[tuple[int, int, int]]
) -> bytes:
    """What stands behind the last frame, at `offset`: the end of the data, and the summary.

    Args:
        offset: where it begins.
        schema: the schema's record.
        channel: the channel's record.
        chunks: time, offset and length of each chunk.
    """
    start = offset + len(records.DATA_END)
    return records.DATA_END + records.summary(start, schema, channel, chunks)


def log_time_ns(header: FrameHeader) -> int:
    """The log time of a frame: its arrival, or its trigger index where that is not known."""
    return header.t_host_ns if header.t_host_ns >= 0 else max(header.trigger_index, 0)


def frame_bytes(layout: ImageLayout) -> int:
    """How long the chunk of one frame is."""
    return _FRONT_BYTES + layout.nbytes


def check_frame(chunk: memoryview, joiner: Crc32Joiner) -> str:
    """What is wrong with a frame in a chunk; empty when it is as it was written.

    The front of the chunk, which its CRC does not cover, is not looked at: `has_sound_front` does.

    Args:
        chunk: as read from the file, `frame_bytes` long unless the file was cut.
        joiner: of the pixels' size.
    """
    if len(chunk) < _FRONT_BYTES:
        return f"cut after {len(chunk)} bytes"
    expected = CHUNK_HEAD.unpack_from(chunk, RECORD.size)[3]
    pixels = crc32(chunk[_FRONT_BYTES:])
    found = joiner.join(crc32(chunk[_CHUNK_FRONT_BYTES:_FRONT_BYTES]), pixels)
    if found != expected:
        return f"damaged: expected CRC {expected:08x}, found {found:08x}"
    try:
        header = header_in(chunk)
    except TakeError as error:
        return str(error)
    if header.pixel_crc != pixels:
        return "its pixels do not match the CRC in its header"
    return ""


def header_in(chunk: memoryview) -> FrameHeader:
    """The header of the frame in a chunk.

    Raises:
        TakeError: when there is none.
    """
    return FrameHeader.unpack(bytes(chunk[_FRONT_BYTES - HEADER_BYTES : _FRONT_BYTES]))


def has_sound_front(chunk: memoryview) -> bool:
    """Whether the front of a chunk, which no CRC covers, is as its frame says it was written."""
    size, crc = len(chunk) - _CHUNK_FRONT_BYTES, CHUNK_HEAD.unpack_from(chunk, RECORD.size)[3]
    expected = records.chunk_head(log_time_ns(header_in(chunk)), size, crc)
    return bytes(chunk[:_CHUNK_FRONT_BYTES]) == expected


class FrameWriter:
    """Writes the frames of one device to an MCAP file: to `NAME.partial`, renamed at close.

    Used in a `with` block: a clean end closes the file; an exception abandons it, which keeps what
    was written for `likeness recover`. One thread writes; `sync` may be called from another one.
    """

    def __init__(
        self,
        path: Path,
        device: str,
        layout: ImageLayout,
        *,
        reserve_frames: int = 0,
        disk: Disk | None = None,
    ) -> None:
        """Open the file and write its head.

        Args:
            path: the file to make.
            device: the device's name, which becomes the channel's topic.
            layout: size and pixel type of every frame.
            reserve_frames: how many to take room on the disk for at once, if it has it.
            disk: that it is written to; this machine's when not given.

        Raises:
            WorkError: when the disk is full or fails.
        """
        self.path = Path(path)
        self.layout = layout
        self._joiner = Crc32Joiner(layout.nbytes)
        self._index: list[tuple[int, int, int]] = []  # log time, offset and length of each chunk
        head, self._schema, self._channel = file_head(device, layout)
        self._file = AppendFile(partial_file(self.path), str(self.path), disk)
        try:
            if reserve_frames:
                stride = frame_bytes(layout) + len(records.message_index(0))
                self._file.reserve(len(head) + reserve_frames * stride)
            self._file.append(head)
        except BaseException:
            self.discard()
            raise

    def __enter__(self) -> FrameWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.abandon()

    def __len__(self) -> int:
        return len(self._index)

    def write(self, header: FrameHeader, pixels: Image, pixel_crc: int | None = None) -> None:
        """Append one frame.

        Args:
            header: what is known of it; its CRC is filled in here.
            pixels: (H, W) or (H, W, 3) of the file's layout.
            pixel_crc: `capture.frame_header.pixel_crc` of the pixels, when another thread has it.

        Raises:
            TakeError: when the pixels are of another layout.
            WorkError: when the disk is full or fails; all frames before this one are whole, and
                the file can be closed.
        """
        if ImageLayout.of(pixels) != self.layout:
            raise TakeError(f"{self.path}: expected {self.layout}, found {ImageLayout.of(pixels)}")
        raw = raw_pixels(pixels)
        header = replace(header, pixel_crc=crc32(raw) if pixel_crc is None else pixel_crc)
        time = log_time_ns(header)
        message = records.message_head(len(self._index), time, HEADER_BYTES + len(raw))
        prefix = message + header.pack()
        crc = self._joiner.join(crc32(prefix), header.pixel_crc)
        head = records.chunk_head(time, len(prefix) + len(raw), crc)
        at = self._file.offset
        self._file.append(head + prefix, raw, records.message_index(time))
        self._index.append((time, at, len(head) + len(prefix) + len(raw)))

    def sync(self) -> None:
        """Bring what was written to the disk; from any thread."""
        self._file.sync()

    def close(self) -> None:
        """Write the summary, bring it all to the disk, and give the file its name.

        Raises:
            WorkError: when the disk is full or fails; the file stays as `NAME.partial`, its frames
                whole.
        """
        if self._file.closed:
            return
        try:
            at = self._file.offset
            self._file.append(file_end(at, self._schema, self._channel, self._index))
        except WorkError:
            self.abandon()
            raise
        self._file.close()
        partial_file(self.path).replace(self.path)

    def abandon(self) -> None:
        """Close the file as it is: it stays as `NAME.partial`, without a summary."""
        with suppress(WorkError):  # whoever abandons knows already that something is wrong
            self._file.close()

    def discard(self) -> None:
        """Remove what was written."""
        self.abandon()
        partial_file(self.path).unlink(missing_ok=True)


class FrameReader:
    """Reads the frames of one device, in any order, checking the CRC of each.

    Attributes:
        path: the file.
        device: the device's name.
        layout: size and pixel type of every frame.
        headers: one for each whole frame, in the order of the file.
        closed_well: False when the file has no summary, as after a crash: then it was scanned to
            its last whole frame.
    """

    def __init__(self, path: Path) -> None:
        """Read the head and the index of a file, or scan it when it was cut.

        Raises:
            TakeError: naming the file, when it is not an MCAP file of frames.
        """
        self.path = Path(path)
        try:
            with self.path.open("rb") as file:
                self._size = file.seek(0, os.SEEK_END)
                self.device, self.layout, first = self._read_head(file)
                offsets = self._read_summary(file)
                self.closed_well = offsets is not None
                self._offsets = list(self._scan(file, first)) if offsets is None else offsets
                self.headers = tuple(self._read_header(file, offset) for offset in self._offsets)
        except FileNotFoundError as error:
            raise TakeError(f"{self.path}: no such file") from error
        except OSError as error:
            raise TakeError(f"{self.path}: not readable: {error.strerror}") from error

    def __len__(self) -> int:
        return len(self._offsets)

    @property
    def offsets(self) -> tuple[int, ...]:
        """Where in the file the chunk of each frame begins, as `headers`."""
        return tuple(self._offsets)

    def read(self, index: int) -> Image:
        """The pixels of one frame, (H, W) or (H, W, 3).

        Args:
            index: place in `headers`.

        Raises:
            TakeError: naming the file and the frame, when its bytes are not those written.
        """
        pixels = np.empty(self.layout.shape, np.dtype(self.layout.dtype).newbyteorder("<"))
        raw = pixels.data.cast("B")
        with self.path.open("rb", buffering=0) as file:
            file.seek(self._offsets[index])
            head = file.read(_FRONT_BYTES)
            count = len(head) + (file.readinto(raw) or 0)
        label = f"{self.path}: frame {index} (trigger {self.headers[index].trigger_index})"
        if count != _FRONT_BYTES + len(raw):
            raise TakeError(f"{label}: expected {_FRONT_BYTES + len(raw)} bytes, found {count}")
        expected = CHUNK_HEAD.unpack_from(head, RECORD.size)[3]
        found = crc32(raw, crc32(head[_CHUNK_FRONT_BYTES:]))
        if found != expected:
            raise TakeError(f"{label}: damaged: expected CRC {expected:08x}, found {found:08x}")
        return pixels.astype(self.layout.dtype, copy=False)

    def _read_head(self, file: BinaryIO) -> tuple[str, ImageLayout, int]:
        file.seek(0)
        if file.read(len(MAGIC)) != MAGIC:
            raise TakeError(f"{self.path}: expected an MCAP file, found other first bytes")
        offset = len(MAGIC)
        while (found := self._record_at(file, offset)) is not None:
            opcode, length = found
            body = offset + RECORD.size
            if opcode == Op.CHANNEL and length <= records.LARGEST_CHANNEL:
                metadata = records.parse_channel(_read_at(file, body, length), self.path)
                try:
                    layout = ImageLayout(
                        int(metadata["width"]), int(metadata["height"]),
                        int(metadata["channels"]), metadata["dtype"],
                    )  # fmt: skip
                    return metadata["device"], layout, body + length
                except KeyError as error:
                    raise TakeError(f"{self.path}: not written by likeness: no {error}") from error
                except (ValueError, TakeError) as error:
                    raise TakeError(f"{self.path}: damaged channel record: {error}") from error
            offset = body + length
        raise TakeError(f"{self.path}: cut before its first frame: no channel record")

    def _read_summary(self, file: BinaryIO) -> list[int] | None:
        expected = frame_bytes(self.layout)
        found = find_summary(functools.partial(_read_at, file), self._size, expected)
        if found is None or not found.ended:
            return None
        chunks = parse_chunks(found.content)
        if any(size != expected or offset + size > found.start for offset, size in chunks):
            return None
        return [offset for offset, _ in chunks]

    def _scan(self, file: BinaryIO, offset: int) -> Iterator[int]:
        expected = frame_bytes(self.layout) - RECORD.size
        while (found := self._record_at(file, offset)) is not None:
            opcode, length = found
            if opcode == Op.CHUNK:
                if length != expected:
                    return
                yield offset
            elif opcode != Op.MESSAGE_INDEX:
                return
            offset += RECORD.size + length

    def _record_at(self, file: BinaryIO, offset: int) -> tuple[int, int] | None:
        head = _read_at(file, offset, RECORD.size)
        if len(head) < RECORD.size:
            return None
        opcode, length = RECORD.unpack(head)
        if offset + RECORD.size + length > self._size:
            return None
        return int(opcode), int(length)

    def _read_header(self, file: BinaryIO, offset: int) -> FrameHeader:
        skip = _FRONT_BYTES - HEADER_BYTES
        try:
            return FrameHeader.unpack(_read_at(file, offset + skip, HEADER_BYTES))
        except TakeError as error:
            raise TakeError(f"{self.path}: at byte {offset}: {error}") from error


def _read_at(file: BinaryIO, offset: int, size: int) -> bytes:
    file.seek(offset)
    return file.read(size)
