"""Files that outlive a crash: no copies when they grow, room kept ahead, synced all the while.

A recording cannot be repeated, so what is written must reach the disk while it goes on, and a full
disk must be met before a frame is torn by it and not after.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import functools
import os
import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

from capture.disk_faults import Disk, RealDisk
from capture.errors import WorkError

_KEEP_SIZE = 1  # FALLOC_FL_KEEP_SIZE: room is taken, the file's length stays
_FULL = (errno.ENOSPC, errno.EDQUOT)


class AppendFile:
    """A file that only grows. All methods but `sync` are called from one thread at a time.

    Attributes:
        path: where it stands.
        offset: its length: all appended parts are whole up to there.
    """

    def __init__(self, path: Path, label: str = "", disk: Disk | None = None) -> None:
        """Make the file, or empty the one that is there.

        Args:
            path: the file.
            label: what messages call it, where that is not its path.
            disk: that it is written to; this machine's when not given.

        Raises:
            WorkError: when the disk is full or fails.
        """
        self.path = Path(path)
        self._label = label or str(path)
        self.offset = 0
        self._disk: Disk = disk if disk is not None else RealDisk()
        try:
            self._file: BinaryIO = self.path.open("wb", buffering=0)
        except OSError as error:
            raise WorkError(self._said(error)) from error
        self._sync_error: OSError | None = None
        self._syncing = threading.Lock()

    @property
    def closed(self) -> bool:
        """Whether `close` was called."""
        return self._file.closed

    def reserve(self, size: int) -> bool:
        """Take room on the disk for `size` bytes behind what is there; the length stays.

        Returns:
            False when the disk has no such room; True when it is taken, and where the file system
            does no such thing.
        """
        return _allocate(self._file.fileno(), self.offset, size) not in _FULL

    def append(self, *parts: bytes | memoryview) -> None:
        """Write the parts one behind the other, all of them or nothing.

        Raises:
            WorkError: when the disk is full or fails; what was appended before is whole.
        """
        if self._sync_error is not None:
            raise WorkError(self._said(self._sync_error)) from self._sync_error
        pending = [memoryview(part).cast("B") for part in parts]
        end = self.offset
        while pending:
            try:
                written = self._disk.writev(self.path, self._file.fileno(), pending)
            except OSError as error:
                self._cut_back()
                raise WorkError(self._said(error)) from error
            end += written
            while pending and written >= len(pending[0]):
                written -= len(pending.pop(0))
            if pending and written:
                pending[0] = pending[0][written:]
        self.offset = end

    def sync(self) -> None:
        """Bring what was appended to the disk; from any thread. A failure is told by `append`."""
        with self._syncing:
            if self._file.closed:
                return
            try:
                os.fdatasync(self._file.fileno())
            except OSError as error:
                self._sync_error = error

    def close(self) -> None:
        """Give back room that was not used, bring all to the disk, close.

        Raises:
            WorkError: when the disk fails; the file is closed all the same.
        """
        if self._file.closed:
            return
        with self._syncing, self._file:
            try:
                os.ftruncate(self._file.fileno(), self.offset)
                os.fsync(self._file.fileno())
            except OSError as error:
                raise WorkError(self._said(error)) from error
        if self._sync_error is not None:  # the kernel tells an error of a lost page only once
            raise WorkError(self._said(self._sync_error)) from self._sync_error

    def _cut_back(self) -> None:
        try:
            os.ftruncate(self._file.fileno(), self.offset)
            os.lseek(self._file.fileno(), self.offset, os.SEEK_SET)
        except OSError as error:
            self._sync_error = error  # a torn part stays at the end: nothing may follow it

    def _said(self, error: OSError) -> str:
        return f"{self._label}: cannot be written: {error.strerror}"


class KeptSynced:
    """Syncs files from a thread of its own for as long as the `with` block lasts."""

    def __init__(self, syncs: Iterable[Callable[[], None]], every_s: float = 0.5) -> None:
        """Hold the `sync` methods to call, one after the other, and the pause between rounds."""
        self._syncs = tuple(syncs)
        self._every_s = every_s
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="sync frames", daemon=True)

    def __enter__(self) -> KeptSynced:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._over.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._over.wait(self._every_s):
            for sync in self._syncs:
                if self._over.is_set():
                    return
                sync()


class FolderLock:
    """A lock on a folder that is there; it ends with the `with` block, or with the process.

    Attributes:
        held: False when somebody else holds it.
    """

    def __init__(self, folder: Path) -> None:
        """Try to lock a folder."""
        self._handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self.held = True
        except OSError as error:
            self.held = error.errno != errno.EWOULDBLOCK  # a file system without locks: as if

    def __enter__(self) -> FolderLock:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        os.close(self._handle)


def sync_folder(folder: Path) -> None:
    """Bring the names in a folder to the disk: a new file is lost without it, whatever it holds.

    Raises:
        WorkError: when the disk fails.
    """
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # some network shares cannot
            raise WorkError(f"{folder}: cannot be synced: {error.strerror}") from error
    finally:
        os.close(handle)


def sync_tree(folder: Path) -> None:
    """Bring a folder and all that is in it to the disk."""
    for path in sorted(folder.rglob("*")):
        if path.is_file() and not path.is_symlink():
            with path.open("rb") as file:
                os.fsync(file.fileno())
        elif path.is_dir():
            sync_folder(path)
    sync_folder(folder)


def in_memory(folder: Path) -> bool:
    """Whether a folder stands on a file system in memory; False where nobody says."""
    device = folder.stat().st_dev
    number = f"{os.major(device)}:{os.minor(device)}"
    try:
        mounts = Path("/proc/self/mountinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return False
    kinds = [line.partition(" - ")[2].split()[:1] for line in mounts if line.split()[2] == number]
    return any(kind in (["tmpfs"], ["ramfs"]) for kind in kinds)


def _allocate(handle: int, offset: int, size: int) -> int:
    """Take room behind the end of a file; the number of the error, or 0."""
    function = _fallocate()
    if function is None:
        return errno.EOPNOTSUPP
    while True:
        if function(handle, _KEEP_SIZE, offset, size) == 0:
            return 0
        if (fault := ctypes.get_errno()) != errno.EINTR:
            return fault


@functools.cache
def _fallocate() -> Any:
    # Python's own posix_fallocate lengthens the file, and a crash would leave zeros at its end.
    library = ctypes.CDLL(None, use_errno=True)
    function = getattr(library, "fallocate64", None) or getattr(library, "fallocate", None)
    if function is not None:
        function.argtypes = [ctypes.c_int, ctypes.c_int, ctypes.c_int64, ctypes.c_int64]
    return function
