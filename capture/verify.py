"""Reading a take back: frames against their CRC, files against their hash, the ledger's sums.

One pass over each file gives both the CRC of its frames and its SHA-256; devices are read at once,
for neither holds Python's lock. `settle` then gives a take that was recorded its name.
"""

from __future__ import annotations

import hashlib
import os
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

from capture.checksums import fixed_files, read_checksums, write_checksums
from capture.crc import Crc32Joiner
from capture.documents import write_json
from capture.durable import sync_folder, sync_tree
from capture.errors import TakeError, WorkError
from capture.ledger import Ledger, Verdict
from capture.manifest import write_manifest
from capture.mcap import FrameReader, check_frame, frame_bytes, has_sound_front, log_time_ns
from capture.mcap_records import DATA_END, message_index
from capture.product import code_version, hash_file
from capture.progress import Progress, silent
from capture.take import MANIFEST, Take

CHECK = "check.json"
_BLOCK = 1 << 20
_LOOK_S = 0.1  # between looks at whether to stop
_NICE = 10


@dataclass(frozen=True)
class VerifyReport:
    """What reading a take back found.

    Attributes:
        frames: how many were read whole.
        verdicts: how often each verdict stands in the ledger.
        problems: one line each; none when the take is sound.
        hashes: SHA-256 of the files of frames, by path inside the take.
        read_bytes: how much was read.
        seconds: how long it took.
    """

    frames: int
    verdicts: dict[Verdict, int]
    problems: tuple[str, ...]
    hashes: Mapping[str, str] = field(default_factory=dict)
    read_bytes: int = 0
    seconds: float = 0.0

    @property
    def sound(self) -> bool:
        """Whether nothing is wrong."""
        return not self.problems


@dataclass(frozen=True, kw_only=True)
class VerifySettings:
    """How a take is read back.

    Attributes:
        hashed: whether files are held against their SHA-256 too, which takes more time than CRCs.
        from_disk: whether to read what the disk holds, and not what the system still has of it in
            memory.
        gently: whether recording comes first: fewer processors, and those at low priority.
    """

    hashed: bool = True
    from_disk: bool = False
    gently: bool = False


def verify_take(
    take: Take,
    settings: VerifySettings | None = None,
    *,
    progress: Progress = silent,
    stop: Callable[[], bool] = lambda: False,
) -> VerifyReport:
    """Read back all frames of a take, and hold the ledger against them.

    Args:
        take: the take.
        settings: how thoroughly and how gently.
        progress: told how many frames have been read.
        stop: asked ten times a second whether to give up.

    Raises:
        WorkError: when it was stopped.
    """
    began = time.monotonic()
    settings = settings or VerifySettings()
    problems: list[str] = []
    ledger, verdicts = _ledger(take, problems)
    readers = _readers(take, problems)
    found = _read_all(take, readers, settings, progress, stop)
    hashes: dict[str, str] = {}
    for entry in take.manifest.devices:
        if entry.name not in found:
            continue
        reader, back = readers[entry.name], found[entry.name]
        problems += back.problems
        if back.sha256:
            hashes[f"frames/{entry.name}.mcap"] = back.sha256
            if entry.sha256 and back.sha256 != entry.sha256:
                problems.append(f"{reader.path}: its SHA-256 is not the one in take.json")
        if len(reader) != entry.frames:
            problems.append(f"{reader.path}: expected {entry.frames} frames, found {len(reader)}")
        if not reader.closed_well:
            problems.append(f"{reader.path}: was never closed: it has no sound summary")
        if ledger is not None:
            _check_device(reader, entry.name, ledger, problems)
    if settings.hashed:
        _check_sums(take, hashes, problems)
    return VerifyReport(
        frames=sum(back.whole for back in found.values()),
        verdicts=verdicts,
        problems=tuple(problems),
        hashes=hashes,
        read_bytes=sum(back.read_bytes for back in found.values()),
        seconds=time.monotonic() - began,
    )


