"""Register a template mesh to the actor at the first frame, topology kept.

Reconstructs the frame first when its scan is not there yet. A landmark map beside the template
(head.landmarks.json) is carried along.
Example: likeness neutral takes/neutral --template head.obj --out neutral.obj
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from capture.progress import Progress
from capture.take import Take
from recon.mesh import read_obj
from tools.verbs.options import Options
from track.landmark_map import map_beside, read_landmark_map, write_landmark_map
from track.neutral import NeutralSettings, register_neutral

REQUIRED = ("take", "template", "out")


@dataclass(frozen=True, kw_only=True)
class Arguments(Options):
    """Options of `likeness neutral`."""

    take: tyro.conf.Positional[Path]
    """A take whose first frame is neutral."""
    template: Path
    """Any face mesh, OBJ, millimetres, roughly placed or not."""
    out: Path
    """The registered mesh to write."""
    landmarks: Path | None = None
    """Hand marks, JSON; see docs/neutral.md."""
    settings: Annotated[NeutralSettings, tyro.conf.arg(name="")] = field(
        default_factory=NeutralSettings
    )


def run(arguments: Arguments, progress: Progress) -> dict[str, Any]:
    """Register and report."""
    take = Take.open(arguments.take)
    mesh = register_neutral(
        take,
        read_obj(arguments.template),
        arguments.settings,
        arguments.out,
        landmarks=arguments.landmarks,
        progress=progress,
    )
    report = {"neutral": str(arguments.out), "vertices": len(mesh.vertices)}
    if (beside := map_beside(arguments.template)).is_file():
        where = read_landmark_map(beside, mesh)  # the vertices are the same
        write_landmark_map(map_beside(arguments.out), where)
        report["landmark_map"] = str(map_beside(arguments.out))
    return report
