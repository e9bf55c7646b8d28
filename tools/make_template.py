"""Make a template from a public face model: `python -m tools.make_template ict ICT.npz OUT.npz`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from capture.archive import read_archive
from capture.arrays import check_shape
from capture.errors import InputError, LikenessError
from rig.template import Template, text_names, write_template

_MM_PER_CM = 10.0


def ict_template(path: Path, vertex_count: int) -> Template:
    """The generic face of an ICT-FaceKit light archive: its mean and its named shapes, in mm.

    Args:
        path: archive with neutral (V, 3) and expr (B, V, 3) in cm, expr_names (B) and quads (P, 4).
        vertex_count: how many of the first vertices to keep (6706 narrow face, 9409 face, 11248
            with head and neck); the polygons are those whose corners are all kept.

    Raises:
        InputError: when the archive lacks an array or has fewer vertices than asked for.
    """
    arrays = read_archive(path, ("neutral", "expr", "expr_names", "quads"))
    check_shape(
        neutral=(arrays["neutral"], "V 3"),
        expr=(arrays["expr"], "B V 3"),
        expr_names=(arrays["expr_names"], "B"),
        quads=(arrays["quads"], "P 4"),
    )
    found = len(arrays["neutral"])
    if not 3 <= vertex_count <= found:
        raise InputError(f"{path}: asked for {vertex_count} vertices, it holds {found}")
    kept = arrays["quads"].max(axis=1) < vertex_count
    return Template(
        neutral=arrays["neutral"][:vertex_count].astype(np.float64) * _MM_PER_CM,
        deltas=arrays["expr"][:, :vertex_count].astype(np.float64) * _MM_PER_CM,
        names=text_names(arrays["expr_names"]),
        polygons=arrays["quads"][kept].astype(np.int32),
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line: 0 when the template was written, 2 on bad input."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.make_template",
        description="Make a rig template (template.npz, millimetres) from a public face model.",
        epilog="example: python -m tools.make_template ict ict_light.npz template.npz",
    )
    parser.add_argument("kind", choices=["ict"], help="the model's layout")
    parser.add_argument("source", type=Path, help="the model's archive (.npz)")
    parser.add_argument("out", type=Path, help="template.npz to write")
    parser.add_argument("--vertices", type=int, default=11248, help="first vertices to keep")
    given = parser.parse_args(arguments)
    try:
        template = ict_template(given.source, given.vertices)
        write_template(given.out, template)
    except LikenessError as error:
        print(error, file=sys.stderr)
        return error.exit_status
    still = [
        name for name, moves in zip(template.names, template.moves(), strict=True) if not moves
    ]
    print(
        f"{given.out}: {len(template.neutral)} vertices, {len(template.polygons)} polygons, "
        f"{len(template.names)} shapes; no effect on these vertices: {', '.join(still) or 'none'}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
