"""`Session`: the takes of one day with one actor, and how they are recorded.

::

    SESSION/session.json                  format version and name
    SESSION/takes/<slate>_<take number>/  one folder a take; a retake gets the next number

Nothing is ever deleted: of several takes of a slate, the one with the highest number counts,
and the others are superseded.
"""

from __future__ import annotations

import dataclasses
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from capture.collate import TriggerTrain
from capture.devices.array import DeviceArray
from capture.devices.capabilities import Health
from capture.documents import read_document, write_json
from capture.durable import FolderLock
from capture.errors import SettingsError, TakeError, raise_all
from capture.judgement import Colour, Judgement, judge
from capture.manifest import DeviceEntry, TakeManifest
from capture.names import is_plain_name
from capture.progress import Progress, silent
from capture.recorder import Recording, RecordSettings
from capture.stream import record_frames
from capture.sync_report import SyncReport, sync_report
from capture.take import Take
from capture.take_notes import NoteBook, TakeStatus
from capture.take_writer import TakeWriter, partial_folder
from capture.verify import settle, verify_take

FORMAT = "likeness-session"
VERSION = 1
_RANKS = {TakeStatus.KEEP: 2, TakeStatus.RETAKE: 0}  # all else 1
_KINDS = ("board", "neutral", "expression")


@dataclass(frozen=True, kw_only=True)
class Shot:
    """One thing to record.

    Attributes:
        slate: its name, safe as a file name.
        kind: "board", "neutral" or "expression".
        frames: how many.
        start_ns: when trigger 0 is sent, by the line's clock; None: as soon as all is ready.
        hold: first and last frame of the part that must be whole, counted without the pre-roll; or
            None.
    """

    slate: str
    kind: str
    frames: int
    start_ns: int | None = None
    hold: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        problems = []
        if not is_plain_name(self.slate):
            problems.append(f"slate must be letters, digits, '-', '_' or '.', found {self.slate!r}")
        if self.kind not in _KINDS:
            problems.append(f"kind must be one of {', '.join(_KINDS)}, found {self.kind!r}")
        if self.frames < 1:
            problems.append(f"frames must be at least 1, found {self.frames}")
        if self.hold is not None and not 0 <= self.hold[0] <= self.hold[1] < self.frames:
            problems.append(f"hold must lie within frames 0..{self.frames - 1}, found {self.hold}")
        raise_all(f"shot {self.slate!r}", problems, SettingsError)


@dataclass(frozen=True)
class ShotList:
    """What is to be recorded, in order; slates are unique."""

    shots: tuple[Shot, ...]

    def __post_init__(self) -> None:
        slates = [shot.slate for shot in self.shots]
        double = sorted({slate for slate in slates if slates.count(slate) > 1})
        if double:
            raise SettingsError(
                f"shot list: slates must be unique, found twice: {', '.join(double)}"
            )


@dataclass(frozen=True, kw_only=True)
class TakeNote:
    """One take of a session.

    Attributes:
        slate: of its shot.
        take_number: from 1, in the order of recording.
        kind: of its shot.
        folder: where it stands.
        colour: "green", "amber" or "red".
        sentence: why, in plain words.
        superseded: whether there is a later take of the slate.
    """

    slate: str
    take_number: int
    kind: str
    folder: Path
    colour: str
    sentence: str
    superseded: bool


