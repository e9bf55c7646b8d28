"""The cache of corners: interruption, damage, other boards, other images, other limits."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
from functools import cache
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
import pytest

from capture.arrays import Image
from capture.errors import TakeError
from capture.take import Take
from recon.board.body import BoardBody, ScaleBar
from recon.board.corner_cache import CornerCache
from recon.board.corners import CornerLimits
from recon.board.sightings import BoardSightings, observe_board
from recon.visiting import import_take
from tests.board_prints import render, small_camera, turned
from tools.bench.board_scene import A4_BOARD

MIDDLE = A4_BOARD.corners_mm().mean(axis=0)
LIMITS = CornerLimits()
FRAMES, DEVICES = 4, 2
TOTAL = FRAMES * DEVICES


class CountingTake(Take):
    """A take that remembers which images were read."""

    reads: ClassVar[list[tuple[str, int]]] = []

    def image(self, device: str, frame: int) -> Image:
        self.reads.append((device, frame))
        return super().image(device, frame)


@cache
def picture() -> Image:
    return render(small_camera(), turned(8, 10, 5, MIDDLE), A4_BOARD)


def make_take(folder: Path, odd: tuple[int, int] = (-1, -1)) -> None:
    for device in range(DEVICES):
        source = folder / "source" / f"cam{device}"
        source.mkdir(parents=True)
        for frame in range(FRAMES):
            image = np.roll(picture(), (3 * frame, 2 * device), axis=(0, 1))
            image[0, 0] += (device, frame) == odd
            cv2.imwrite(str(source / f"{frame:04d}.png"), image)
    import_take(folder / "source", folder / "take")


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("board")
    make_take(folder)
    return folder / "take"


@pytest.fixture
def take(original: Path, tmp_path: Path) -> Take:
    CountingTake.reads.clear()
    shutil.copytree(original, tmp_path / "take")
    return open_take(tmp_path / "take")


def open_take(folder: Path) -> Take:
    plain = Take.open(folder)
    return CountingTake(plain.folder, plain.manifest)


def observed(take: Take, limits: CornerLimits = LIMITS) -> BoardSightings:
    CountingTake.reads.clear()
    return observe_board(take, A4_BOARD, limits, cache=CornerCache(take, A4_BOARD))


def entries(take: Take) -> list[Path]:
    return sorted((take.products / "corners").rglob("*.json"))


def same(one: BoardSightings, two: BoardSightings) -> bool:
    return one.tally == two.tally and all(
        getattr(one.every, key).tobytes() == getattr(two.every, key).tobytes()
        for key in ("device", "pose", "corner", "pixels")
    )


def test_a_second_run_reads_no_image_and_says_the_same(take: Take) -> None:
    plain = observe_board(take, A4_BOARD, LIMITS)
    first = observed(take)
    assert len(CountingTake.reads) == TOTAL
    again = observed(open_take(take.folder))
    assert CountingTake.reads == []
    assert same(plain, first)
    assert same(plain, again)
    np.testing.assert_equal(plain.blur_px, again.blur_px)
    judged = observed(take, CornerLimits(min_corners=89))  # limits are judged anew
    assert CountingTake.reads == []
    assert judged.tally["cam0"] == {"few corners": FRAMES}


def test_an_interrupted_run_goes_on_where_it_stopped(take: Take) -> None:
    def stop(done: int, total: int, what: str) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        observe_board(take, A4_BOARD, LIMITS, cache=CornerCache(take, A4_BOARD), progress=stop)
    kept = len(entries(take))
    assert kept >= DEVICES
    assert not list(take.products.rglob(".partial*"))
    observed(take)
    assert len(CountingTake.reads) == TOTAL - kept
    assert len(entries(take)) == TOTAL


def test_damaged_entries_are_done_again(take: Take) -> None:
    whole = observed(take)
    paths = entries(take)
    before = [path.read_bytes() for path in paths]
    paths[0].write_bytes(before[0][:200])
    paths[1].write_bytes(b"")
    paths[2].write_bytes(before[2].replace(b"0", b"1", 40))
    entry = json.loads(before[3].split(b"\n")[1])
    entry["faces"][0]["ids"][-1] = 88  # not a corner of this board; the check sum fits
    text = json.dumps(entry)
    paths[3].write_text(f"{hashlib.sha256(text.encode()).hexdigest()}\n{text}")
    paths[4].write_text(hashlib.sha256(b"[[1]]").hexdigest() + "\n[[1]]")
    paths[5].write_bytes(b"\xff\x80" * 50)
    again = observed(take)
    assert len(CountingTake.reads) == 6
    assert same(whole, again)
    assert [path.read_bytes() for path in paths] == before


def test_another_board_file_has_entries_of_its_own(take: Take) -> None:
    observed(take)
    wider = dataclasses.replace(A4_BOARD, marker_mm=14.9)
    bar = ScaleBar(dictionary="DICT_4X4_50", markers=(1, 2), marker_mm=20.0, length_mm=100.0)
    folders = {
        CornerCache(take, board).folder
        for board in (A4_BOARD, wider, BoardBody.of(A4_BOARD, bar), BoardBody.of(A4_BOARD))
    }
    assert len(folders) == 3  # a body of one board is that board
    assert CornerCache(take, wider).load("cam0", 0) is None
    assert CornerCache(take, A4_BOARD).load("cam0", 0) is not None


def test_entries_belong_to_the_bytes_of_their_image(take: Take, tmp_path: Path) -> None:
    observed(take)
    make_take(tmp_path / "other", odd=(1, 2))
    shutil.copytree(take.products, tmp_path / "other" / "take" / "products")
    other = open_take(tmp_path / "other" / "take")
    observed(other)
    assert CountingTake.reads == [("cam1", 2)]


def test_a_folder_that_cannot_be_written_costs_only_time(take: Take) -> None:
    take.products.mkdir(exist_ok=True)
    (take.products / "corners").write_text("in the way")
    kept = CornerCache(take, A4_BOARD)
    found = observe_board(take, A4_BOARD, LIMITS, cache=kept)
    assert found.tally["cam0"]["used"] == FRAMES
    assert kept.fault.startswith(f"{kept.folder}: ")
    with pytest.raises(TakeError, match="frame 9 of cam0 was lost"):
        kept.load("cam0", 9)
