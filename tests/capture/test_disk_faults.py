"""Killed, cut, flipped, full: what was written is saved, and what is lost is told exactly."""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import NonSeekingReader, SeekingReader

from capture.ledger import Verdict
from capture.mcap import frame_bytes
from capture.recover import Outcome, TakeRecovery, recover_session, recover_take
from capture.session import Session
from capture.take import Take
from capture.take_writer import partial_folder
from capture.verify import verify_take
from tests.capture.disk_faults import (
    LAYOUTS,
    NAMES,
    Case,
    Recorder,
    acknowledged,
    close_files,
    finish,
    open_writer,
    picture,
    write_frame,
)

FRONT, INDEX = 49 + 31 + 64, 31  # bytes of a chunk before its pixels, and of what follows it


@pytest.fixture(scope="module")
def recorder() -> Iterator[Recorder]:
    with Recorder() as running:
        yield running


@dataclass
class Expected:
    """What must be true after recovery.

    Attributes:
        saved: by device, triggers that must be saved.
        perhaps: by device, triggers that may be saved besides.
        lost: by device, how many frames must be told as damaged; None: not asked.
        dropped: by device, bytes that must be told as dropped; None: not asked.
    """

    saved: dict[str, set[int]]
    perhaps: dict[str, set[int]] = field(default_factory=dict)
    lost: dict[str, int] | None = None
    dropped: dict[str, int] | None = None


