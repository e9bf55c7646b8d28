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
from track.landmark_dlib import GenericDetector
from track.landmark_map import map_beside, read_landmark_map, write_landmark_map
from track.neutral import Detected, NeutralSettings, register_neutral

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
    detect: bool = False
    """Detect the face by the extra `landmarks` (read docs/licences.md) for one more place to try;
    needs TEMPLATE.landmarks.json beside the template."""
    settings: Annotated[NeutralSettings, tyro.conf.arg(name="")] = field(
        default_factory=NeutralSettings
    )


def run(arguments: Arguments, progress: Progress) -> dict[str, Any]:
    """Register and report."""
    take = Take.open(arguments.take)
    template = read_obj(arguments.template)
    beside = map_beside(arguments.template)
    where = read_landmark_map(beside, template) if beside.is_file() or arguments.detect else None
    detected = None
    if arguments.detect and where is not None:
        detected = Detected(detector=GenericDetector(), where=where)
    mesh = register_neutral(
        take,
        template,
        arguments.settings,
        arguments.out,
        landmarks=arguments.landmarks,
        detected=detected,
        progress=progress,
    )
    report = {"neutral": str(arguments.out), "vertices": len(mesh.vertices)}
    if where is not None:  # the vertices are the same
        write_landmark_map(map_beside(arguments.out), where)
        report["landmark_map"] = str(map_beside(arguments.out))
    return report