def settle(take: Take, report: VerifyReport) -> Take:
    """Give a recorded take its name: from then on it counts as read back.

    Writes the hashes into take.json, what reading it back found to check.json, and
    manifest-sha256.txt; brings all to the disk and takes `.partial` off the folder's name.

    Args:
        take: in a folder `NAME.partial`.
        report: of reading it back; a take that is not sound is settled too, and check.json says so.
            Files that it has no hash of are hashed here.

    Raises:
        TakeError: when the folder has another name, or NAME is taken.
        WorkError: when the disk fails.
    """
    folder = take.folder
    final = folder.with_name(folder.name.removesuffix(".partial"))
    if final == folder:
        raise TakeError(f"{folder}: expected a folder NAME.partial")
    if final.exists():
        raise TakeError(f"{final}: exists already; move it away, and run `likeness recover` again")
    try:
        known = _all_hashes(take, report.hashes)
        devices = tuple(
            replace(entry, sha256=known[f"frames/{entry.name}.mcap"])
            for entry in take.manifest.devices
        )
        write_manifest(folder / MANIFEST, replace(take.manifest, devices=devices))
        write_json(folder / CHECK, _document(report))
        write_checksums(folder, known)
        sync_tree(folder)
        folder.rename(final)
    except OSError as error:
        raise WorkError(f"{final}: cannot be settled: {error.strerror}") from error
    sync_folder(final.parent)
    return Take.open(final)


def _all_hashes(take: Take, known: Mapping[str, str]) -> dict[str, str]:
    names = [f"frames/{name}.mcap" for name in take.device_names]
    with ThreadPoolExecutor(os.cpu_count(), "hash") as pool:
        found = pool.map(lambda name: known.get(name) or hash_file(take.folder / name), names)
        return dict(zip(names, found, strict=True))


def _document(report: VerifyReport) -> dict[str, object]:
    return {
        "format": "likeness-check",
        "version": 1,
        "sound": report.sound,
        "checked_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "code": code_version(),
        "frames": report.frames,
        "verdicts": {str(kind): count for kind, count in report.verdicts.items()},
        "read_bytes": report.read_bytes,
        "seconds": round(report.seconds, 3),
        "problems": list(report.problems),
    }


def _ledger(take: Take, problems: list[str]) -> tuple[Ledger | None, dict[Verdict, int]]:
    try:
        ledger = take.ledger()
    except TakeError as error:
        problems.append(str(error))
        return None, {}
    if ledger.devices != take.device_names or ledger.triggers != take.manifest.frame_count:
        problems.append(
            f"{take.folder / 'ledger.csv'}: expected {take.manifest.frame_count} triggers x "
            f"{len(take.device_names)} devices, found {ledger.triggers} x {len(ledger.devices)}"
        )
    return ledger, ledger.counts()


def _readers(take: Take, problems: list[str]) -> dict[str, FrameReader]:
    readers = {}
    for name in take.device_names:
        try:
            readers[name] = take.reader(name)
        except TakeError as error:
            problems.append(str(error))
    return readers


@dataclass(frozen=True)
class _Back:
    """What reading one file back found."""

    whole: int
    read_bytes: int
    sha256: str
    problems: tuple[str, ...]


class _Pass:
    """What the threads that read share: how far they are, and whether to give up."""

    def __init__(self, settings: VerifySettings) -> None:
        self.settings = settings
        self.over = threading.Event()
        self.done: dict[str, int] = {}  # frames read, by device; each written by one thread


def _read_all(
    take: Take,
    readers: Mapping[str, FrameReader],
    settings: VerifySettings,
    progress: Progress,
    stop: Callable[[], bool],
) -> dict[str, _Back]:
    shared = _Pass(settings)
    processors = os.cpu_count() or 1
    workers = max(1, min(len(readers), processors // 2 if settings.gently else processors))
    total = max(1, sum(len(reader) for reader in readers.values()))
    prepare = _lower_priority if settings.gently else None
    with ThreadPoolExecutor(workers, "verify", initializer=prepare) as pool:
        futures: dict[str, Future[_Back]] = {
            name: pool.submit(_read_back, reader, name, shared) for name, reader in readers.items()
        }
        try:
            pending = set(futures.values())
            while pending:
                if stop():
                    raise WorkError(f"{take.folder}: reading it back was stopped")
                pending = wait(pending, timeout=_LOOK_S).not_done
                progress(min(total, sum(shared.done.values())), total, "verify")
        finally:
            shared.over.set()
    progress(total, total, "verify")
    return {name: future.result() for name, future in futures.items()}


def _lower_priority() -> None:
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)  # of this thread only


def _read_back(reader: FrameReader, name: str, shared: _Pass) -> _Back:
    """Read one file from front to back, once, into a buffer of one frame."""
    digest = hashlib.sha256() if shared.settings.hashed else None
    joiner = Crc32Joiner(reader.layout.nbytes)
    frame = memoryview(bytearray(frame_bytes(reader.layout)))
    problems: list[str] = []
    whole = 0
    try:
        with reader.path.open("rb", buffering=0) as file:
            if shared.settings.from_disk:
                os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_SEQUENTIAL)
            stream = _Stream(file.fileno(), digest)
            behind = b""  # what must stand between the frames
            for place in sorted(range(len(reader)), key=reader.offsets.__getitem__):
                if shared.over.is_set():
                    break
                if not stream.skip_to(reader.offsets[place]).endswith(behind):
                    problems.append(_between(reader, place))
                behind = message_index(log_time_ns(reader.headers[place]))
                said = _checked(frame[: stream.fill(frame)], joiner)
                if said:
                    trigger = reader.headers[place].trigger_index
                    problems.append(f"{reader.path}: frame {place} (trigger {trigger}): {said}")
                whole += not said
                shared.done[name] = shared.done.get(name, 0) + 1
            tail = stream.skip_to(None)
            if behind and reader.closed_well and not tail.startswith(behind + DATA_END):
                problems.append(_between(reader, len(reader)))
    except OSError as error:
        problems.append(f"{reader.path}: not readable: {error.strerror}")
        return _Back(whole, 0, "", tuple(problems))
    sha256 = digest.hexdigest() if digest is not None else ""
    return _Back(whole, stream.offset, sha256, tuple(problems))


