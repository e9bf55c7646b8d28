"""Making a sound file of what was found in a damaged one.

A file whose frames are all in order, which is what a killed program leaves, is completed where it
stands: only the torn end is cut. Any other is copied, frame by frame, and the old file is put aside
in `damaged/` once the copy has been read back. Stopped at any moment, the next run goes on.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from capture import mcap_records as records
from capture.arrays import Image
from capture.crc import Crc32Joiner
from capture.errors import TakeError, WorkError
from capture.frame_header import FrameHeader, ImageLayout
from capture.mcap import (
    FrameReader,
    FrameWriter,
    check_frame,
    file_end,
    file_head,
    frame_bytes,
    log_time_ns,
)
from capture.recover.report import FileMend
from capture.recover.salvage import Salvage

DAMAGED = "damaged"
_REBUILT = ".rebuilt"


def source_of(final: Path) -> Path | None:
    """The file in which a device's frames stand now, under any of the names it can have."""
    names = (final.name, f"{final.name}.partial", final.name + _REBUILT)
    places = [final.with_name(name) for name in names]
    return next((place for place in places if place.is_file()), None)


def mend(found: Salvage, final: Path) -> FileMend:
    """Make `final` a sound file of the whole frames that were found.

    Args:
        found: in the file as it stands.
        final: `TAKE/frames/<device>.mcap`.

    Raises:
        WorkError: when the disk is full or fails; nothing that was there is lost.
    """
    try:
        if found.closed_well:
            found.path.replace(final)
            return FileMend.WHOLE
        torn = sum(damage.size for damage in found.damages)
        if found.in_order and torn < frame_bytes(found.layout):
            _complete(found)
            found.path.replace(final)
            return FileMend.COMPLETED
        _rebuild(found, final)
    except OSError as error:
        raise WorkError(f"{final}: cannot be mended: {error.strerror}") from error
    return FileMend.REBUILT


def make_empty(final: Path, layout: ImageLayout) -> FileMend:
    """Make a file without frames, for a device whose file is gone."""
    FrameWriter(final, final.stem, layout).close()
    return FileMend.MADE


def _complete(found: Salvage) -> None:
    _, schema, channel = file_head(found.device, found.layout)
    index = [
        (log_time_ns(header), offset, frame_bytes(found.layout))
        for header, offset in zip(found.headers, found.offsets, strict=True)
    ]
    tail = records.message_index(index[-1][0]) if index else b""
    pending = memoryview(tail + file_end(found.end + len(tail), schema, channel, index))
    with found.path.open("r+b", buffering=0) as file:
        file.truncate(found.end)
        file.seek(found.end)
        try:
            while pending:
                pending = pending[file.write(pending) or 0 :]
            os.fsync(file.fileno())
        except OSError:
            file.truncate(found.end)
            raise


def _rebuild(found: Salvage, final: Path) -> None:
    fresh = final.with_name(final.name + _REBUILT)
    writer = FrameWriter(fresh, found.device, found.layout)
    try:
        for header, pixels in _frames(found):
            writer.write(header, pixels, header.pixel_crc)
        writer.close()
    except BaseException:
        writer.discard()
        raise
    _read_back(fresh, found)
    aside = final.parent.parent / DAMAGED
    aside.mkdir(exist_ok=True)
    found.path.replace(_free_name(aside / final.name))
    fresh.replace(final)


def _frames(found: Salvage) -> Iterator[tuple[FrameHeader, Image]]:
    size = frame_bytes(found.layout)
    dtype = np.dtype(found.layout.dtype).newbyteorder("<")
    for header, chunk in zip(found.headers, _chunks(found.path, found.offsets, size), strict=True):
        pixels = np.frombuffer(chunk[size - found.layout.nbytes :], dtype)
        yield header, pixels.reshape(found.layout.shape)


def _read_back(fresh: Path, found: Salvage) -> None:
    reader = FrameReader(fresh)
    joiner, size = Crc32Joiner(found.layout.nbytes), frame_bytes(found.layout)
    said = [check_frame(chunk, joiner) for chunk in _chunks(fresh, reader.offsets, size)]
    if not reader.closed_well or reader.headers != found.headers or any(said):
        fresh.unlink()
        raise WorkError(f"{fresh}: reads back otherwise than it was written; look at the disk")


def _chunks(path: Path, offsets: tuple[int, ...], size: int) -> Iterator[memoryview]:
    """The chunks of a file, one after the other in the same memory."""
    buffer = memoryview(bytearray(size))
    with path.open("rb", buffering=0) as file:
        for offset in offsets:
            count = 0
            while count < size and (
                more := os.preadv(file.fileno(), [buffer[count:]], offset + count)
            ):
                count += more
            if count < size:
                raise TakeError(f"{path}: shorter than a moment ago")
            yield buffer


def _free_name(path: Path) -> Path:
    number, free = 1, path
    while free.exists():
        number, free = number + 1, path.with_name(f"{path.stem}-{number + 1}{path.suffix}")
    return free
