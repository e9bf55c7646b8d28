"""What a crash left of a session: every `NAME.partial` becomes the take NAME."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from capture.documents import is_whole
from capture.durable import FolderLock
from capture.errors import LikenessError, TakeError
from capture.frame_header import ImageLayout
from capture.ledger import Ledger, write_ledger
from capture.manifest import DeviceEntry, TakeManifest, read_manifest, write_manifest
from capture.opening import OPENING, Opening, read_opening
from capture.progress import Progress, silent
from capture.recover.ledger import mended_ledger, recovered_judgement
from capture.recover.mend import make_empty, mend, source_of
from capture.recover.report import DeviceRecovery, FileMend, Outcome, TakeRecovery
from capture.recover.salvage import Salvage, layout_of, salvage
from capture.session import Session
from capture.take import MANIFEST, Take
from capture.take_writer import ROOM
from capture.verify import settle, verify_take

_SUFFIX = ".partial"
_T = TypeVar("_T")


@dataclass(frozen=True, eq=False)
class _Known:
    """What is known of a take before its frames are looked at."""

    layouts: Mapping[str, ImageLayout]
    opening: Opening | None
    manifest: TakeManifest | None

    @property
    def planned(self) -> int | None:
        """How many triggers were to be recorded."""
        if self.manifest is not None:
            return self.manifest.frame_count
        return self.opening.expected_frames if self.opening is not None else None


def recover_session(
    session: Session,
    *,
    progress: Progress = silent,
    told: Callable[[TakeRecovery], None] = lambda recovery: None,
) -> tuple[TakeRecovery, ...]:
    """Recover every take of a session that was not finished, one after the other.

    Args:
        session: whose takes.
        progress: told while each is read back.
        told: given what became of each, as it is known.
    """
    out = []
    for folder in sorted((session.folder / "takes").glob(f"*{_SUFFIX}")):
        if folder.is_dir() and not folder.name.startswith("."):
            out.append(recover_take(folder, progress=progress))
            told(out[-1])
    return tuple(out)


def recover_take(folder: Path, *, progress: Progress = silent) -> TakeRecovery:
    """Make a take of what a crash left, and say exactly what was saved and what is lost.

    A frame is saved when its CRC is right. Nothing is thrown away but the torn end of a file; a
    folder in which there is no whole frame stays as it is. A take that another process records or
    recovers is left alone. Stopped at any moment, it can be run again.

    Args:
        folder: `NAME.partial`; a take that has its name already needs nothing.
        progress: told while it is read back.

    Raises:
        TakeError: when there is no such folder.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise TakeError(f"{folder}: no such folder; expected a session, or a folder NAME{_SUFFIX}")
    if folder.suffix != _SUFFIX:
        Take.open(folder)
        return TakeRecovery(folder=folder, outcome=Outcome.NOTHING)
    with FolderLock(folder) as lock:
        if not lock.held:
            reason = "another process records or recovers it; it is left alone"
            return TakeRecovery(folder=folder, outcome=Outcome.BUSY, reason=reason)
        try:
            return _recover(folder, progress)
        except LikenessError as error:
            reason = str(error)
        except OSError as error:
            reason = f"{error.filename or folder}: {error.strerror or error}"
        return TakeRecovery(folder=folder, outcome=Outcome.FAILED, reason=reason)


def _recover(folder: Path, progress: Progress) -> TakeRecovery:
    final = folder.with_suffix("")
    if final.exists():
        raise TakeError(f"{final}: exists already; move it away, and run this again")
    _refuse_links(folder)
    (folder / ROOM).unlink(missing_ok=True)
    known = _known(folder)
    frames = folder / "frames"
    found: dict[str, Salvage | None] = {}
    for place, (name, layout) in enumerate(known.layouts.items()):
        source = source_of(frames / f"{name}.mcap")
        found[name] = None if source is None else salvage(source, name, layout, place)
    if not any(there is not None and there.headers for there in found.values()):
        reason = "there is no whole frame in it; it stays as it is, delete it when you like"
        return TakeRecovery(folder=folder, outcome=Outcome.EMPTY, reason=reason)
    devices = tuple(
        _device(name, there, _mended(frames / f"{name}.mcap", there, known.layouts[name]))
        for name, there in found.items()
    )
    count = None if known.manifest is None else known.manifest.frame_count
    ledger, unchanged = mended_ledger(folder / "ledger.csv", found, count)
    remade = []
    if not unchanged:
        remade.append("ledger.csv")
        write_ledger(folder / "ledger.csv", ledger)
    if known.manifest is None or remade or any(d.mend != FileMend.WHOLE for d in devices):
        remade.append(MANIFEST)
        _write_manifest(folder, known, ledger, devices, remade)
    take = Take.open(folder)
    report = verify_take(take, progress=progress)
    take = settle(take, report)
    return TakeRecovery(
        folder=take.folder,
        outcome=Outcome.SETTLED,
        reason="; ".join(report.problems),
        devices=devices,
        frame_count=ledger.triggers,
        planned=known.planned,
        verdicts=ledger.counts(),
        remade=tuple(remade),
    )


