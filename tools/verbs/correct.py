"""Write an artist's corrections of a tracked take; `likeness track` replays them.

They stand in TAKE/corrections.json with their history: `undo` takes back the last step, `list`
tells what holds. See docs/corrections.md.
Example: likeness correct takes/smile add-pin --frame 12 --vertex 812 --pixel cam03:511.2,388
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import numpy as np
import tyro

from capture.arrays import Floats
from capture.errors import InputError, TakeError
from capture.progress import Progress
from capture.take import Take
from recon.mesh import Mesh, read_obj
from tools.verbs import correct_actions as actions
from tools.verbs.options import Options, parse_frames
from track.corrections import edits
from track.corrections.checks import Subject
from track.corrections.edits import Change
from track.corrections.entries import (
    Anchor,
    Correction,
    Curve,
    FrameExclusion,
    Lock,
    Pin,
    Pixel,
    Remarks,
    ViewExclusion,
)
from track.corrections.replay import Corrections
from track.corrections.sidecar import FILE, LockedFrame, read_book
from track.performance import Performance, read_performance

REQUIRED = ("take", "action")
_ROUNDS = 3  # of triangulation, which is linear over millimetres

_Action: TypeAlias = (
    Annotated[actions.AddPin, tyro.conf.subcommand("add-pin")]
    | Annotated[actions.AddCurve, tyro.conf.subcommand("add-curve")]
    | Annotated[actions.ExcludeView, tyro.conf.subcommand("exclude-view")]
    | Annotated[actions.ExcludeFrame, tyro.conf.subcommand("exclude-frame")]
    | Annotated[actions.LockFrames, tyro.conf.subcommand("lock")]
    | Annotated[actions.UnlockFrames, tyro.conf.subcommand("unlock")]
    | Annotated[actions.AnchorFrames, tyro.conf.subcommand("anchor")]
    | Annotated[actions.Remove, tyro.conf.subcommand("remove")]
    | Annotated[actions.Undo, tyro.conf.subcommand("undo")]
    | Annotated[actions.Redo, tyro.conf.subcommand("redo")]
    | Annotated[actions.Listing, tyro.conf.subcommand("list")]
)


@tyro.conf.configure(
    tyro.conf.CascadeSubcommandArgs,
    tyro.conf.OmitArgPrefixes,
    tyro.conf.OmitSubcommandPrefixes,
)
@dataclass(frozen=True, kw_only=True)
class Arguments(Options):
    """Options of `likeness correct`."""

    take: tyro.conf.Positional[Path]
    """The take; it needs cameras."""
    action: _Action
    """What to do."""
    neutral: Path | None = None
    """The neutral in tracking topology, OBJ; left out: the tracked performance, or neutral.obj."""
    by: str = ""
    """Who corrects, to stand beside the correction; nothing is solved by it."""
    time: str = ""
    """When, in any words."""
    note: str = ""
    """Why."""


def run(arguments: Arguments, progress: Progress) -> dict[str, Any]:
    """Change or list the corrections, and report which entries came and which went."""
    take = Take.open(arguments.take)
    desk = _Desk.of(take, arguments.neutral)
    remarks = Remarks(by=arguments.by, time=arguments.time, note=arguments.note)
    action = arguments.action
    if isinstance(action, actions.Listing):
        return desk.listing(arguments.json)
    if isinstance(action, actions.Undo | actions.Redo):
        turn = edits.undo if isinstance(action, actions.Undo) else edits.redo
        return desk.report(turn(take.folder, desk.subject))
    if isinstance(action, actions.Remove):
        return desk.report(edits.remove(take.folder, desk.subject, action.ids))
    if isinstance(action, actions.UnlockFrames):
        return desk.report(desk.unlock(parse_frames(action.frames, take.frames)))
    if isinstance(action, actions.LockFrames):
        return desk.report(desk.lock(parse_frames(action.frames, take.frames), remarks))
    corrections = _corrections(action, desk)
    return desk.report(edits.add(take.folder, desk.subject, corrections, remarks))


@dataclass(frozen=True, eq=False, kw_only=True)
class _Desk:
    """A take, the mesh that is tracked through it, and the performance if there is one."""

    take: Take
    subject: Subject
    performance: Performance | None

    @classmethod
    def of(cls, take: Take, neutral: Path | None) -> _Desk:
        """Find the mesh: the one named, or that of the performance, or the take's neutral."""
        tracked = take.products / "track" / "performance.npz"
        performance = read_performance(tracked) if tracked.is_file() else None
        if neutral is None and performance is not None:
            mesh = Mesh(performance.vertices[0].astype(np.float64), performance.polygons)
        elif neutral is None and not (take.folder / "neutral.obj").is_file():
            raise TakeError(
                f"{take.folder}: neither tracked nor with a neutral.obj, so no vertex is known; "
                "name the neutral with --neutral MESH.obj"
            )
        else:
            mesh = read_obj(neutral or take.neutral())
        return cls(take=take, subject=Subject.of(take, mesh), performance=performance)

    def report(self, change: Change) -> dict[str, Any]:
        """What changed, and what new pins would do to the mesh as it is tracked."""
        out: dict[str, Any] = {"file": str(self.take.folder / FILE)}
        if change.came:
            out["added"] = [f"{entry.id}: {entry}" for entry in change.came]
        if change.went:
            out["removed"] = [f"{entry.id}: {entry}" for entry in change.went]
        if len(out) == 1:
            out["unchanged"] = "it says so already"
        for entry in change.came:
            if isinstance(entry.what, Pin) and (told := self._told(entry.what)):
                out[f"pin {entry.id}"] = told
        return out

    def listing(self, tables: bool) -> dict[str, Any]:
        """The corrections that hold, as tables or in words."""
        book = read_book(self.take.folder, self.subject)
        entries = sorted(book.entries, key=lambda entry: entry.id)
        out: dict[str, Any] = {
            "file": str(self.take.folder / FILE),
            "corrections": len(entries),
            "can_undo": len(book.history),
            "can_redo": len(book.undone),
        }
        if tables:
            return out | {"entries": [entry.table() for entry in entries]}
        return out | {str(entry.id): str(entry) for entry in entries}

    def lock(self, frames: Sequence[int], remarks: Remarks) -> Change:
        """Lock frames to the performance.

        Raises:
            TakeError: when there is none, or it is of another mesh or lacks a frame.
        """
        if self.performance is None:
            raise TakeError(f"{self.take.folder}: not tracked yet, so there is nothing to lock")
        held = {int(frame): row for row, frame in enumerate(self.performance.frames)}
        missing = [str(frame) for frame in frames if frame not in held]
        if missing or self.performance.vertices.shape[1] != self.subject.vertex_count:
            what = f"no frame {', '.join(missing)}" if missing else "another mesh"
            raise TakeError(f"{self.take.folder}: its performance.npz has {what}; track it again")
        kept = {
            frame: LockedFrame(
                vertices=self.performance.vertices[held[frame]],
                confidence=self.performance.confidence[held[frame]],
            )
            for frame in frames
        }
        return edits.lock(self.take.folder, self.subject, kept, remarks)

    def unlock(self, frames: Sequence[int]) -> Change:
        """Remove the locks of frames.

        Raises:
            InputError: when none of them is locked.
        """
        book = read_book(self.take.folder, self.subject)
        locks = {
            entry.id: entry.what.frame for entry in book.entries if isinstance(entry.what, Lock)
        }
        chosen = [number for number, frame in locks.items() if frame in frames]
        if not chosen:
            locked = ", ".join(map(str, sorted(locks.values())))
            raise InputError(
                f"{self.take.folder}: none of these frames is locked; locked: {locked or 'none'}"
            )
        return edits.remove(self.take.folder, self.subject, chosen)

    def chain(self, name: str) -> tuple[int, ...]:
        """The vertices of the last curve of this name.

        Raises:
            InputError: when there is none.
        """
        book = read_book(self.take.folder, self.subject)
        curves = {
            entry.what.chain: entry.what.vertices
            for entry in sorted(book.entries, key=lambda entry: entry.id)
            if isinstance(entry.what, Curve)
        }
        if name not in curves:
            raise InputError(
                f"--chain {name}: no curve has used this name; give its --vertices"
                + (f", or use one of: {', '.join(curves)}" if curves else "")
            )
        return curves[name]

    def _told(self, pin: Pin) -> str:
        """How far a pin moves its point from where it is tracked, and how well its views agree."""
        if self.performance is None or pin.frame not in self.performance.frames:
            return ""
        row = int(np.flatnonzero(self.performance.frames == pin.frame)[0])
        vertices = self.performance.vertices[row].astype(np.float64)
        (sightings,) = Corrections(self.subject, [pin]).for_frame(pin.frame).sightings
        cameras = {camera.name: camera for camera in self.subject.cameras}
        moved: Floats = np.zeros(3)
        for _ in range(_ROUNDS):
            lifted = sightings.lifted(vertices + moved, cameras)
            moved = moved + lifted.motion[0]
        point = sightings.surface.points(vertices + moved)
        miss = [
            float(np.linalg.norm(cameras[name].project(point)[0] - pixel))
            for name, pixel in sorted(pin.pixels.items())
        ]
        told = f"moves the point by {np.linalg.norm(moved):.2f} mm"
        if len(miss) == 1:
            return told + ", across this one view; a pin in a second view fixes its depth"
        return told + f"; its views meet within {max(miss):.2f} px"


