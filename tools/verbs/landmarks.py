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

from capture.errors import TakeError
from capture.progress import Progress
from capture.take import Take
from recon.mesh import read_obj
from rig.template import read_template
from rig.transfer import transfer_shapes
from tools.verbs.options import Options, parse_frames
from track.landmark_map import map_beside, read_landmark_map, transferred
from track.landmark_stage import LandmarkSettings, detect_landmarks, train_landmarks

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
    frames: str | None = None
    """Which frames: A:B (B excluded), A:B:STEP, A or A,B,C; all by default."""
    settings: Annotated[LandmarkSettings, tyro.conf.arg(name="")] = field(
        default_factory=LandmarkSettings
    )


def run(arguments: Arguments, progress: Progress) -> dict[str, Any]:
    """Train, detect, and report."""
    take = Take.open(arguments.take)
    frames = parse_frames(arguments.frames, take.frames)
    mesh = read_obj(arguments.neutral)
    marked = arguments.map_mesh or arguments.neutral
    source = read_obj(marked)
    where = read_landmark_map(arguments.map or map_beside(marked), source)
    if arguments.map_mesh is not None:
        where = transferred(where, source, mesh)
    shapes = None
    if arguments.template is not None:
        template = read_template(arguments.template)
        if not np.array_equal(template.polygons, mesh.polygons):
            raise TakeError(
                f"{arguments.template}: its polygons are not those of {arguments.neutral}"
            )
        deltas = transfer_shapes(template, mesh.vertices)
        shapes = dict(zip(template.names, deltas, strict=True))
    detector = train_landmarks(
        take, mesh, where, arguments.settings, shapes=shapes, progress=progress
    )
    report = detect_landmarks(take, detector, where, arguments.settings, frames, progress=progress)
    found = [figures for figures in report["frames"].values() if figures["found"]]
    return {
        "landmarks": str(take.products / "landmarks"),
        "frames": len(frames),
        "found": len(found),
        "accuracy_px": round(float(np.median([f["accuracy_px"] for f in found])), 3)
        if found
        else None,
        "miss_mm": round(float(np.median([f["miss_mm"] for f in found])), 3) if found else None,
    }
