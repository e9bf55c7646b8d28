"""Solve a personalised blendshape rig from performances.

Writes DIR/rig.npz, DIR/report.json and DIR/report.html, a page to look at the rig in a browser.
Example: likeness rig --template template.npz --performance smile.npz jaw.npz --out rig
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from capture.errors import WorkError
from capture.progress import Progress
from rig.overrides import read_overrides
from rig.stage import RigSettings, check_match, solve_rig
from rig.template import read_template
from rig.weight_table import read_weights
from tools.report import write_rig_page
from tools.verbs.options import Options
from track.performance import read_performance

REQUIRED = ("template", "performance", "out")
_PLACES = {"performance", "track", "products"}  # in the path of a performance: no take's name


@dataclass(frozen=True, kw_only=True)
class Arguments(Options):
    """Options of `likeness rig`."""

    template: Path
    """The artist's shapes, template.npz."""
    performance: tuple[Path, ...]
    """Corresponded performances, performance.npz, one or more."""
    out: Path
    """The folder to write."""
    weights: Path | None = None
    """Known weights of all frames, weights.npz; solved for when left out."""
    overrides: Path | None = None
    """Shapes as the artist wants them, overrides.toml; leave it out and they are gone again."""
    held_out: tuple[Path, ...] = ()
    """Performances that are not solved on but judged by, performance.npz."""
    page: bool = True
    """Write DIR/report.html, a page that needs nothing else."""
    settings: Annotated[RigSettings, tyro.conf.arg(name="")] = field(default_factory=RigSettings)


def run(arguments: Arguments, progress: Progress) -> dict[str, Any]:
    """Solve, draw the page, and report the residuals."""
    template = read_template(arguments.template)
    performances = [read_performance(path) for path in arguments.performance]
    check_match(template, performances, names=[str(path) for path in arguments.performance])
    held_out = [read_performance(path) for path in arguments.held_out]
    if held_out:
        check_match(template, held_out, names=[str(path) for path in arguments.held_out])
    solve_rig(
        template,
        performances,
        arguments.settings,
        arguments.out,
        weights=None if arguments.weights is None else read_weights(arguments.weights),
        overrides=[]
        if arguments.overrides is None
        else read_overrides(arguments.overrides, arguments.out),
        held_out=held_out,
        progress=progress,
    )
    report = json.loads((arguments.out / "report.json").read_text(encoding="utf-8"))
    plain = {k: v for k, v in report.items() if isinstance(v, str | int | float | bool)}
    told = {"rig": str(arguments.out / "rig.npz"), **plain}
    if not arguments.page:
        return told
    page = arguments.out / "report.html"
    try:
        write_rig_page(
            arguments.out,
            template,
            page,
            performances=performances,
            takes=[take_name(path) for path in arguments.performance],
            settings=arguments.settings,
            progress=progress,
        )
    except WorkError as error:  # the rig is there all the same
        return told | {"page": f"left out: {error}"}
    return told | {"page": str(page), "page_mb": round(page.stat().st_size / 1e6, 2)}


def take_name(path: Path) -> str:
    """What to call a performance by its file: its own name, or that of the take it lies in."""
    parts = [path.stem, *(part.name for part in path.absolute().parents)]
    return next((part for part in parts if part and part not in _PLACES), path.stem)
