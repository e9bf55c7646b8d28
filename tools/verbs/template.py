"""Carry an artist's template onto a mesh of other topology, such as a tracked production mesh.

Writes the new template, and says how well the two meshes met.
Example: likeness template --template artist.npz --mesh actor.obj --out actor_template.npz
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from capture.arrays import Ints
from capture.documents import read_json, read_toml
from capture.errors import InputError, TakeError, raise_all
from capture.progress import Progress
from recon.mesh import read_obj
from rig.correspondence import correspond
from rig.retopology import RetopologySettings, carry_template, check_face, retopology_report
from rig.template import read_template, write_template
from tools.verbs.options import Options

REQUIRED = ("template", "mesh", "out")


@dataclass(frozen=True, kw_only=True)
class Arguments(Options):
    """Options of `likeness template`."""

    template: Path
    """The artist's shapes, template.npz."""
    mesh: Path
    """A neutral face of another topology, OBJ, millimetres."""
    out: Path
    """The template to write, template.npz, in the mesh's topology and place."""
    landmarks: Path | None = None
    """Pairs of vertices, template's and mesh's, JSON or TOML; see docs/template.md."""
    settings: Annotated[RetopologySettings, tyro.conf.arg(name="")] = field(
        default_factory=RetopologySettings
    )


def run(arguments: Arguments, progress: Progress) -> dict[str, Any]:
    """Carry the template and report."""
    template = read_template(arguments.template)
    mesh = read_obj(arguments.mesh)
    try:
        check_face(mesh)
    except InputError as error:
        raise InputError(f"{arguments.mesh}: {error}") from error
    marks = None
    if arguments.landmarks is not None:
        marks = read_pairs(arguments.landmarks, len(template.neutral), len(mesh.vertices))
    found = correspond(template.mesh, mesh, arguments.settings, landmarks=marks, progress=progress)
    carried = carry_template(template, mesh, found, arguments.settings)
    write_template(arguments.out, carried)
    return {"template": str(arguments.out)} | retopology_report(template, mesh, found, carried)


def read_pairs(path: Path, template_count: int, mesh_count: int) -> Ints:
    """Read pairs of vertices (N, 2), the template's and the mesh's.

    ::

        {"pairs": [[812, 345], [77, 1203], [901, 18]]}

    or the same as TOML, `pairs = [[812, 345], ...]`. Vertices count from 0.

    Raises:
        TakeError: listing every pair that does not fit, by its place.
    """
    read = read_toml if path.suffix == ".toml" else read_json
    document = read(path, TakeError, absent="no such landmarks file")
    pairs = document.get("pairs") if isinstance(document, dict) else None
    if not isinstance(pairs, list) or not pairs or set(document) != {"pairs"}:
        raise TakeError(
            f'{path}: expected one key, "pairs", with a list of [template, mesh] vertices'
        )
    problems = []
    for place, pair in enumerate(pairs):
        whole = isinstance(pair, list) and len(pair) == 2 and all(type(v) is int for v in pair)
        if not whole:
            problems.append(f"pairs[{place}]: expected two vertex numbers, found {pair!r}")
        elif not (0 <= pair[0] < template_count and 0 <= pair[1] < mesh_count):
            problems.append(
                f"pairs[{place}]: {pair}: the template has vertices 0..{template_count - 1}, "
                f"the mesh 0..{mesh_count - 1}"
            )
    raise_all(f"{path}", problems, TakeError)
    return np.array(pairs, dtype=np.int64)