@dataclass(frozen=True)
class Session:
    """A session folder. Make one with `Session.create`, open one with `Session.open`."""

    folder: Path
    name: str

    @classmethod
    def create(cls, folder: Path, name: str | None = None) -> Session:
        """Make a session folder, or open the one that is there.

        Args:
            folder: the folder to make.
            name: the session's name; the folder's when not given.

        Raises:
            TakeError: when something else stands there.
        """
        folder = Path(folder)
        if (folder / "session.json").exists():
            return cls.open(folder)
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise TakeError(f"{folder}: exists and is not a session; choose another folder")
        session = cls(folder, name if name is not None else folder.name)
        (folder / "takes").mkdir(parents=True, exist_ok=True)
        document = {"format": FORMAT, "version": VERSION, "name": session.name}
        write_json(folder / "session.json", document)
        return session

    @classmethod
    def open(cls, folder: Path) -> Session:
        """Open a session folder.

        Raises:
            TakeError: when it is not one, is damaged, or was written by a newer version.
        """
        path = Path(folder) / "session.json"
        if not path.is_file():
            raise TakeError(f"{folder}: expected a session, found no session.json")
        document = read_document(path, FORMAT, VERSION, TakeError)
        return cls(Path(folder), str(document.get("name", Path(folder).name)))

    def takes(self, damaged: list[str] | None = None) -> tuple[TakeNote, ...]:
        """All takes, slates in order of name and takes in order of number.

        Args:
            damaged: what is wrong with a take that cannot be read is added here, and the take left
                out; None: it is raised.

        Raises:
            TakeError: naming a take whose manifest does not say what was recorded.
        """
        found: list[tuple[str, int, Path, dict[str, Any]]] = []
        for folder in sorted((self.folder / "takes").glob("*/take.json")):
            if folder.parent.name.startswith(".") or folder.parent.suffix == ".partial":
                continue  # not finished, or left behind by a recording that was killed
            try:
                remarks = dict(Take.open(folder.parent).manifest.remarks)
                recorded = "shot" in remarks and "take_number" in remarks
                if recorded:
                    _check_remarks(folder, remarks)
            except TakeError as error:
                if damaged is None:
                    raise
                damaged.append(str(error))
                continue
            if recorded:
                found.append(
                    (remarks["shot"]["slate"], remarks["take_number"], folder.parent, remarks)
                )
        latest = {slate: number for slate, number, _, _ in sorted(found, key=lambda item: item[:2])}
        return tuple(
            TakeNote(
                slate=slate,
                take_number=number,
                kind=remarks["shot"]["kind"],
                folder=folder,
                colour=remarks["judgement"]["colour"],
                sentence=remarks["judgement"]["sentence"],
                superseded=number < latest[slate],
            )
            for slate, number, folder, remarks in sorted(found, key=lambda item: item[:2])
        )

    def take(self, slate: str) -> Take:
        """The take of a slate that counts: the latest that the operator kept; else the latest that
        was not to be taken again; else the latest.

        Raises:
            TakeError: naming the slates that were recorded.
        """
        notes, book = self.takes(), NoteBook.of_session(self.folder)
        ranked = [
            (_RANKS.get(book.read(note.folder.name).status, 1), note.take_number, note.folder)
            for note in notes
            if note.slate == slate
        ]
        if ranked:
            return Take.open(max(ranked)[2])
        known = ", ".join(sorted({note.slate for note in notes})) or "none"
        raise TakeError(f"{self.folder}: no take of {slate!r}; recorded slates: {known}")

    def next_number(self, slate: str) -> int:
        """The take number that the next take of a slate will have."""
        numbers = [0]
        for folder in (self.folder / "takes").glob(f"{slate}_*"):
            matched = re.fullmatch(re.escape(slate) + r"_(\d+)(\.partial)?", folder.name)
            if matched:
                numbers.append(int(matched[1]))
        return max(numbers) + 1


def _check_remarks(path: Path, remarks: dict[str, Any]) -> None:
    wanted = {"shot": ("slate", "kind"), "judgement": ("colour", "sentence")}
    good = isinstance(remarks["take_number"], int) and all(
        isinstance(remarks.get(table), dict)
        and all(isinstance(remarks[table].get(key), str) for key in keys)
        for table, keys in wanted.items()
    )
    good = good and remarks["judgement"]["colour"] in tuple(Colour)
    if not good or not is_plain_name(remarks["shot"]["slate"]):
        raise TakeError(
            f"{path}: damaged manifest: remarks must hold a take_number, shot (slate, kind) and "
            "judgement (colour green, amber or red, and sentence)"
        )