def _checked(chunk: memoryview, joiner: Crc32Joiner) -> str:
    said = check_frame(chunk, joiner)
    return said or ("" if has_sound_front(chunk) else "damaged at the front of its chunk")


class _Stream:
    """A file read in order, every byte of it hashed on its way."""

    def __init__(self, handle: int, digest: hashlib._Hash | None) -> None:
        self._handle, self._digest = handle, digest
        self._block = memoryview(bytearray(_BLOCK))
        self.offset = 0

    def fill(self, buffer: memoryview) -> int:
        """Read until the buffer is full or the file at its end; how much that was."""
        count = 0
        while count < len(buffer) and (more := os.readv(self._handle, [buffer[count:]])):
            count += more
        self.offset += count
        if self._digest is not None:
            self._digest.update(buffer[:count])
        return count

    def skip_to(self, offset: int | None) -> bytes:
        """Read on to an offset, or to the end; the first bytes of what was skipped."""
        first = b""
        while offset is None or self.offset < offset:
            size = _BLOCK if offset is None else min(_BLOCK, offset - self.offset)
            count = self.fill(self._block[:size])
            first = first or bytes(self._block[:count])
            if count < size:
                break
        return first


def _between(reader: FrameReader, place: int) -> str:
    return f"{reader.path}: damaged between its frames, before frame {place}"


def _check_sums(take: Take, hashes: Mapping[str, str], problems: list[str]) -> None:
    try:
        expected = read_checksums(take.folder)
    except TakeError as error:
        problems.append(str(error))
        return
    if not expected:
        return
    for name, sha256 in expected.items():
        path = take.folder / name
        try:
            found = hashes.get(name) or _hash_inside(take.folder, path)
        except TakeError as error:
            problems.append(str(error))
            continue
        if found != sha256:
            problems.append(f"{path}: its SHA-256 is not the one in manifest-sha256.txt")
    for name in fixed_files(take.folder):
        if name not in expected:
            problems.append(f"{take.folder / name}: is not in manifest-sha256.txt")


def _hash_inside(folder: Path, path: Path) -> str:
    """The hash of a file of the take: of nothing that a link leads to, and of no device or pipe."""
    if not path.is_file():
        raise TakeError(f"{path}: stands in manifest-sha256.txt, and there is no such file")
    if not path.resolve().is_relative_to(folder.resolve()):
        raise TakeError(f"{path}: a link leads out of the take to {path.resolve()}")
    try:
        return hash_file(path)
    except OSError as error:
        raise TakeError(f"{path}: not readable: {error.strerror}") from error


def _check_device(reader: FrameReader, device: str, ledger: Ledger, problems: list[str]) -> None:
    if device not in ledger.devices:
        return
    there = {header.trigger_index for header in reader.headers if header.status == 0}
    good = {
        e.trigger_index for e in ledger.entries if e.device == device and e.verdict == Verdict.OK
    }
    for k in sorted(good - there):
        problems.append(f"{reader.path}: the ledger has frame {k} of {device}, the file has not")
    for k in sorted(there - good):
        problems.append(f"{reader.path}: the file has frame {k} of {device}, the ledger has not")
