"""Frames on disk: one MCAP file a device, one uncompressed chunk a frame.

Written by ourselves, because a writer that copies a frame several times cannot keep up with a
camera. A message is a 64-byte header and the raw pixels; the schema text in the file says so. Any
MCAP reader opens the file; ours also reads a file that was cut, to its last whole frame.

References:
    MCAP file format specification, https://mcap.dev/spec
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

import numpy as np

from capture.arrays import Image
from capture.crc import Crc32Joiner
from capture.errors import TakeError, WorkError

MAGIC = b"\x89MCAP0\r\n"
HEADER_BYTES = 64

_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _MESSAGE_INDEX = 1, 2, 3, 4, 5, 6, 7
_CHUNK_INDEX, _STATISTICS, _SUMMARY_OFFSET, _DATA_END = 8, 11, 14, 15

_RECORD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII")  # start, end, size, crc, length of the compression's name (0)
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_FRAME = struct.Struct("<4sHHqQqqdII8x")
_FRAME_MARK = b"LKF1"
_PREFIX = (
    _RECORD.size + _MESSAGE_HEAD.size + HEADER_BYTES
)  # of the records in a chunk, before pixels

_SCHEMA_TEXT = """\
A message is a header of 64 bytes and then the pixels. All numbers are little endian.
offset type     name
 0     char[4]  mark           "LKF1"
 4     uint16   header_bytes   64
 6     uint16   device_index   place of the device in the take's list
 8     int64    trigger_index  which trigger of the take exposed this frame
16     uint64   frame_id       the number that the device gave the frame
24     int64    t_dev_ns       start of exposure by the device's own clock; -1 unknown
32     int64    t_host_ns      arrival by the host's clock; -1 unknown
40     float64  exposure_us    -1 unknown
48     uint32   status         0 complete, 1 incomplete
52     uint32   pixel_crc      CRC-32 (zlib) of the pixels
56     uint8[8] zero
64     pixels   rows from the top, columns from the left, channels innermost (RGB when there are 3);
                width, height, channels and dtype stand in the channel's metadata
"""


@dataclass(frozen=True)
class ImageLayout:
    """The size and pixel type that all frames of one device share.

    Attributes:
        width: columns, px.
        height: rows, px.
        channels: 1 for mono, 3 for RGB.
        dtype: "uint8" or "uint16".
    """

    width: int
    height: int
    channels: int
    dtype: str

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise TakeError(
                f"image size must be at least 1 x 1 px, found {self.width} x {self.height}"
            )
        if self.channels not in (1, 3):
            raise TakeError(f"channels must be 1 (mono) or 3 (RGB), found {self.channels}")
        if self.dtype not in ("uint8", "uint16"):
            raise TakeError(f"pixel type must be uint8 or uint16, found {self.dtype!r}")

    @classmethod
    def of(cls, image: Image) -> ImageLayout:
        """The layout of an (H, W) or (H, W, 3) uint8 or uint16 image."""
        if image.ndim not in (2, 3):
            raise TakeError(f"an image must be (H, W) or (H, W, 3), found shape {image.shape}")
        channels = 1 if image.ndim == 2 else int(image.shape[2])
        return cls(int(image.shape[1]), int(image.shape[0]), channels, image.dtype.name)

    @property
    def shape(self) -> tuple[int, ...]:
        """(H, W) or (H, W, 3)."""
        flat = (self.height, self.width)
        return flat if self.channels == 1 else (*flat, self.channels)

    @property
    def nbytes(self) -> int:
        """Bytes of one frame's pixels."""
        return self.width * self.height * self.channels * np.dtype(self.dtype).itemsize

    def __str__(self) -> str:
        kind = "mono" if self.channels == 1 else "RGB"
        return f"{self.width} x {self.height} {kind} {self.dtype}"