def record_take(
    session: Session,
    shot: Shot,
    array: DeviceArray,
    settings: RecordSettings,
    *,
    progress: Progress = silent,
) -> Take:
    """Record one shot: triggers, frames to disk, ledger, manifest, verdict.

    A take is whole or not there: an interrupted one leaves nothing. A retake never replaces an
    older take; it gets the next number.

    Args:
        session: where the take will stand.
        shot: what to record.
        array: the devices and the line that triggers them.
        settings: rate, exposure, pre-roll and post-roll.
        progress: told after each frame.

    Raises:
        DeviceError: when a device cannot be prepared or does not deliver what it says.
    """
    number = session.next_number(shot.slate)
    folder = session.folder / "takes" / f"{shot.slate}_{number:03d}"
    layouts = {device.info.name: device.info.layout for device in array.devices}
    count = settings.pre_roll + shot.frames + settings.post_roll
    total = count * len(layouts)
    label = f"record {folder.name}"
    partial = partial_folder(folder)
    writer = TakeWriter(partial, layouts)
    try:
        with FolderLock(partial), writer:
            recording = record_frames(
                array,
                settings,
                writer.write,
                count=count,
                start_ns=shot.start_ns,
                told=lambda frames: progress(frames, total, label),
            )
            sync = sync_of(recording)
            verdict = judge_take(recording, sync, shot, settings)
            opening = opening_of(shot, number, settings, recording.train)
            writer.finish(
                lambda devices: manifest_of(
                    opening, folder.name, devices, recording, sync, verdict
                ),
                ledger=recording.ledger,
                hashed=False,
            )
            take = Take.open(partial)
            return settle(take, verify_take(take))
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


def judge_take(
    recording: Recording,
    sync: SyncReport,
    shot: Shot,
    settings: RecordSettings,
    told: Sequence[str] = (),
) -> Judgement:
    """The verdict on a take of a shot: of its ledger, made worse by what its times and clocks say.

    A take that was ended early is judged by what there is.

    Args:
        recording: of the whole take, pre-roll and post-roll included.
        sync: of `sync_of`.
        shot: what was to be recorded.
        settings: how.
        told: what became of synchronized clocks meanwhile; each makes it amber.
    """
    hold = shot.hold
    if hold is not None:
        first, last = (settings.pre_roll + frame for frame in hold)
        last = min(last, recording.ledger.triggers - 1)
        hold = (first, last) if first <= last else None
    verdict = judge(recording.ledger, hold)
    verdict = verdict.at_best(sync.colour, sync.sentence)
    return verdict.at_best(Colour.AMBER, " ".join(told)) if told else verdict


def sync_of(recording: Recording) -> SyncReport:
    """How well the devices of a recording exposed together."""
    # Devices that run free are dated by readings of their clocks, not by the triggers: those times
    # are true as far as the readings are.
    basis = "host" if recording.basis == "free" else recording.basis
    period_ns = recording.train.period_ns
    return sync_report(recording.ledger, recording.clocks, period_ns, basis, recording.readings)


def opening_of(
    shot: Shot, number: int, settings: RecordSettings, train: TriggerTrain
) -> dict[str, Any]:
    """What a take is to be, as it stands in its folder while it is recorded.

    Args:
        shot: what is recorded.
        number: of the take.
        settings: rate, exposure, pre-roll and post-roll.
        train: its triggers, counted from 0.
    """
    return {
        "train": dataclasses.asdict(train),
        "shot": dataclasses.asdict(shot),
        "take_number": number,
        "settings": dataclasses.asdict(settings),
    }


def manifest_of(
    opening: Mapping[str, Any],
    name: str,
    devices: tuple[DeviceEntry, ...],
    recording: Recording,
    sync: SyncReport,
    verdict: Judgement,
    health: Mapping[str, Health] | None = None,
) -> TakeManifest:
    """The manifest of a take that has been recorded.

    Args:
        opening: of `opening_of`.
        name: of the take.
        devices: what their files hold.
        recording: ledger, train and clocks.
        sync: of `sync_of`.
        verdict: of `judge_take`.
        health: by device name, what it said of itself; logged, never counted on.
    """
    clocks = {
        device: {
            "offset_ns": model.offset_ns,
            "drift_ppm": model.drift_ppm,
            "jitter_ns": model.jitter_ns,
        }
        for device, model in recording.clocks.items()
    }
    return TakeManifest(
        name=name,
        kind="capture",
        devices=devices,
        frame_count=recording.ledger.triggers,
        period_ns=recording.train.period_ns,
        start_ns=recording.train.start_ns,
        remarks={
            "shot": opening["shot"],
            "take_number": opening["take_number"],
            "settings": opening["settings"],
            "judgement": dataclasses.asdict(verdict),
            "verdicts": {str(kind): n for kind, n in recording.ledger.counts().items()},
            "clocks": clocks,
            "sync": sync.document(),
            "health": {name: dataclasses.asdict(said) for name, said in (health or {}).items()},
        },
    )
