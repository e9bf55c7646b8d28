"""Files that outlive a crash: whole parts or nothing, room kept ahead, locks."""

from __future__ import annotations

import errno
import os
import resource
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from capture.durable import AppendFile, FolderLock, KeptSynced, sync_folder, sync_tree
from capture.errors import WorkError


@contextmanager
def files_up_to(limit_bytes: int) -> Iterator[None]:
    """A system on which no file grows beyond a length."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_parts_stand_one_behind_the_other(tmp_path: Path) -> None:
    file = AppendFile(tmp_path / "a")
    file.append(b"one", memoryview(b"two"), b"")
    file.append(b"three")
    assert file.offset == 11
    file.close()
    assert file.closed
    assert (tmp_path / "a").read_bytes() == b"onetwothree"


def test_the_system_may_take_less_than_it_is_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "writev", lambda handle, parts: os.write(handle, b"".join(parts)[:3]))
    file = AppendFile(tmp_path / "a")
    file.append(b"0123456", b"78", b"9" * 20)
    file.close()
    assert (tmp_path / "a").read_bytes() == b"0123456789" + b"9" * 19


def test_what_does_not_fit_leaves_what_was_there_and_more_may_follow(tmp_path: Path) -> None:
    file = AppendFile(tmp_path / "a", "the film")
    file.append(b"x" * 100)
    with (
        files_up_to(150),
        pytest.raises(WorkError, match="the film: cannot be written: File too large"),
    ):
        file.append(b"y" * 100)
    assert (file.offset, (tmp_path / "a").stat().st_size) == (100, 100)
    file.append(b"z")
    file.close()
    assert (tmp_path / "a").read_bytes() == b"x" * 100 + b"z"


def test_room_is_taken_without_length_and_given_back_at_the_end(tmp_path: Path) -> None:
    file = AppendFile(tmp_path / "a")
    assert file.reserve(1 << 20)
    file.append(b"x" * 10)
    taken = (tmp_path / "a").stat()
    if taken.st_blocks * 512 < 1 << 20:
        pytest.skip("this file system takes no room ahead")
    assert taken.st_size == 10
    file.close()
    assert (tmp_path / "a").stat().st_blocks * 512 < 1 << 20


def test_syncing_goes_on_in_the_background_until_the_end(tmp_path: Path) -> None:
    called = threading.Event()
    with KeptSynced([called.set], every_s=0.001):
        assert called.wait(5)
    called.clear()
    assert not called.wait(0.02)
    file = AppendFile(tmp_path / "a")
    file.append(b"x")
    file.sync()
    file.close()
    file.sync()  # nothing, once it is closed


def test_a_disk_that_fails_in_the_background_is_told_at_the_next_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(handle: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    file = AppendFile(tmp_path / "a")
    file.append(b"x")
    monkeypatch.setattr(os, "fdatasync", fail)
    file.sync()
    for action in (lambda: file.append(b"y"), file.close):
        with pytest.raises(WorkError, match="a: cannot be written: Input/output error"):
            action()
    assert file.closed


def test_a_folder_is_locked_by_one_at_a_time(tmp_path: Path) -> None:
    with FolderLock(tmp_path) as first:
        assert first.held
        with FolderLock(tmp_path) as second:
            assert not second.held
    with FolderLock(tmp_path) as third:
        assert third.held


def test_folders_are_synced_with_all_that_is_in_them(tmp_path: Path) -> None:
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "a" / "b" / "c").write_text("c")
    sync_tree(tmp_path)
    sync_folder(tmp_path)
    with pytest.raises(FileNotFoundError):
        sync_folder(tmp_path / "nowhere")