@dataclass(frozen=True)
class FrameHeader:
    """What is known of one frame; the schema text of the file describes each field.

    Attributes:
        trigger_index: which trigger of the take exposed this frame.
        device_index: place of the device in the take's list.
        frame_id: the number the device gave the frame.
        t_dev_ns: start of exposure by the device's own clock; -1 unknown.
        t_host_ns: arrival by the host's clock; -1 unknown.
        exposure_us: exposure time; -1 unknown.
        status: 0 complete, 1 incomplete.
        pixel_crc: CRC-32 of the pixels; the writer fills it in.
    """

    trigger_index: int
    device_index: int = 0
    frame_id: int = 0
    t_dev_ns: int = -1
    t_host_ns: int = -1
    exposure_us: float = -1.0
    status: int = 0
    pixel_crc: int = 0

    def pack(self) -> bytes:
        """The 64 bytes."""
        return _FRAME.pack(
            _FRAME_MARK, HEADER_BYTES, self.device_index, self.trigger_index, self.frame_id,
            self.t_dev_ns, self.t_host_ns, self.exposure_us, self.status, self.pixel_crc,
        )  # fmt: skip

    @classmethod
    def unpack(cls, data: bytes) -> FrameHeader:
        """From 64 bytes.

        Raises:
            TakeError: when they are not such a header.
        """
        if len(data) != HEADER_BYTES:
            raise TakeError(f"a frame header is {HEADER_BYTES} bytes, found {len(data)}")
        mark, size, device, trigger, frame_id, t_dev, t_host, exposure, status, crc = _FRAME.unpack(
            data
        )
        if mark != _FRAME_MARK or size != HEADER_BYTES:
            raise TakeError(f"expected a frame header marked {_FRAME_MARK!r}, found {mark!r}")
        return cls(trigger, device, frame_id, t_dev, t_host, exposure, status, crc)


