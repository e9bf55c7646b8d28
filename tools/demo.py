"""The demo: a simulated 16-camera session through every stage, and a report to look at.

A page of plain calls whose arguments show the data flow. The simulated actor's truth stands beside
the session, in a folder that no stage reads; only the report's error figures use it.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from capture.progress import Progress, silent
from capture.settings import settings_to_toml
from capture.take import Take
from recon.board.charuco import read_board
from recon.calibration.solver import CalibrateSettings
from recon.calibration.stage import calibrate, report_path
from recon.mesh import write_obj
from recon.scan import ReconSettings, reconstruct
from rig.export import export
from rig.stage import RigSettings, solve_rig
from rig.template import Template, read_template, write_template
from tools.actor.model import build_actor
from tools.actor.scene import DEMO_BOARD
from tools.demo_picture import write_picture
from tools.demo_session import (
    BOARD,
    EXPRESSIONS,
    NEUTRAL,
    DemoSettings,
    peak_frame,
    record_session,
)
from tools.demo_truth import take_errors
from tools.report import (
    ReportInputs,
    TakeErrors,
    TakeInputs,
    write_calibration_page,
    write_report,
)
from track.neutral import NeutralSettings, register_neutral
from track.stage import TrackSettings, track


@dataclass
class Stopwatch:
    """Seconds by stage, in the order run."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def timing(self, stage: str) -> Iterator[None]:
        """Add the time of a block to a stage."""
        start = time.monotonic()
        yield
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.monotonic() - start


def run_demo(out: Path, settings: DemoSettings, *, progress: Progress = silent) -> dict[str, Any]:
    """Run the whole house once; what is finished is kept and skipped when run again.

    Args:
        out: the folder to fill: session/, cameras.json, rig/, exports/, report.html, picture.jpg.
        settings: of the demo; stages run with their own defaults.
        progress: told of every stage's steps.

    Returns:
        The report's path, seconds by stage, and median errors against the truth.
    """
    watch = Stopwatch()
    with watch.timing("capture"):
        session, true_array = record_session(out / "session", settings, progress=progress)
    neutral_take = session.take(NEUTRAL)
    expressions = [session.take(slate) for slate in EXPRESSIONS]
    faces = [neutral_take, *expressions]
    with watch.timing("calibrate"):
        (out / "board.toml").write_text(settings_to_toml({"board": DEMO_BOARD}), encoding="utf-8")
        board = read_board(out / "board.toml")
        cameras = calibrate(
            session.take(BOARD), board, CalibrateSettings(), out / "cameras.json", progress=progress
        )
        report = json.loads(report_path(out / "cameras.json").read_text(encoding="utf-8"))
        write_calibration_page(cameras, report, out / "cameras.html")
        for take in faces:
            take.set_cameras(cameras)
    with watch.timing("recon"):
        for take in faces:
            frame = take.frames[0] if take is neutral_take else peak_frame(take)
            reconstruct(take, [frame], ReconSettings(), progress=progress)
    template = _artists_template(out)
    with watch.timing("neutral"):
        neutral = register_neutral(
            neutral_take, template.mesh, NeutralSettings(), out / "neutral.obj", progress=progress
        )
    with watch.timing("track"):
        performances = [
            track(take, neutral, TrackSettings(), progress=progress) for take in expressions
        ]
    with watch.timing("rig"):
        rig = solve_rig(template, performances, RigSettings(), out / "rig", progress=progress)
    with watch.timing("export"):
        _export(out, expressions, settings.rate_hz, progress)
    with watch.timing("report"):
        errors = {
            take.name: take_errors(take, true_array, session.folder / "truth" / slate)
            for slate, take in zip([NEUTRAL, *EXPRESSIONS], faces, strict=True)
        }
        inputs = ReportInputs(
            title=f"likeness demo, {session.name}",
            takes=tuple(TakeInputs(folder=t.folder, errors=errors[t.name]) for t in faces),
            calibration=report_path(out / "cameras.json"),
            rig=out / "rig",
            template=out / "template.npz",
            timings=watch.seconds,
        )
        write_report(inputs, out / "report.html", progress=progress)
        shown = [(take, peak_frame(take)) for take in expressions]
        write_picture(out / "picture.jpg", shown, rig, cameras.names[len(cameras) // 2])
    seconds = {stage: round(spent, 1) for stage, spent in watch.seconds.items()}
    return {
        "report": str(out / "report.html"),
        "seconds": {**seconds, "total": round(sum(watch.seconds.values()), 1)},
        **_summary(errors.values()),
    }


def _artists_template(out: Path) -> Template:
    """The generic head with the artist's shapes, as files an artist would hand over."""
    head = build_actor(None)
    template = Template(
        neutral=head.neutral.vertices,
        deltas=head.deltas,
        names=head.names,
        polygons=head.neutral.polygons,
        rigid_vertices=head.rigid_vertices,
        lid_pairs=head.lid_pairs,
        lip_pairs=head.lip_pairs,
    )
    write_template(out / "template.npz", template)
    write_obj(out / "template.obj", head.neutral)
    return read_template(out / "template.npz")


def _export(out: Path, expressions: Sequence[Take], rate_hz: float, progress: Progress) -> None:
    things = {"rig": out / "rig" / "rig.npz"}
    things |= {
        slate: take.products / "track" / "performance.npz"
        for slate, take in zip(EXPRESSIONS, expressions, strict=True)
    }
    jobs = [(name, kind) for name in things for kind in ("usdc", "glb", "npz")]
    for done, (name, kind) in enumerate(jobs, start=1):
        export(things[name], out / "exports" / f"{name}.{kind}", fps=rate_hz)
        progress(done, len(jobs), "export")


def _summary(errors: Any) -> dict[str, float]:
    found: list[TakeErrors] = list(errors)
    scans = np.concatenate([d for one in found for d in one.scan_mm.values()])
    tracks = np.concatenate([one.track_mm.ravel() for one in found if one.track_mm is not None])
    return {
        "scan_median_mm": round(float(np.median(scans)), 4),
        "track_median_mm": round(float(np.nanmedian(tracks)), 4),
        "track_rmse_mm": round(float(np.sqrt(np.nanmean(tracks**2))), 4),
    }
