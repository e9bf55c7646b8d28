"""Tell the health of a rig: errors, use, scale, gaps, symmetry, interference, jitter, captures.

What is not given is not compared. docs/health.md says what each figure means.
Example: likeness health rig --template template.npz --performance smile.npz --held-out jaw.npz
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from capture.errors import InputError
from capture.progress import Progress
from rig.exchange import read_thing
from rig.face_rig import FaceRig
from rig.fit import Observations
from rig.health import rig_health
from rig.report import write_report
from rig.stage import observe
from rig.template import read_template
from tools.verbs.options import Options
from track.performance import read_performance


@dataclass(frozen=True, kw_only=True)
class Arguments(Options):
    """Options of `likeness health`."""

    rig: tyro.conf.Positional[Path]
    """rig.npz, the folder that holds it, or template.npz."""
    template: Path | None = None
    """The artist's shapes, template.npz, with the rig's names and vertices."""
    performance: tuple[Path, ...] = ()
    """Performances that the rig was solved on, in the same order."""
    held_out: tuple[Path, ...] = ()
    """Performances that it was not solved on."""
    out: Path | None = None
    """A file to write the whole report to, as JSON."""


def run(arguments: Arguments, progress: Progress) -> dict[str, Any]:
    """Measure, write, and report all of it with --json, or else its summary."""
    path = arguments.rig / "rig.npz" if arguments.rig.is_dir() else arguments.rig
    rig = read_thing(path)
    if not isinstance(rig, FaceRig):
        raise InputError(f"{path}: expected a rig or a template, found {type(rig).__name__}")
    template = None if arguments.template is None else read_template(arguments.template)
    progress(0, 1, "health")
    report = rig_health(
        rig,
        template,
        seen=_frames(arguments.performance),
        held_out=_frames(arguments.held_out),
    )
    progress(1, 1, "health")
    if arguments.out is not None:
        write_report(arguments.out, report)
    return report if arguments.json else summary(report)


def summary(report: dict[str, Any]) -> dict[str, str]:
    """The report in a dozen lines, the faults by name."""
    degenerate, use, gauge = report["degenerate"], report["activity"], report["gauge"]
    captures, held = report["captures"], report["held_out"]
    lines = {"rig": f"{report['shapes']} shapes, {report['frames']} frames"}
    if held is not None:
        ratio = "" if held["ratio"] is None else f", {held['ratio']:.2f} of the template's"
        lines["held-out error"] = (
            f"{held['rmse_mm']:.3f} mm root mean square{ratio}, worst {held['max_mm']:.2f} mm "
            f"(frame {held['worst_frame']}, vertex {held['worst_vertex']})"
        )
    lines["shapes without effect"] = _listed(degenerate["zero"])
    lines["not shapes"] = _listed([f"{n} {why}" for n, why in degenerate["not_shapes"].items()])
    lines["duplicates"] = _listed(
        [f"{d['shape']} = {d['scale']:.3g} {d['of']}" for d in degenerate["duplicates"]]
    )
    lines["dependent"] = _listed([d["equals"] for d in degenerate["dependent"]])
    lines["active shapes a frame"] = (
        f"{use['active_mean']:.1f} mean, {use['active_p95']:.0f} at the 95th percentile"
    )
    lines["never exercised"] = _listed(use["never_exercised"])
    lines["scale drifted"] = _listed(
        [f"{n} x {gauge['shapes'][n]['scale']:.2f}" for n in gauge["drifted"]]
    )
    lines["weak weights"] = _listed(gauge["weak"])
    lines |= _contact_lines(report["contact"])
    lines["least symmetric"] = _listed(_least_symmetric(report["symmetry"]["pairs"]), 3)
    lines["weights that move together"] = _listed(
        [" and ".join(pair["shapes"]) for pair in report["interference"]["cross_activated"]]
    )
    if report["jitter"]["vertices_rms_mm"] is not None:
        lines["jitter"] = f"{report['jitter']['vertices_rms_mm']:.4f} mm a frame^2"
    lines["captures to spare"] = _listed([str(d["frame"]) for d in captures["redundant"]], 20)
    lines["undetermined"] = _listed(captures["undetermined"])
    lines["shoot next"] = _listed([" + ".join(s["shapes"]) for s in captures["shoot_next"]])
    if report["mouth_close"] is not None:
        lines["mouthClose"] = str(report["mouth_close"]["convention"])
    return lines


def _contact_lines(contact: dict[str, Any] | None) -> dict[str, str]:
    if contact is None:
        return {}
    gaps = [
        f"{' + '.join(c['expression'])} {c['gap_mean_mm']:.2f} mm "
        f"(template {c['template_gap_mean_mm']:.2f})"
        for c in contact["closed"]
    ]
    opened = [f"{o['shape']} by {o['opens_mm']:.2f} mm" for o in contact["opened"]]
    return {"gaps where shut": _listed(gaps), "lips parted by": _listed(opened)}


def _least_symmetric(pairs: list[dict[str, Any]]) -> list[str]:
    known = [p for p in pairs if p["asymmetry"] is not None]
    known.sort(key=lambda p: -float(p["asymmetry"]))
    return [f"{p['left']} {p['asymmetry']:.2f}" for p in known]


def _listed(words: list[str], most: int = 8) -> str:
    rest = len(words) - most
    return (", ".join(words[:most]) or "none") + (f" and {rest} more" if rest > 0 else "")


def _frames(paths: tuple[Path, ...]) -> Observations | None:
    return observe([read_performance(path) for path in paths]) if paths else None
