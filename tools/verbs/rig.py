"""Solve a personalised blendshape rig from performances.

Writes DIR/rig.npz and DIR/report.json.
Example: likeness rig --template template.npz --performance smile.npz jaw.npz --out rig
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from capture.progress import Progress
from rig.stage import RigSettings, check_match, solve_rig
from rig.template import read_template
from rig.weight_table import read_weights
from tools.verbs.options import Options
from track.performance import read_performance

REQUIRED = ("template", "performance", "out")


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
    settings: Annotated[RigSettings, tyro.conf.arg(name="")] = field(default_factory=RigSettings)


def run(arguments: Arguments, progress: Progress) -> dict[str, Any]:
    """Solve and report the residuals."""
    template = read_template(arguments.template)
    performances = [read_performance(path) for path in arguments.performance]
    check_match(template, performances, names=[str(path) for path in arguments.performance])
    solve_rig(
        template,
        performances,
        arguments.settings,
        arguments.out,
        weights=None if arguments.weights is None else read_weights(arguments.weights),
        progress=progress,
    )
    report = json.loads((arguments.out / "report.json").read_text(encoding="utf-8"))
    plain = {k: v for k, v in report.items() if isinstance(v, str | int | float | bool)}
    return {"rig": str(arguments.out / "rig.npz"), **plain}