def _corrections(action: Any, desk: _Desk) -> list[Correction]:
    """What an action adds.

    Raises:
        InputError: when its options do not fit each other or cannot be read.
    """
    frames = desk.take.frames
    if isinstance(action, actions.AddPin):
        return [_pin(action)]
    if isinstance(action, actions.AddCurve):
        return [
            Curve(
                frame=action.frame,
                camera=action.camera,
                chain=action.chain,
                vertices=action.vertices or desk.chain(action.chain),
                pixels=tuple(_pixel("--pixels", text) for text in action.pixels),
                weight=action.weight,
            )
        ]
    chosen = parse_frames(action.frames, frames)
    if isinstance(action, actions.AnchorFrames):
        return [Anchor(frame=frame) for frame in chosen]
    if isinstance(action, actions.ExcludeView):
        camera = action.camera
        return [ViewExclusion(camera=camera, first=a, last=b) for a, b in _spans(chosen)]
    return [FrameExclusion(first=a, last=b) for a, b in _spans(chosen)]


def _pin(action: actions.AddPin) -> Pin:
    whole = action.triangle is not None and action.barycentric is not None
    half = (action.triangle is None) != (action.barycentric is None)
    if half or whole == (action.vertex is not None):
        raise InputError("add-pin: expected either --vertex, or --triangle and --barycentric")
    pixels: dict[str, Pixel] = {}
    for text in action.pixel:
        camera, colon, place = text.rpartition(":")
        if not colon:
            raise InputError(f"--pixel {text}: expected CAMERA:COLUMN,ROW, cam03:511.2,388 say")
        if camera in pixels:
            raise InputError(f"--pixel {text}: {camera} is named twice")
        pixels[camera] = _pixel("--pixel", place)
    return Pin(
        frame=action.frame,
        corners=action.triangle or (action.vertex or 0,),
        barycentric=action.barycentric or (1.0,),
        pixels=pixels,
        weight=action.weight,
    )


def _pixel(option: str, text: str) -> Pixel:
    try:
        column, row = (float(word) for word in text.split(","))
    except ValueError as error:
        raise InputError(
            f"{option} {text}: expected COLUMN,ROW, two numbers, 511.2,388 say"
        ) from error
    return column, row


def _spans(frames: Sequence[int]) -> list[tuple[int, int]]:
    """Runs of following frames: first and last of each."""
    spans: list[tuple[int, int]] = []
    for frame in sorted(set(frames)):
        if spans and spans[-1][1] == frame - 1:
            spans[-1] = (spans[-1][0], frame)
        else:
            spans.append((frame, frame))
    return spans
