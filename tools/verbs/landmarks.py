"""Find the landmarks of lips, lids, brows and nose in every frame, for tracking to start from.

Trains a predictor for this actor from his neutral; needs the extra `landmarks` (dlib).
Example: likeness landmarks takes/smile --neutral takes/smile/neutral.obj
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from capture.arrays import Floats
from capture.errors import TakeError
from capture.progress import Progress
from capture.take import Take
from recon.mesh import Mesh, read_obj
from rig.template import read_template
from rig.transfer import transfer_shapes
from tools.verbs.options import Options, parse_frames
from track.landmark_map import LandmarkMap, map_beside, read_landmark_map, transferred
from track.landmark_stage import (
    LandmarkSettings,
    detect_landmarks,
    import_landmarks,
    train_landmarks,
)
from track.rigid import fit_similarity

REQUIRED = ("take", "neutral")


@dataclass(frozen=True, kw_only=True)
class Arguments(Options):
    """Options of `likeness landmarks`."""

    take: tyro.conf.Positional[Path]
    """The take; it needs cameras."""
    neutral: Path
    """The neutral in tracking topology, registered to the first frame, OBJ, world mm."""
    map: Path | None = None
    """Which vertices are landmarks, JSON; by default the .landmarks.json beside the mesh."""
    map_mesh: Path | None = None
    """Another mesh of this actor at the same frame, OBJ, that the map counts vertices of."""
    template: Path | None = None
    """A rig template (.npz) of the neutral's topology: train on its expressions."""
    detections: Path | None = None
    """Landmarks of another detector, JSON: taken over as they are, nothing is trained."""
    frames: str | None = None
    """Which frames: A:B (B excluded), A:B:STEP, A or A,B,C; all by default."""
    settings: Annotated[LandmarkSettings, tyro.conf.arg(name="")] = field(
        default_factory=LandmarkSettings
    )


def run(arguments: Arguments, progress: Progress) -> dict[str, Any]:
    """Train and detect, or take over, and report."""
    take = Take.open(arguments.take)
    frames = parse_frames(arguments.frames, take.frames)
    mesh = read_obj(arguments.neutral)
    folder = str(take.products / "landmarks")
    if arguments.detections is not None:
        own = _landmark_map(arguments, mesh) if _map_known(arguments) else None
        taken = import_landmarks(take, mesh, arguments.detections, own)
        return {"landmarks": folder, "frames": len(taken), "views": sum(taken.values())}
    where = _landmark_map(arguments, mesh)
    detector = train_landmarks(
        take, mesh, where, arguments.settings,
        shapes=_shapes(arguments, mesh), progress=progress,
    )  # fmt: skip
    report = detect_landmarks(take, detector, where, arguments.settings, frames, progress=progress)
    found = [figures for figures in report["frames"].values() if figures["found"]]
    told: dict[str, Any] = {"landmarks": folder, "frames": len(frames), "found": len(found)}
    for name in ("accuracy_px", "miss_mm"):
        if found:
            told[name] = round(float(np.median([figures[name] for figures in found])), 3)
    return told


def _map_known(arguments: Arguments) -> bool:
    beside = map_beside(arguments.map_mesh or arguments.neutral)
    return arguments.map is not None or beside.is_file()


def _landmark_map(arguments: Arguments, mesh: Mesh) -> LandmarkMap:
    marked = arguments.map_mesh or arguments.neutral
    source = mesh if arguments.map_mesh is None else read_obj(marked)
    where = read_landmark_map(arguments.map or map_beside(marked), source)
    return where if arguments.map_mesh is None else transferred(where, source, mesh)


def _shapes(arguments: Arguments, mesh: Mesh) -> dict[str, Floats] | None:
    """The template's expressions on this actor; None when no template is given."""
    if arguments.template is None:
        return None
    template = read_template(arguments.template)
    if not np.array_equal(template.polygons, mesh.polygons):
        raise TakeError(f"{arguments.template}: its polygons are not those of {arguments.neutral}")
    placed = fit_similarity(template.neutral, mesh.vertices)  # transfer wants the template's axes
    upright = (mesh.vertices - placed.translation) @ placed.rotation
    deltas = transfer_shapes(template, upright) @ placed.rotation.T
    return dict(zip(template.names, deltas, strict=True))
