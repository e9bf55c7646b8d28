"""The rig stage: template and tracked performances in, the actor's own rig out."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.arrays import Bools, Floats
from capture.errors import InputError, raise_all
from capture.product import is_current, stage_record, write_record
from capture.progress import Progress, silent
from capture.settings import check_ranges
from rig.face_rig import FaceRig, read_rig, write_rig
from rig.neutral_frame import approximate_neutral, choose_neutral_frame
from rig.report import describe_solve, write_report
from rig.solve import (
    Fit,
    Observations,
    Schedule,
    personalise,
    pose_frames,
    weighted_rms,
)
from rig.template import Template
from rig.update import UpdatePriors
from rig.weight_table import WeightTable
from rig.weights import WeightPriors
from track.performance import Performance


@dataclass(frozen=True, kw_only=True)
class RigSettings:
    """Settings of the rig stage.

    Attributes:
        iterations: most turns of weights and shapes.
        relative_change: of the total energy, below which the turns end.
        sparsity_mm2: strength of (sum of a frame's weights)^2, as mean squared mm.
        smoothness: strength of the change of a weight between contiguous frames, as a fraction of
            its shape's mean squared displacement; 0 turns it off.
        evidence: share of a frame's mean squared residual that a shape must explain to be active.
        debias: undo the shrinking that sparsity causes, keeping its choice of shapes.
        variation: expected departure of the actor's shapes from the transferred ones, as a share of
            their own displacement.
        gradient_mm2: strength of the shapes' deformation gradients against the template's.
        offset: strength of the shapes' displacements against the template's.
        neutral_offset: strength of the neutral against the chosen frame.
        mask_tolerance: of a shape's extent, below which a vertex that the template holds still
            stays still.
        neutral_frame: which frame shows the neutral, counted over all performances; -1 chooses.
    """

    iterations: int = 5
    relative_change: float = 0.01
    sparsity_mm2: float = 0.01
    smoothness: float = 0.002
    evidence: float = 0.2
    debias: bool = True
    variation: float = 0.2
    gradient_mm2: float = 1.0
    offset: float = 0.05
    neutral_offset: float = 0.05
    mask_tolerance: float = 1e-3
    neutral_frame: int = -1

    def __post_init__(self) -> None:
        check_ranges(
            "rig", self, iterations=(1, 100), relative_change=(0.0, 1.0), sparsity_mm2=(0.0, 1e3),
            smoothness=(0.0, 1e3), evidence=(0.0, 1.0), variation=(1e-3, 1e3),
            gradient_mm2=(0.0, 1e6), offset=(1e-6, 1e6), neutral_offset=(1e-6, 1e6),
            mask_tolerance=(0.0, 0.5), neutral_frame=(-1, 1_000_000),
        )  # fmt: skip

    def schedule(self) -> Schedule:
        """The same settings as the solver takes them."""
        return Schedule(
            iterations=self.iterations,
            relative_change=self.relative_change,
            mask_tolerance=self.mask_tolerance,
            variation=self.variation,
            weights=WeightPriors(
                sparsity_mm2=self.sparsity_mm2,
                smoothness=self.smoothness,
                evidence=self.evidence,
                debias=self.debias,
            ),
            update=UpdatePriors(
                gradient_mm2=self.gradient_mm2,
                offset=self.offset,
                neutral_offset=self.neutral_offset,
            ),
        )


def solve_rig(
    template: Template,
    performances: Sequence[Performance],
    settings: RigSettings,
    out: Path,
    *,
    weights: WeightTable | None = None,
    progress: Progress = silent,
) -> FaceRig:
    """Personalise a template to the performances of one actor: OUT/rig.npz and OUT/report.json.

    Args:
        template: the artist's rig, mm.
        performances: tracked takes of one actor in the template's vertex order, world mm.
        settings: strengths and when to stop.
        out: folder to write in.
        weights: where they are known beforehand, one row a frame of all performances in order.
        progress: told after each turn.

    Returns:
        the rig in the template's space; shapes that move nothing are kept as zeros, with weight 0.

    Raises:
        InputError: when vertex counts, frame counts or shape names do not fit, or no vertex of
            any frame has confidence.

    References:
        Ma et al. 2016, Semantically-aware blendshape rigs from facial performance measurements.
    """
    started = time.monotonic()
    check_match(template, performances)
    known = _known_weights(template, performances, weights)
    product = Path(out) / "rig.npz"
    record = stage_record("rig", settings, _hashes(template, performances, known))
    if is_current(product, record) and (Path(out) / "report.json").exists():
        progress(1, 1, "rig")
        return read_rig(product)
    moving = template.moves()
    solvable = _with_shapes(template, moving)
    seen = observe(performances, None if known is None else known[:, moving])
    frame = _neutral_frame(solvable, seen, settings.neutral_frame)
    neutral = approximate_neutral(solvable, seen.points[frame], seen.confidence[frame])
    first, fit, turns = personalise(solvable, neutral, seen, settings.schedule(), progress)
    report = describe_solve(template, moving, seen, (first, fit), turns)
    report |= {"neutral_frame": frame, "seconds": round(time.monotonic() - started, 3)}
    report["best_fit"] = _best_fit(seen, first, fit)
    report["topology_matches"] = _same_topology(template, performances)
    write_report(Path(out) / "report.json", report)
    write_rig(product, _whole_rig(template, moving, fit))
    write_record(product, record)
    return read_rig(product)  # as a second run finds it


def check_match(
    template: Template,
    performances: Sequence[Performance],
    names: Sequence[str] = (),
) -> None:
    """Refuse performances that are not in the template's vertex order.

    Args:
        template: the artist's rig.
        performances: tracked takes.
        names: what to call each performance (its file); "performance 1" and so on when empty.

    Raises:
        InputError: giving both vertex counts, for every performance that does not fit.
    """
    if not performances:
        raise InputError("rig: needs at least one performance, found none")
    called = list(names) or [f"performance {i + 1}" for i in range(len(performances))]
    wanted = len(template.neutral)
    problems = [
        f"template has {wanted} vertices, {name} {performance.vertices.shape[1]}: both must be in "
        f"one topology; make the template from the mesh that was tracked"
        for name, performance in zip(called, performances, strict=True)
        if performance.vertices.shape[1] != wanted
    ]
    raise_all("rig", problems)
    if not any((p.confidence > 0).any() for p in performances):
        raise InputError("rig: no vertex of any frame has confidence above 0: nothing to fit")
    if not template.moves().any():
        raise InputError("rig: no shape of the template moves any vertex: nothing to personalise")


def observe(performances: Sequence[Performance], known: Floats | None = None) -> Observations:
    """All frames of all performances, one after the other; contiguity ends at each boundary."""
    points = np.concatenate([p.vertices for p in performances]).astype(np.float64)
    confidence = np.concatenate([p.confidence for p in performances]).astype(np.float64)
    confidence = np.clip(confidence, 0.0, 1.0)
    unfit = ~np.isfinite(points).all(axis=2)
    confidence[unfit] = 0.0
    points[confidence <= 0.0] = 0.0
    contiguous = np.concatenate(
        [np.concatenate([[False], np.diff(p.frames) == 1])[: len(p.frames)] for p in performances]
    )
    return Observations(points, confidence, contiguous, known)


def _known_weights(
    template: Template, performances: Sequence[Performance], weights: WeightTable | None
) -> Floats | None:
    if weights is None:
        return None
    frames = sum(len(p.frames) for p in performances)
    if len(weights.weights) != frames:
        raise InputError(
            f"weights: {len(weights.weights)} rows for {frames} frames of "
            f"{len(performances)} performances; one row a frame, in order"
        )
    found: Floats = weights.columns(template.names)
    if found.min(initial=0.0) < 0.0 or found.max(initial=0.0) > 1.0:
        raise InputError(f"weights: must lie in 0..1, found {found.min():.4g}..{found.max():.4g}")
    return found


def _neutral_frame(template: Template, seen: Observations, asked: int) -> int:
    if asked < 0:
        return choose_neutral_frame(template, seen.points, seen.confidence)
    if asked >= len(seen.points):
        raise InputError(
            f"neutral_frame {asked}: the performances hold frames 0..{len(seen.points) - 1}"
        )
    if not (seen.confidence[asked] > 0).any():
        raise InputError(f"neutral_frame {asked}: no vertex of that frame has confidence above 0")
    return asked


def _best_fit(seen: Observations, *fits: Fit) -> dict[str, float]:
    """Residuals with no prior on the weights: what each set of shapes can reach at best."""
    free = WeightPriors(sparsity_mm2=0.0, evidence=0.0, smoothness=0.0, debias=False)
    reached = []
    for fit in fits:
        posed = pose_frames(fit.neutral, fit.deltas, seen, free, fit.weights)
        reached.append(weighted_rms(posed.residuals(seen.points), seen.confidence))
    before, after = reached
    return {
        "residual_transferred_mm": before,
        "residual_refined_mm": after,
        "ratio": after / before if before > 0 else 0.0,
    }


def _with_shapes(template: Template, kept: Bools) -> Template:
    return Template(
        neutral=template.neutral,
        deltas=template.deltas[kept],
        names=tuple(name for name, keep in zip(template.names, kept, strict=True) if keep),
        polygons=template.polygons,
        rigid_vertices=template.rigid_vertices,
        lid_pairs=template.lid_pairs,
        lip_pairs=template.lip_pairs,
    )


def _whole_rig(template: Template, moving: Bools, fit: Fit) -> FaceRig:
    deltas = np.zeros(template.deltas.shape)
    deltas[moving] = fit.deltas
    weights = np.zeros((len(fit.weights), len(template.names)))
    weights[:, moving] = fit.weights
    return FaceRig(
        neutral=fit.neutral,
        deltas=deltas,
        names=template.names,
        polygons=template.polygons,
        weights=weights,
        head_from_rig=fit.motions,
    )


def _same_topology(template: Template, performances: Sequence[Performance]) -> bool:
    own = {frozenset(p) - {-1} for p in template.polygons.tolist()}
    return all({frozenset(q) - {-1} for q in p.polygons.tolist()} == own for p in performances)


def _hashes(
    template: Template, performances: Sequence[Performance], known: Floats | None
) -> dict[str, str]:
    inputs = {
        "template": _digest(
            template.neutral, template.deltas, np.array(template.names, dtype=np.str_),
            template.polygons, template.rigid_vertices, template.lid_pairs, template.lip_pairs,
        )
    }  # fmt: skip
    for number, p in enumerate(performances):
        inputs[f"performance_{number}"] = _digest(p.vertices, p.confidence, p.frames, p.polygons)
    if known is not None:
        inputs["weights"] = _digest(known)
    return inputs


def _digest(*arrays: NDArray[Any]) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
