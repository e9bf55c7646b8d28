"""Fit the error model of tracking on takes with a known truth, and check it on others.

``python -m tools.bench.fit_error_model --fit TAKE=TRUTH.npz ... --check TAKE=TRUTH.npz ...``

A TAKE has cameras.json, neutral.obj and what `likeness track` left in products/track, its finished
frames included; TRUTH.npz holds `vertices` (F, V, 3). Shown are the coefficients, for each group
the reliability table (what was told against what was found), and how well frames are flagged.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from capture.archive import read_archive
from capture.arrays import Bools, Floats, Ints
from capture.camera_file import read_cameras
from recon.mesh import read_obj
from track.error_model import (
    FITTED,
    TERMS,
    ErrorModel,
    SkinGraph,
    Terms,
    combined,
    error_terms,
    frame_error,
)
from track.evidence import EVIDENCE_KEYS, FrameEvidence
from track.performance import read_performance
from track.quality import stilled
from track.quality_regions import face_regions
from track.quality_report import FLAG_MM, mm_per_pixel

_SEED = 7
_MOST = 80_000  # vertices that the fit looks at
_LEAST_MM = 0.003  # errors below this are alike: the truth itself is stored in float32
_HUBER = 1.0  # in the logarithm: beyond a factor of e a vertex pulls no harder
_BINS = (0.0, 0.03, 0.06, 0.12, 0.25, 0.5, 1.0, 2.0, 4.0, np.inf)
_SEEN_VIEWS = 1.5


@dataclass(frozen=True, eq=False, kw_only=True)
class Sample:
    """One frame with its truth: terms, error (V,) mm, seen skin (V,)."""

    take: str
    frame: int
    terms: Terms
    error_mm: Floats
    seen: Bools

    @property
    def worst_mm(self) -> float:
        """The true 95th percentile over seen skin."""
        return float(np.percentile(self.error_mm[self.seen], 95))


@dataclass(frozen=True, kw_only=True)
class FlagCount:
    """Frames that are bad, that are flagged, and both."""

    bad: int
    flagged: int
    both: int

    @property
    def recall(self) -> float:
        """Share of the bad frames that are flagged; NaN without any."""
        return self.both / self.bad if self.bad else float("nan")

    @property
    def precision(self) -> float:
        """Share of the flagged frames that are bad; NaN without any."""
        return self.both / self.flagged if self.flagged else float("nan")


def read_samples(take: Path, truth: Path) -> list[Sample]:
    """Every frame but the first of a tracked take, with its truth."""
    performance = read_performance(take / "products" / "track" / "performance.npz")
    neutral = read_obj(take / "neutral.obj")
    scale = mm_per_pixel(list(read_cameras(take / "cameras.json")), neutral)
    true = read_archive(truth, required=("vertices",))["vertices"].astype(np.float64)
    still = stilled(performance)
    graph = SkinGraph(neutral.vertices, neutral.triangles)
    shown = face_regions(neutral.vertices, performance.confidence[0] > 0.0).face
    out = []
    for row in range(1, len(still)):
        number = int(performance.frames[row])
        path = take / "products" / "track" / "frames" / f"frame_{number:04d}.npz"
        held = read_archive(path, required=EVIDENCE_KEYS, gaps=EVIDENCE_KEYS)
        told = FrameEvidence(**{key: held[key] for key in EVIDENCE_KEYS})
        deformed = np.linalg.norm(still[row] - still[0], axis=1).astype(np.float64)
        error = np.linalg.norm(performance.vertices[row] - true[row], axis=1)
        seen = (told.views_open >= _SEEN_VIEWS) & (performance.confidence[0] > 0.0)
        if not seen.any():
            seen = performance.confidence[0] > 0.0
        seen &= shown
        out.append(
            Sample(
                take=take.name,
                frame=number,
                terms=error_terms(graph, told, deformed, scale),
                error_mm=error,
                seen=seen,
            )
        )
    return out


def fit(samples: Sequence[Sample]) -> ErrorModel:
    """Shares of the terms under which the logarithm of the error scatters least, robustly.

    All vertices count, hidden ones too. Evidence of every size counts alike, however rare it is:
    a vertex weighs as the inverse root of how many have terms of about its size. Weights by the
    errors themselves would draw the rare ones apart from what told them.
    """
    terms = np.concatenate([sample.terms.mm for sample in samples], axis=1)
    moved = np.concatenate([np.full_like(s.error_mm, s.terms.unsettled_mm) for s in samples])
    error = np.concatenate([sample.error_mm for sample in samples])
    pick = np.random.default_rng(_SEED).permutation(len(error))[:_MOST]
    square, goal = terms[:, pick] ** 2, np.log(np.maximum(error[pick], _LEAST_MM))
    moved, weight = moved[pick], _even(0.5 * np.log(square.sum(axis=0) + _LEAST_MM**2))

    def cost(logs: Floats) -> tuple[float, Floats]:
        share, haste = np.exp(2.0 * logs[:-1]), float(np.exp(logs[-1]))
        total, factor = share @ square + 1e-9, 1.0 + haste * moved
        miss = 0.5 * np.log(total) + np.log(factor) - goal
        inside = np.abs(miss) < _HUBER
        loss = np.where(inside, 0.5 * miss**2, _HUBER * (np.abs(miss) - 0.5 * _HUBER))
        pull = weight * np.clip(miss, -_HUBER, _HUBER)
        slopes = np.append((square @ (pull / total)) * share, (pull * haste * moved / factor).sum())
        return float((weight * loss).sum()), slopes

    start = np.full(len(TERMS) + 1, np.log(0.2))
    bounds = [(np.log(1e-4), np.log(10.0))] * len(start)
    found = minimize(
        cost, start, jac=True, method="L-BFGS-B", bounds=bounds,
        options={"maxiter": 2000, "ftol": 1e-12, "gtol": 1e-9},
    )  # fmt: skip
    *shares, haste = (float(np.round(value, 4)) for value in np.exp(found.x))
    trial = ErrorModel(shares=tuple(shares), haste=haste, spread=1.0)
    told = np.concatenate([combined(sample.terms, trial) for sample in samples])[pick]
    low, high = np.percentile(goal - np.log(np.maximum(told, 1e-4)), [16.0, 84.0])
    return ErrorModel(
        shares=trial.shares, haste=haste, spread=float(np.round(0.5 * (high - low), 3))
    )


def flag_count(samples: Sequence[Sample], model: ErrorModel, limit_mm: float) -> FlagCount:
    """How many frames are bad (truly worse than 1 mm), flagged by the model, and both."""
    bad = np.array([sample.worst_mm > 1.0 for sample in samples])
    told = np.array([told_mm(sample, model) > limit_mm for sample in samples])
    return FlagCount(bad=int(bad.sum()), flagged=int(told.sum()), both=int((bad & told).sum()))


def told_mm(sample: Sample, model: ErrorModel) -> float:
    """What the model tells of a frame: the 95th percentile over its seen skin."""
    return frame_error(combined(sample.terms, model)[sample.seen], model)


def reliability(samples: Sequence[Sample], model: ErrorModel) -> list[tuple[float, ...]]:
    """By likely error: count, median told, and the 16th, 50th, 84th, 95th percentile found."""
    told = np.concatenate([combined(s.terms, model)[s.seen] for s in samples])
    found = np.concatenate([s.error_mm[s.seen] for s in samples])
    place: Ints = np.digitize(told, _BINS) - 1
    rows = []
    for k in range(len(_BINS) - 1):
        own = place == k
        if own.sum() >= 20:
            quantiles = np.percentile(found[own], [16, 50, 84, 95]).tolist()
            rows.append((float(own.sum()), float(np.median(told[own])), *quantiles))
    return rows


def _even(size: Floats) -> Floats:
    """Weights (N,) with sum 1 of vertices whose terms have these sizes, logarithmic."""
    count, edges = np.histogram(size, bins=24)
    place = np.clip(np.digitize(size, edges) - 1, 0, len(count) - 1)
    weight: Floats = 1.0 / np.sqrt(np.maximum(count[place], 1))
    even: Floats = weight / weight.sum()
    return even


def _show(title: str, samples: Sequence[Sample], model: ErrorModel) -> None:
    if not samples:
        return
    print(f"\n{title}: {len(samples)} frames of {len({s.take for s in samples})} takes")
    print("  vertices  told mm | found mm: 16 %   50 %   84 %   95 %")
    for count, told, *found in reliability(samples, model):
        print(f"  {count:8.0f} {told:8.3f} |       " + " ".join(f"{q:6.3f}" for q in found))
    for limit in sorted({0.5, 0.6, FLAG_MM, 0.8, 1.0, 1.2}):
        c = flag_count(samples, model, limit)
        print(
            f"  flag above {limit} mm: {c.bad} bad, {c.flagged} flagged, "
            f"recall {c.recall:.2f}, precision {c.precision:.2f}"
        )
    pairs = [(s.worst_mm, told_mm(s, model), s) for s in samples]
    ratio = np.log([told / max(true, 1e-3) for true, told, _ in pairs])
    print(f"  frames, told over true p95: median {np.exp(np.median(ratio)):.2f}, "
          f"scatter x{np.exp(np.std(ratio)):.2f}")  # fmt: skip
    for true, told, s in pairs:
        wrong = (true > 1.0) != (told > FLAG_MM)
        print(f"    {s.take} {s.frame}: p95 {true:.2f}, told {told:.2f}{' <--' if wrong else ''}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Fit, check, and print."""
    parser = argparse.ArgumentParser(prog="fit_error_model")
    parser.add_argument("--fit", nargs="*", default=[], metavar="TAKE=TRUTH")
    parser.add_argument("--check", nargs="*", default=[], metavar="TAKE=TRUTH")
    options = parser.parse_args(arguments)
    groups = {}
    for name in ("fit", "check"):
        pairs = [entry.rpartition("=") for entry in getattr(options, name)]
        groups[name] = [
            s for take, _, truth in pairs for s in read_samples(Path(take), Path(truth))
        ]
    model = fit(groups["fit"]) if groups["fit"] else FITTED
    print(f"spread {model.spread}, haste {model.haste}")
    for term, share in zip(TERMS, model.shares, strict=True):
        print(f"  {term:15s} {share:.4f}")
    print("shares=(" + ", ".join(f"{share:g}" for share in model.shares) + ")")
    _show("fitted on", groups["fit"], model)
    _show("held out", groups["check"], model)
    return 0


if __name__ == "__main__":
    sys.exit(main())