def hashes(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def frame_starts(data: bytes, device: str) -> list[int]:
    """Where each chunk begins in a file that is whole: walked record by record."""
    starts, at = [], 8
    while at + 9 <= len(data) and data[at] != 15:
        length = int.from_bytes(data[at + 1 : at + 9], "little")
        if data[at] == 6:
            assert length + 9 == frame_bytes(LAYOUTS[device])
            starts.append(at)
        at += 9 + length
    return starts


def check(final: Path, recovery: TakeRecovery, expected: Expected) -> None:
    """All that must hold of a recovered take."""
    if recovery.outcome == Outcome.EMPTY:
        assert not any(expected.saved.values())
        return
    assert recovery.outcome in (Outcome.SETTLED, Outcome.NOTHING), recovery.sentence
    assert not partial_folder(final).exists()
    take = Take.open(final)
    ledger = take.ledger()
    for place, name in enumerate(NAMES):
        saved = {k for k in take.frames if take.present(name, k)}
        assert saved == {header.trigger_index for header in take.reader(name).headers}
        must = expected.saved[name]
        assert must <= saved <= must | expected.perhaps.get(name, set()), (name, must, saved)
        for k in saved:
            assert np.array_equal(take.image(name, k), picture(name, k))
            assert take.frame(name, k).header.device_index == place
        ok = {k for k in take.frames if ledger.entry(k, name).verdict == Verdict.OK}
        assert ok == saved
    assert sum(ledger.counts().values()) == ledger.triggers * len(NAMES)
    assert verify_take(take).problems == ()
    for device in recovery.devices:
        missing = device.damaged_unknown + len(device.damaged)
        assert not set(device.damaged) & expected.saved[device.name]
        if expected.lost is not None:
            assert missing == expected.lost[device.name], device
        if expected.dropped is not None:
            assert device.dropped_bytes == expected.dropped[device.name], device
    for name in NAMES:
        official(take.folder / "frames" / f"{name}.mcap", len(take.reader(name)))


def official(path: Path, count: int) -> None:
    """The official reader reads it, by its index and without, all CRCs checked."""
    with path.open("rb") as file:
        reader = SeekingReader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == count
        assert len(list(reader.iter_messages())) == count
    with path.open("rb") as file:
        assert len(list(NonSeekingReader(file, validate_crcs=True).iter_messages())) == count


# Ways to spoil a take. Each makes a take at `final`, hurts it, and says what must be saved.


def killed(rng: np.random.Generator, final: Path, recorder: Recorder) -> Expected:
    """A process that writes three devices dies by SIGKILL at a random moment."""
    frames = int(rng.integers(1, 40))
    case = Case(
        folder=str(final),
        frames=frames,
        acks=str(final.parent / f"{final.name}.acks"),
        kill_after_s=float(rng.exponential(4e-3)),
        short=bool(rng.integers(2)),
    )
    recorder.run(case)
    return _of_a_process(case)


def torn(rng: np.random.Generator, final: Path, recorder: Recorder) -> Expected:
    """The process dies with a part of a record written: any part, of any record."""
    case = Case(
        folder=str(final),
        frames=int(rng.integers(1, 12)),
        acks=str(final.parent / f"{final.name}.acks"),
        torn_call=int(rng.integers(0, 40)),
        torn_share=float(rng.random()),
        short=False,
    )
    recorder.run(case)
    return _of_a_process(case)


def _of_a_process(case: Case) -> Expected:
    written = acknowledged(Path(case.acks))
    following = {name: {len(done)} for name, done in written.items()}
    return Expected(written, following, lost=dict.fromkeys(NAMES, 0))


def _made(rng: np.random.Generator, final: Path, ends: str) -> int:
    frames = int(rng.integers(1, 9))
    with open_writer(final, frames) as writer:
        for k in range(frames):
            for device in NAMES:
                write_frame(writer, device, k)
        if ends == "closed":
            close_files(writer, final, frames)
        if ends == "settled":
            finish(writer, final, frames)
    return frames


def _files(final: Path) -> dict[str, Path]:
    frames = partial_folder(final) / "frames"
    return {name: next(frames.glob(f"{name}.mcap*")) for name in NAMES}


def cut(rng: np.random.Generator, final: Path, recorder: Recorder) -> Expected:
    """Each file ends at a random byte, often a record boundary or one byte beside it."""
    frames = _made(rng, final, str(rng.choice(["abandoned", "closed"])))
    out = Expected({}, lost={}, dropped={})
    for name, path in _files(final).items():
        data = path.read_bytes()
        starts, size = frame_starts(data, name), frame_bytes(LAYOUTS[name])
        ends = [s + size for s in starts]
        boundaries = sorted({*starts, *ends, *(e + INDEX for e in ends), len(data)})
        length = int(rng.integers(0, len(data) + 1))
        if rng.random() < 0.5:
            near = int(rng.choice(boundaries)) + int(rng.integers(-1, 2))
            length = min(max(near, 0), len(data))
        os.truncate(path, length)
        out.saved[name] = {k for k in range(frames) if ends[k] <= length}
        out.lost = None if out.lost is None else out.lost | {name: 0}
        whole = [b for b in (starts[0], *ends, *(e + INDEX for e in ends)) if b <= length]
        if whole and length < len(data) and out.dropped is not None:
            out.dropped[name] = length - max(whole)
    if out.dropped is not None and len(out.dropped) < len(NAMES):
        out.dropped = None  # a file that was not cut, or cut in its head
    return out


def flipped(rng: np.random.Generator, final: Path, recorder: Recorder) -> Expected:
    """Up to three bits of each file are the other way round, anywhere."""
    frames = _made(rng, final, str(rng.choice(["abandoned", "closed"])))
    return _flip(rng, final, frames)


def _flip(rng: np.random.Generator, final: Path, frames: int) -> Expected:
    """Flip bits; a frame is lost only by one where its CRC covers it, or in the CRC itself."""
    out = Expected({}, lost={})
    for name, path in _files(final).items():
        data = bytearray(path.read_bytes())
        starts, size = frame_starts(bytes(data), name), frame_bytes(LAYOUTS[name])
        hit = set()
        for bit in rng.choice(len(data) * 8, int(rng.integers(0, 4)), replace=False):
            data[bit // 8] ^= 1 << int(bit % 8)
            for k, start in enumerate(starts):
                if 33 <= bit // 8 - start < 37 or 49 <= bit // 8 - start < size:
                    hit.add(k)
        path.write_bytes(bytes(data))
        out.saved[name] = set(range(frames)) - hit
        out.lost = {**(out.lost or {}), name: len(hit)}
    return out


def zeroed(rng: np.random.Generator, final: Path, recorder: Recorder) -> Expected:
    """The last bytes are zeros, as after a power cut that kept the length and not the bytes."""
    frames = _made(rng, final, "abandoned")
    out = Expected({}, lost={})
    for name, path in _files(final).items():
        data = path.read_bytes()
        starts, size = frame_starts(data, name), frame_bytes(LAYOUTS[name])
        keep = len(data) - int(rng.integers(0, 3 * size))
        keep = max(keep, starts[0])
        path.write_bytes(data[:keep] + bytes(len(data) - keep))
        out.saved[name] = {k for k in range(frames) if starts[k] + size <= keep}
        out.lost = {**(out.lost or {}), name: frames - len(out.saved[name])}
    return out


def papers(rng: np.random.Generator, final: Path, recorder: Recorder) -> Expected:
    """Any of opening.json, take.json, ledger.csv is gone, cut or spoilt; frames are whole."""
    frames = _made(rng, final, str(rng.choice(["abandoned", "closed", "closed"])))
    for name in ("opening.json", "take.json", "ledger.csv"):
        path = partial_folder(final) / name
        fate = rng.choice(["kept", "gone", "cut", "empty"])
        if not path.exists() or fate == "kept":
            continue
        if fate == "gone":
            path.unlink()
        else:
            data = path.read_bytes()
            path.write_bytes(data[: int(rng.integers(0, len(data))) if fate == "cut" else 0])
    return Expected({name: set(range(frames)) for name in NAMES}, lost=dict.fromkeys(NAMES, 0))


def gone(rng: np.random.Generator, final: Path, recorder: Recorder) -> Expected:
    """The file of a device is not there, or has no byte."""
    frames = _made(rng, final, str(rng.choice(["abandoned", "closed"])))
    name = str(rng.choice(NAMES))
    path = _files(final)[name]
    if rng.random() < 0.5:
        path.unlink()
    else:
        os.truncate(path, 0)
    saved = {device: set(range(frames)) for device in NAMES}
    return Expected({**saved, name: set()})


def interrupted(rng: np.random.Generator, final: Path, recorder: Recorder) -> Expected:
    """Bits are flipped, and then recovery itself is killed, once or twice."""
    out = flipped(rng, final, recorder)
    out.lost = None  # the second run finds copies that the first one made
    for _ in range(int(rng.integers(1, 3))):
        if partial_folder(final).exists():
            kill_after_s = float(rng.exponential(4e-3))
            recorder.run(Case(folder=str(final), recover=True, kill_after_s=kill_after_s))
    return out


Way = Callable[[np.random.Generator, Path, Recorder], Expected]
WAYS: tuple[Way, ...] = (
    killed, torn, cut, flipped, zeroed, papers, gone, interrupted, killed, torn
)  # fmt: skip


def run_cases(count: int, seed: int, recorder: Recorder) -> dict[str, int]:
    """Run random cases in one session; how often recovery had which outcome."""
    memory = Path("/dev/shm")
    place = memory if os.access(memory, os.W_OK) else None  # syncing costs nothing there
    outcomes: dict[str, int] = {}
    with tempfile.TemporaryDirectory(dir=place) as folder:
        session = Session.create(Path(folder) / "session")
        takes = session.folder / "takes"
        _made(np.random.default_rng(seed), takes / "earlier_001", "settled")
        earlier = hashes(takes / "earlier_001")
        for number in range(count):
            rng = np.random.default_rng((seed, number))
            way, final = WAYS[number % len(WAYS)], takes / "smile_001"
            said = f"way {way.__name__}, seed {(seed, number)}"
            expected = way(rng, final, recorder)
            before = hashes(partial_folder(final)) if partial_folder(final).exists() else {}
            done = recover_session(session)
            recovery = done[0] if done else recover_take(final)
            try:
                check(final, recovery, expected)
                assert hashes(takes / "earlier_001") == earlier
                if recovery.outcome == Outcome.EMPTY:
                    assert hashes(partial_folder(final)) == _without_room(before)
                else:
                    assert recover_session(session) == ()
                    assert recover_take(final).outcome == Outcome.NOTHING
                    assert {note.slate for note in session.takes()} >= {"earlier"}
            except Exception as error:
                error.add_note(f"{said}: {recovery.sentence}")
                raise
            outcomes[recovery.outcome] = outcomes.get(recovery.outcome, 0) + 1
            for left in takes.glob("smile*"):
                shutil.rmtree(left) if left.is_dir() else left.unlink()
    return outcomes


def _without_room(files: dict[str, str]) -> dict[str, str]:
    return {name: sha256 for name, sha256 in files.items() if name != ".room"}


def test_random_faults_lose_what_they_hit_and_no_more(recorder: Recorder) -> None:
    outcomes = run_cases(25, 7, recorder)
    assert outcomes["settled"] > 12


@pytest.mark.slow
def test_five_hundred_random_faults_lose_what_they_hit_and_no_more(recorder: Recorder) -> None:
    outcomes = run_cases(520, 2026, recorder)
    assert sum(outcomes.values()) == 520
