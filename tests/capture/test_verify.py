"""Reading back: every kind of damage is found and named, in one pass, and it can be stopped."""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from capture.errors import WorkError
from capture.mcap import FrameReader
from capture.take import Take
from capture.verify import VerifySettings, verify_take
from tests.capture.disk_faults import NAMES, finish, open_writer, write_frame


@pytest.fixture
def take(tmp_path: Path) -> Take:
    with open_writer(tmp_path / "smile_001", 5) as writer:
        for k in range(5):
            for device in NAMES:
                write_frame(writer, device, k)
        return finish(writer, tmp_path / "smile_001", 5)


def flip(path: Path, at: int) -> None:
    data = bytearray(path.read_bytes())
    data[at] ^= 1
    path.write_bytes(bytes(data))


def chunk(take: Take, k: int) -> int:
    return FrameReader(take.folder / "frames" / "cam01.mcap").offsets[k]


@pytest.mark.parametrize(
    ("at", "words"),
    [
        (lambda take: chunk(take, 2) + 400, r"cam01\.mcap: frame 2 \(trigger 2\): damaged: exp"),
        (lambda take: chunk(take, 2) + 34, r"frame 2 \(trigger 2\): damaged: expected CRC"),
        (lambda take: chunk(take, 2) + 10, "damaged at the front of its chunk"),
        (lambda take: chunk(take, 3) - 3, "its SHA-256 is not the one in take.json"),
        (lambda take: chunk(take, 3) - 3, "damaged between its frames, before frame 3"),
        (lambda take: 20, "its SHA-256 is not the one in manifest-sha256"),
        (lambda take: -40, "was never closed: it has no sound summary"),
    ],
)
def test_a_flipped_bit_anywhere_is_found(take: Take, at: Callable[[Take], int], words: str) -> None:
    flip(take.folder / "frames" / "cam01.mcap", at(take))
    report = verify_take(Take.open(take.folder))
    assert any(re.search(words, problem) for problem in report.problems)


def test_the_papers_are_held_against_their_hashes(take: Take) -> None:
    flip(take.folder / "opening.json", -10)
    (take.folder / "features").mkdir()
    (take.folder / "features" / "cam00.json").write_text("{}")
    (take.folder / "ledger.csv").write_text((take.folder / "ledger.csv").read_text() + "\n")
    said = "\n".join(verify_take(Take.open(take.folder)).problems)
    assert "opening.json: its SHA-256 is not the one in manifest-sha256.txt" in said
    assert "ledger.csv: " in said
    assert "features/cam00.json: is not in manifest-sha256.txt" in said
    assert verify_take(Take.open(take.folder), VerifySettings(hashed=False)).hashes == {}


def test_what_a_take_gets_later_is_no_damage(take: Take) -> None:
    (take.folder / "notes.json").write_text("{}")
    (take.folder / "products").mkdir()
    (take.folder / "products" / "x").write_text("x")
    assert verify_take(Take.open(take.folder)).problems == ()


def test_it_tells_how_far_it_is_and_ends_at_the_end(take: Take) -> None:
    told: list[tuple[int, int, str]] = []
    report = verify_take(take, progress=lambda *step: told.append(step))
    assert report.frames == 15
    assert report.read_bytes == sum(
        path.stat().st_size for path in (take.folder / "frames").iterdir()
    )
    assert told[-1] == (15, 15, "verify")
    assert all(0 <= done <= 15 for done, _, _ in told)


def test_it_can_be_stopped_and_leaves_no_thread(take: Take) -> None:
    before = threading.active_count()
    with pytest.raises(WorkError, match="smile_001: reading it back was stopped"):
        verify_take(take, stop=lambda: True)
    assert threading.active_count() == before


def test_a_file_that_is_gone_is_a_problem_of_one_device(take: Take) -> None:
    opened = Take.open(take.folder)
    (take.folder / "frames" / "cam01.mcap").unlink()
    report = verify_take(opened)
    assert report.frames == 10
    assert any("cam01.mcap: no such file" in problem for problem in report.problems)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("features/gone.json", "features/gone.json: stands in manifest-sha256.txt, and there is"),
        ("features/pipe", "features/pipe: stands in manifest-sha256.txt, and there is no such"),
        ("features/link", "features/link: a link leads out of the take to "),
        ("features/a\0b", "there is no such file"),
    ],
)
def test_a_hostile_list_of_hashes_leads_to_nothing_outside_the_take(
    take: Take, name: str, words: str
) -> None:
    (take.folder / "features").mkdir()
    os.mkfifo(take.folder / "features" / "pipe")
    (take.folder.parent / "secret").write_text("x")
    (take.folder / "features" / "link").symlink_to(take.folder.parent / "secret")
    sums = take.folder / "manifest-sha256.txt"
    sums.write_text(sums.read_text() + "0" * 64 + f"  {name}\n")
    assert any(words in problem for problem in verify_take(Take.open(take.folder)).problems)
