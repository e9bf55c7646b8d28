"""Whole frames are found in a file however it is cut or hit, by a plain rule that says which."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import SeekingReader

from capture.frame_header import FrameHeader, ImageLayout
from capture.mcap import FrameReader, FrameWriter, frame_bytes
from capture.recover.mend import mend
from capture.recover.salvage import Salvage, salvage

LAYOUT = ImageLayout(5, 4, 1, "uint8")
SIZE, INDEX = frame_bytes(LAYOUT), 31


def image(k: int) -> np.ndarray:
    return np.random.default_rng(k).integers(0, 256, LAYOUT.shape, dtype=np.uint8)


@pytest.fixture
def whole(tmp_path: Path) -> bytes:
    """A file of three frames, closed."""
    with FrameWriter(tmp_path / "whole.mcap", "cam00", LAYOUT) as writer:
        for k in range(3):
            writer.write(FrameHeader(k, 0, 10 + k), image(k))
    return (tmp_path / "whole.mcap").read_bytes()


def starts_in(data: bytes) -> list[int]:
    starts, at = [], 8
    while data[at] != 15:
        if data[at] == 6:
            starts.append(at)
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
    return starts


def record_ends(data: bytes) -> list[int]:
    ends, at = [8], 8
    while at < len(data) - 8:
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
        ends.append(at)
    return [*ends, len(data)]


def found_in(path: Path, data: bytes) -> Salvage:
    path.write_bytes(data)
    return salvage(path, "cam00", LAYOUT, 0)


def triggers(found: Salvage) -> list[int]:
    return [header.trigger_index for header in found.headers]


def check_mended(found: Salvage, final: Path) -> None:
    mend(found, final)
    reader = FrameReader(final)
    assert reader.closed_well
    assert [header.trigger_index for header in reader.headers] == triggers(found)
    for place, k in enumerate(triggers(found)):
        assert np.array_equal(reader.read(place), image(k))
    with final.open("rb") as file:
        official = SeekingReader(file, validate_crcs=True)
        assert len(list(official.iter_messages())) == len(found.headers)


def test_a_file_cut_at_every_record_boundary_and_beside_it(tmp_path: Path, whole: bytes) -> None:
    starts = starts_in(whole)
    for end in sorted({e + d for e in record_ends(whole) for d in (-1, 0, 1)}):
        if end > len(whole):
            continue
        place = tmp_path / f"cut{end}" / "frames"
        place.mkdir(parents=True)
        found = found_in(place / "cam00.mcap.partial", whole[:end])
        kept = [k for k, start in enumerate(starts) if start + SIZE <= end]
        assert triggers(found) == kept
        torn = [k for damage in found.damages if damage.torn for k in damage.triggers]
        begun = [k for k, start in enumerate(starts) if start + 144 <= end < start + SIZE]
        assert torn == begun
        assert found.closed_well == (end == len(whole))
        if end >= starts[0]:
            lasts = [starts[0], *(s + SIZE for s in starts), *(s + SIZE + INDEX for s in starts)]
            dropped = sum(damage.size for damage in found.damages)
            assert dropped == (0 if found.closed_well else end - max(e for e in lasts if e <= end))
        check_mended(found, place / "cam00.mcap")


@pytest.mark.parametrize("closed", [True, False])
def test_a_byte_that_is_hit_costs_the_frame_it_lies_in_and_no_other(
    tmp_path: Path, whole: bytes, closed: bool
) -> None:
    starts = starts_in(whole)
    data = whole if closed else whole[: starts[-1] + SIZE + INDEX]
    rng = np.random.default_rng(3)
    for place in range(1 if closed else 3, len(data), 11):
        spoilt = bytearray(data)
        spoilt[place] ^= 1 << int(rng.integers(8))
        found = found_in(tmp_path / "a.mcap", bytes(spoilt))
        hit = [
            k
            for k, s in enumerate(starts)
            if s + 33 <= place < s + 37 or s + 49 <= place < s + SIZE
        ]
        assert triggers(found) == [k for k in range(3) if k not in hit], place
        assert sum(damage.frames for damage in found.damages) == len(hit), place
        named = [k for damage in found.damages for k in damage.triggers]
        assert named in ([], hit), place
        assert not found.closed_well, place


@pytest.mark.parametrize("seed", range(20))
def test_files_hit_in_many_places_are_mended(tmp_path: Path, whole: bytes, seed: int) -> None:
    rng = np.random.default_rng(seed)
    spoilt = bytearray(whole[: int(rng.integers(len(whole) // 2, len(whole) + 1))])
    for place in rng.integers(0, len(spoilt), 3):
        spoilt[place] ^= 1 << int(rng.integers(8))
    (tmp_path / "frames").mkdir()
    found = found_in(tmp_path / "frames" / "cam00.mcap", bytes(spoilt))
    check_mended(found, tmp_path / "frames" / "cam00.mcap")


def test_a_bad_place_of_the_disk_costs_one_frame(
    tmp_path: Path, whole: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    bad = starts_in(whole)[1] + 100
    read, read_into = os.pread, os.preadv

    def hit(at: int, size: int) -> None:
        if at <= bad < at + size:
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    def pread(handle: int, size: int, at: int) -> bytes:
        hit(at, size)
        return read(handle, size, at)

    def preadv(handle: int, buffers: list[memoryview], at: int) -> int:
        hit(at, sum(map(len, buffers)))
        return read_into(handle, buffers, at)

    (tmp_path / "a.mcap").write_bytes(whole)
    monkeypatch.setattr(os, "pread", pread)
    monkeypatch.setattr(os, "preadv", preadv)
    found = salvage(tmp_path / "a.mcap", "cam00", LAYOUT, 0)
    assert triggers(found) == [0, 2]
    assert [damage.triggers for damage in found.damages] == [(1,)]