class FrameWriter:
    """Writes the frames of one device to an MCAP file: to `NAME.partial`, renamed at close.

    Used in a `with` block: a clean end closes the file, an exception removes what was written.
    """

    def __init__(self, path: Path, device: str, layout: ImageLayout) -> None:
        """Open the file and write its head.

        Args:
            path: the file to make.
            device: the device's name, which becomes the channel's topic.
            layout: size and pixel type of every frame.
        """
        self.path = Path(path)
        self.layout = layout
        self._partial = self.path.with_name(self.path.name + ".partial")
        self._file: BinaryIO = self._partial.open("wb", buffering=0)
        self._offset = 0
        self._joiner = Crc32Joiner(layout.nbytes)
        self._index: list[tuple[int, int, int]] = []  # log time, offset and length of each chunk
        metadata = {
            "device": device,
            "width": str(layout.width),
            "height": str(layout.height),
            "channels": str(layout.channels),
            "dtype": layout.dtype,
            "order": "RGB" if layout.channels == 3 else "mono",
            "byteorder": "little",
        }
        self._description = _schema() + _channel(device, metadata)
        with self._discarded_on_failure():
            self._write(MAGIC + _record(_HEADER, _text("") + _text("likeness")) + self._description)

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
            self._discard()

    def write(self, header: FrameHeader, pixels: Image) -> None:
        """Append one frame.

        Args:
            header: what is known of it; its CRC is computed here.
            pixels: (H, W) or (H, W, 3) of the file's layout.

        Raises:
            TakeError: when the pixels are of another layout.
            WorkError: when the disk is full or fails.
        """
        if ImageLayout.of(pixels) != self.layout:
            raise TakeError(f"{self.path}: expected {self.layout}, found {ImageLayout.of(pixels)}")
        little = np.ascontiguousarray(pixels, dtype=np.dtype(self.layout.dtype).newbyteorder("<"))
        raw = little.data.cast("B")
        header = replace(header, pixel_crc=zlib.crc32(raw))
        time = header.t_host_ns if header.t_host_ns >= 0 else max(header.trigger_index, 0)
        message_bytes = _MESSAGE_HEAD.size + HEADER_BYTES + len(raw)
        prefix = (
            _RECORD.pack(_MESSAGE, message_bytes)
            + _MESSAGE_HEAD.pack(1, len(self._index) & 0xFFFFFFFF, time, time)
            + header.pack()
        )
        records = len(prefix) + len(raw)
        crc = self._joiner.join(zlib.crc32(prefix), header.pixel_crc)
        head = _CHUNK_HEAD.pack(time, time, records, crc, 0) + struct.pack("<Q", records)
        chunk = _RECORD.pack(_CHUNK, len(head) + records) + head
        start = self._offset
        index = _record(_MESSAGE_INDEX, struct.pack("<HIQQ", 1, 16, time, 0))
        self._write(chunk + prefix, raw, index)
        self._index.append((time, start, len(chunk) + records))

    def close(self) -> None:
        """Write the summary, bring it all to the disk, and give the file its name."""
        if self._file.closed:
            return
        with self._discarded_on_failure():
            self._write(_record(_DATA_END, struct.pack("<I", 0)))
            self._write(self._summary(self._offset))
            os.fsync(self._file.fileno())
            self._file.close()
            self._partial.replace(self.path)

    @contextmanager
    def _discarded_on_failure(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            self._discard()
            raise

    def _discard(self) -> None:
        self._file.close()
        self._partial.unlink(missing_ok=True)

    def _summary(self, start: int) -> bytes:
        times = [time for time, _, _ in self._index]
        count = len(times)
        statistics = struct.pack(
            "<QHIIIIQQ", count, 1, 1, 0, 0, count, min(times, default=0), max(times, default=0)
        )
        statistics += struct.pack("<IHQ", 10, 1, count)
        schema, channel = _schema(), self._description[len(_schema()) :]
        size = self.layout.nbytes + _PREFIX
        chunks = b"".join(
            _record(
                _CHUNK_INDEX,
                struct.pack("<QQQQ", time, time, offset, length)
                + struct.pack("<IHQ", 10, 1, offset + length)
                + struct.pack("<QIQQ", _RECORD.size + 22, 0, size, size),
            )
            for time, offset, length in self._index
        )
        groups = [
            (_SCHEMA, schema),
            (_CHANNEL, channel),
            (_STATISTICS, _record(_STATISTICS, statistics)),
            (_CHUNK_INDEX, chunks),
        ]
        body, offsets, at = b"", b"", start
        for opcode, group in groups:
            if group:
                offsets += _record(_SUMMARY_OFFSET, struct.pack("<BQQ", opcode, at, len(group)))
            body, at = body + group, at + len(group)
        footer = _RECORD.pack(_FOOTER, 20) + struct.pack("<QQ", start, start + len(body))
        crc = zlib.crc32(body + offsets + footer)
        return body + offsets + footer + struct.pack("<I", crc) + MAGIC

    def _write(self, *parts: bytes | memoryview) -> None:
        pending = [memoryview(part).cast("B") for part in parts]
        while pending:
            try:
                written = os.writev(self._file.fileno(), pending)
            except OSError as error:
                raise WorkError(f"{self.path}: cannot be written: {error.strerror}") from error
            self._offset += written
            while pending and written >= len(pending[0]):
                written -= len(pending.pop(0))
            if pending and written:
                pending[0] = pending[0][written:]


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

    def read(self, index: int) -> Image:
        """The pixels of one frame, (H, W) or (H, W, 3).

        Args:
            index: place in `headers`.

        Raises:
            TakeError: naming the file and the frame, when its bytes are not those written.
        """
        skip = _RECORD.size + _CHUNK_HEAD.size + 8
        pixels = np.empty(self.layout.shape, np.dtype(self.layout.dtype).newbyteorder("<"))
        raw = pixels.data.cast("B")
        with self.path.open("rb", buffering=0) as file:
            file.seek(self._offsets[index])
            head = file.read(skip + _PREFIX)
            count = len(head) + (file.readinto(raw) or 0)
        label = f"{self.path}: frame {index} (trigger {self.headers[index].trigger_index})"
        if count != skip + _PREFIX + len(raw):
            raise TakeError(f"{label}: expected {skip + _PREFIX + len(raw)} bytes, found {count}")
        expected = _CHUNK_HEAD.unpack_from(head, _RECORD.size)[3]
        found = zlib.crc32(raw, zlib.crc32(head[skip:]))
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
            body = offset + _RECORD.size
            if opcode == _CHANNEL:
                metadata = _read_channel(_read_at(file, body, length), self.path)
                try:
                    layout = ImageLayout(
                        int(metadata["width"]), int(metadata["height"]),
                        int(metadata["channels"]), metadata["dtype"],
                    )  # fmt: skip
                    return metadata["device"], layout, body + length
                except (KeyError, ValueError) as error:
                    raise TakeError(f"{self.path}: not written by likeness: no {error}") from error
            offset = body + length
        raise TakeError(f"{self.path}: cut before its first frame: no channel record")

    def _read_summary(self, file: BinaryIO) -> list[int] | None:
        tail = _RECORD.size + 20 + len(MAGIC)
        if self._size < tail + len(MAGIC):
            return None
        footer = _read_at(file, self._size - tail, tail)
        if footer[-len(MAGIC) :] != MAGIC or _RECORD.unpack_from(footer) != (_FOOTER, 20):
            return None
        start, _, crc = struct.unpack_from("<QQI", footer, _RECORD.size)
        if not 0 < start <= self._size - tail:
            return None
        summary = _read_at(file, start, self._size - tail - start)
        if zlib.crc32(summary + footer[: _RECORD.size + 16]) != crc:
            return None
        expected = _RECORD.size + self._chunk_bytes()
        offsets, at = [], 0
        while at + _RECORD.size <= len(summary):
            opcode, length = _RECORD.unpack_from(summary, at)
            if opcode == _CHUNK_INDEX:
                offset, size = struct.unpack_from("<QQ", summary, at + _RECORD.size + 16)
                if size != expected or offset + size > start:
                    return None
                offsets.append(int(offset))
            at += _RECORD.size + length
        return offsets

    def _chunk_bytes(self) -> int:
        return _CHUNK_HEAD.size + 8 + _PREFIX + self.layout.nbytes

    def _scan(self, file: BinaryIO, offset: int) -> Iterator[int]:
        expected = self._chunk_bytes()
        while (found := self._record_at(file, offset)) is not None:
            opcode, length = found
            if opcode == _CHUNK:
                if length != expected:
                    return
                yield offset
            elif opcode != _MESSAGE_INDEX:
                return
            offset += _RECORD.size + length

    def _record_at(self, file: BinaryIO, offset: int) -> tuple[int, int] | None:
        head = _read_at(file, offset, _RECORD.size)
        if len(head) < _RECORD.size:
            return None
        opcode, length = _RECORD.unpack(head)
        if offset + _RECORD.size + length > self._size:
            return None
        return int(opcode), int(length)

    def _read_header(self, file: BinaryIO, offset: int) -> FrameHeader:
        skip = _RECORD.size + _CHUNK_HEAD.size + 8 + _RECORD.size + _MESSAGE_HEAD.size
        try:
            return FrameHeader.unpack(_read_at(file, offset + skip, HEADER_BYTES))
        except TakeError as error:
            raise TakeError(f"{self.path}: at byte {offset}: {error}") from error


def _record(opcode: int, content: bytes) -> bytes:
    return _RECORD.pack(opcode, len(content)) + content


def _text(text: str) -> bytes:
    data = text.encode()
    return struct.pack("<I", len(data)) + data


def _schema() -> bytes:
    text = _text("likeness.Frame") + _text("x-likeness-struct") + _text(_SCHEMA_TEXT)
    return _record(_SCHEMA, struct.pack("<H", 1) + text)


def _channel(device: str, metadata: Mapping[str, str]) -> bytes:
    pairs = b"".join(_text(key) + _text(value) for key, value in metadata.items())
    head = struct.pack("<HH", 1, 1) + _text(device) + _text("x-likeness-frame")
    return _record(_CHANNEL, head + struct.pack("<I", len(pairs)) + pairs)


def _read_channel(content: bytes, path: Path) -> dict[str, str]:
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


def _read_text(content: bytes, at: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", content, at)
    if at + 4 + length > len(content):
        raise ValueError("a string reaches beyond its record")
    return content[at + 4 : at + 4 + length].decode(), at + 4 + length


def _read_at(file: BinaryIO, offset: int, size: int) -> bytes:
    file.seek(offset)
    return file.read(size)
