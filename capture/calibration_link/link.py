"""Which calibration a session uses, and how old it is.

::

    SESSION/calibration.json           id, SHA-256, when made, where it came from
    SESSION/calibration/cameras.json   the calibration itself, copied
    SESSION/calibration/reference.npz  what the devices saw on that day, when there is one
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from capture.calibration_link.reference import read_reference
from capture.camera_file import read_cameras
from capture.documents import key_problems, read_document, write_json
from capture.errors import TakeError, raise_all
from capture.judgement import Colour
from capture.product import hash_file, replacing

LINK_FILE = "calibration.json"
_FOLDER = "calibration"
_FORMAT, _VERSION = "likeness-calibration-link", 1
_DAY_S = 86_400.0
_SHOWN = 12  # characters of a hash that tell one calibration from another


@dataclass(frozen=True, kw_only=True)
class CalibrationLink:
    """The calibration that a session uses.

    Attributes:
        id: the first letters of its hash.
        sha256: of cameras.json.
        source: where it was copied from.
        made: when, UTC, ISO 8601: the time of that file.
        linked: when the session began to use it.
        devices: names of its cameras.
        has_reference: whether what the devices saw on calibration day was kept.
    """

    id: str
    sha256: str
    source: str
    made: str
    linked: str
    devices: tuple[str, ...]
    has_reference: bool = False

    def age_days(self, now: datetime | None = None) -> float:
        """Days since it was made."""
        moment = now if now is not None else datetime.now(UTC)
        return (moment - datetime.fromisoformat(self.made)).total_seconds() / _DAY_S


@dataclass(frozen=True)
class LinkStanding:
    """How the calibration of a session stands today.

    Attributes:
        colour: green, amber or red.
        sentence: for the operator.
        remedy: what to do; empty when green.
    """

    colour: Colour
    sentence: str
    remedy: str = ""


def link_calibration(
    session: Path, cameras: Path, *, reference: Path | None = None, now: datetime | None = None
) -> CalibrationLink:
    """Make a session use a calibration: copy it into the session and note what it is.

    Args:
        session: the session's folder.
        cameras: the cameras.json of the calibration.
        reference: what `make_reference` wrote on that day; None: reference.npz beside it, if any.
        now: the present time.

    Raises:
        CameraError: when cameras.json does not fit.
        ShapeError: when the reference does not fit.
        TakeError: when there is no such session.
    """
    session, cameras = Path(session), Path(cameras)
    if not session.is_dir():
        raise TakeError(f"{session}: no such session folder")
    array = read_cameras(cameras)
    beside = cameras.with_name("reference.npz")
    kept = reference if reference is not None else beside if beside.is_file() else None
    if kept is not None:
        read_reference(kept)  # refused now, not on the day it is needed
    digest = hash_file(cameras)
    made = datetime.fromtimestamp(cameras.stat().st_mtime, UTC)
    link = CalibrationLink(
        id=digest[:_SHOWN],
        sha256=digest,
        source=str(cameras),
        made=made.isoformat(timespec="seconds"),
        linked=(now if now is not None else datetime.now(UTC)).isoformat(timespec="seconds"),
        devices=tuple(array.names),
        has_reference=kept is not None,
    )
    folder = session / _FOLDER
    with replacing(folder / "cameras.json") as partial:
        shutil.copyfile(cameras, partial)
    if kept is not None:
        with replacing(folder / "reference.npz") as partial:
            shutil.copyfile(kept, partial)
    document = {"format": _FORMAT, "version": _VERSION, **asdict(link)}
    write_json(session / LINK_FILE, document)
    return link


def read_link(session: Path) -> CalibrationLink | None:
    """The calibration that a session uses; None when it names none.

    Raises:
        TakeError: naming the file and what does not fit.
    """
    path = Path(session) / LINK_FILE
    if not path.is_file():
        return None
    document = read_document(path, _FORMAT, _VERSION, TakeError)
    words = ("id", "sha256", "source", "made", "linked")
    known = (*words, "devices", "has_reference")
    problems = key_problems(document, known, ("format", "version", *known), "calibration link")
    problems += [
        f"{key}: expected text, found {document[key]!r}"
        for key in words
        if key in document and not isinstance(document[key], str)
    ]
    devices = document.get("devices")
    if not isinstance(devices, list) or not all(isinstance(name, str) for name in devices):
        problems.append(f"devices: expected a list of names, found {devices!r}")
    for key in ("made", "linked"):
        if isinstance(document.get(key), str) and _moment(document[key]) is None:
            problems.append(f"{key}: expected a time with its zone, found {document[key]!r}")
    raise_all(str(path), problems, TakeError)
    return CalibrationLink(
        **{key: document[key] for key in words},
        devices=tuple(document["devices"]),
        has_reference=document["has_reference"] is True,
    )


def linked_cameras(session: Path) -> Path:
    """Where the session's copy of its calibration is."""
    return Path(session) / _FOLDER / "cameras.json"


def linked_reference(session: Path) -> Path:
    """Where the session's copy of the reference of calibration day is."""
    return Path(session) / _FOLDER / "reference.npz"


def calibration_standing(
    session: Path,
    devices: Sequence[str],
    *,
    old_days: float = 7.0,
    now: datetime | None = None,
) -> LinkStanding:
    """How the calibration of a session stands: there, unchanged, for these devices, young enough.

    Args:
        session: the session's folder.
        devices: names of the array's devices.
        old_days: beyond this age it is amber.
        now: the present time.
    """
    try:
        link = read_link(session)
    except TakeError as error:
        return LinkStanding(Colour.RED, str(error), "Link the calibration to the session again.")
    if link is None:
        return LinkStanding(
            Colour.AMBER,
            "The session names no calibration: its takes can be recorded, not reconstructed yet.",
            'Write calibration = "cameras.json" into the array file; without one, record a board '
            "take and run: likeness calibrate",
        )
    copy = linked_cameras(session)
    if not copy.is_file() or hash_file(copy) != link.sha256:
        return LinkStanding(
            Colour.RED, f"{copy} is not the calibration {link.id} that the session was begun with.",
            "Link the calibration to the session again.",
        )  # fmt: skip
    missing = [name for name in devices if name not in link.devices]
    if missing:
        return LinkStanding(
            Colour.RED, f"Calibration {link.id} has no camera for {', '.join(missing)}.",
            "Use the calibration of this array, or calibrate again.",
        )  # fmt: skip
    age = link.age_days(now)
    told = f"Calibration {link.id} is {_days(age)} old"
    if age > old_days or age < -1 / 24:
        when = f"made {link.made[:10]}"
        why = f"older than {old_days:g} days" if age > 0 else "in the future: a clock is wrong"
        return LinkStanding(
            Colour.AMBER, f"{told} ({when}), {why}.",
            "Check the array with the board: likeness drift; calibrate again if it says so.",
        )  # fmt: skip
    return LinkStanding(Colour.GREEN, f"{told}.")


def _days(age: float) -> str:
    if abs(age) < 2:
        return f"{age * 24:.0f} hours"
    return f"{age:.0f} days"


def _moment(text: str) -> datetime | None:
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        return None
    return moment if moment.tzinfo is not None else None
