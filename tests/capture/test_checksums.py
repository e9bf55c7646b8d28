"""manifest-sha256.txt: as sha256sum reads it, and never a path out of the take."""

from __future__ import annotations

import hashlib
import subprocess
from pathlib import Path

import pytest

from capture.checksums import CHECKSUMS, fixed_files, read_checksums, write_checksums
from capture.errors import TakeError


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in (
        "frames/cam00.mcap",
        "frames/cam01.mcap.partial",
        "features/cam00/all.json",
        "ledger.csv",
        "notes.json",
        "products/track/performance.npz",
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(name)
    return tmp_path


def test_files_that_never_change_are_listed_with_their_hash(folder: Path) -> None:
    names = ("features/cam00/all.json", "frames/cam00.mcap", "ledger.csv")
    assert fixed_files(folder) == names
    write_checksums(folder, {"ledger.csv": "0" * 64})
    found = read_checksums(folder)
    assert tuple(found) == names
    assert found["frames/cam00.mcap"] == hashlib.sha256(b"frames/cam00.mcap").hexdigest()
    assert found["ledger.csv"] == "0" * 64  # it was known, and not read again


def test_sha256sum_agrees(folder: Path) -> None:
    write_checksums(folder, {})
    command = ["sha256sum", "--check", "--strict", CHECKSUMS]
    assert subprocess.run(command, cwd=folder, capture_output=True, check=False).returncode == 0


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("0" * 63 + "  ledger.csv", "expected a SHA-256, two blanks and a path"),
        ("0" * 64 + "  ../other/take.json", r"\.\./other/take.json lies outside the take"),
        ("0" * 64 + "  /etc/passwd", "/etc/passwd lies outside the take"),
    ],
)
def test_lines_that_do_not_fit_are_refused(folder: Path, line: str, words: str) -> None:
    (folder / CHECKSUMS).write_text(line + "\n")
    with pytest.raises(TakeError, match=r"manifest-sha256\.txt:1: " + words):
        read_checksums(folder)


def test_a_take_without_it_has_no_hashes(tmp_path: Path) -> None:
    assert read_checksums(tmp_path) == {}