def _refuse_links(folder: Path) -> None:
    """Recovery cuts and moves files: it does so to none that stands elsewhere."""
    links = [path for path in folder.rglob("*") if path.is_symlink()]
    if folder.is_symlink() or links:
        raise TakeError(
            f"{links[0] if links else folder}: is a link, and a recording makes none; put the "
            "file itself there, and run this again"
        )


def _known(folder: Path) -> _Known:
    """The devices by take.json, else by opening.json, else by what the files say of themselves."""
    manifest = _read(read_manifest, folder / MANIFEST)
    opening = _read(read_opening, folder / OPENING)
    layouts: dict[str, ImageLayout]
    if manifest is not None:
        layouts = {d.name: d.layout for d in manifest.devices}
    elif opening is not None:
        layouts = dict(opening.devices)
    else:
        layouts = {}
        for path in sorted((folder / "frames").glob("*.mcap*")):
            head = layout_of(path)
            if head is not None and head[0] == path.name.partition(".mcap")[0]:
                layouts[head[0]] = head[1]
    if not layouts:
        raise TakeError(
            f"{folder}: neither {MANIFEST} nor {OPENING} nor any file of frames says what was "
            "recorded"
        )
    return _Known(layouts, opening, manifest)


def _read(reader: Callable[[Path], _T], path: Path) -> _T | None:
    try:
        return reader(path)
    except TakeError:  # missing or damaged: the others know as much
        return None


def _mended(final: Path, there: Salvage | None, layout: ImageLayout) -> FileMend:
    final.parent.mkdir(exist_ok=True)
    return make_empty(final, layout) if there is None else mend(there, final)


def _device(name: str, there: Salvage | None, done: FileMend) -> DeviceRecovery:
    if there is None:
        return DeviceRecovery(name=name, mend=done, frames=0)
    whole = {header.trigger_index for header in there.headers}
    broken = [damage for damage in there.damages if not damage.torn]
    named = [k for damage in broken for k in damage.triggers]
    torn = [k for damage in there.damages if damage.torn for k in damage.triggers]
    return DeviceRecovery(
        name=name,
        mend=done,
        frames=len(there.headers),
        damaged=tuple(k for k in named if k not in whole),
        damaged_unknown=sum(damage.frames for damage in broken) - len(named),
        torn=torn[0] if torn else None,
        dropped_bytes=sum(damage.size for damage in there.damages),
    )


def _write_manifest(
    folder: Path,
    known: _Known,
    ledger: Ledger,
    devices: tuple[DeviceRecovery, ...],
    remade: list[str],
) -> None:
    entries = tuple(
        DeviceEntry(name=d.name, layout=known.layouts[d.name], frames=d.frames, sha256="")
        for d in devices
    )
    manifest = known.manifest
    if manifest is None:
        manifest = _new_manifest(folder, known.opening, entries, ledger)
    remarks = {
        **manifest.remarks,
        "verdicts": {str(kind): count for kind, count in ledger.counts().items()},
        "recovered": {
            "planned": known.planned,
            "remade": remade,
            "devices": {d.name: d.losses for d in devices if d.losses},
        },
    }
    if "ledger.csv" in remade or "judgement" not in remarks:
        remarks["judgement"] = recovered_judgement(ledger, known.planned)
    manifest = replace(manifest, devices=entries, remarks=json.loads(json.dumps(remarks)))
    write_manifest(folder / MANIFEST, manifest)


def _new_manifest(
    folder: Path, opening: Opening | None, entries: tuple[DeviceEntry, ...], ledger: Ledger
) -> TakeManifest:
    recording = {} if opening is None else dict(opening.recording)
    train = recording.pop("train", None)
    return TakeManifest(
        name=folder.with_suffix("").name,
        kind="capture",
        devices=entries,
        frame_count=ledger.triggers,
        period_ns=_whole(train, "period_ns"),
        start_ns=_whole(train, "start_ns"),
        remarks=recording,
    )


def _whole(table: Any, key: str) -> int | None:
    value = table.get(key) if isinstance(table, dict) else None
    return value if is_whole(value) else None
