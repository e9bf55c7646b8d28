"""Why a tracked frame is doubtful, in words: which skin, which views, and what is wrong with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from capture.arrays import Bools, Floats, Floats32
from capture.camera import Camera
from track.evidence import FrameEvidence
from track.quality_regions import FaceRegions

_FELL = 0.06  # of a view's mean correlation below its own median: it shows something else
_ALL_VIEWS = 0.7  # share of the views whose correlation fell when the frame itself is at fault
_APART = 0.25  # share of a view's matches that agree, below what is usual in the take
_BLIND = 0.05  # share of a view's samples that match at all, below which it shows no skin
_TOLD_MM = 0.5  # regions likely to be off by less are not spoken of
_REGIONS = 3
_NAMED = 4  # views that are listed by name
_LAG_FRAMES = 0.3
_SLOW_PX = 0.3  # skin that moves less a frame tells nothing of lateness


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewHabits:
    """What is usual of each of C views over a take, and how late it is.

    Attributes:
        names: of the views.
        correlation: (C,) median over frames of its mean NCC; NaN of a view without frames.
        agreed: (C,) median share of its believed matches that agree with the others.
        lag_frames: (C,) how many frames its pictures are behind the others', told from the side
            to which its matches fall; a lower bound, as matches are believed within a few pixels
            only. NaN where the skin hardly moves.
    """

    names: tuple[str, ...]
    correlation: Floats
    agreed: Floats
    lag_frames: Floats


def view_habits(
    cameras: Sequence[Camera], vertices: Floats32, evidence: Sequence[FrameEvidence]
) -> ViewHabits:
    """Learn what is usual of each view, to tell what is not.

    Args:
        cameras: C views, in the order of the evidence.
        vertices: (F, V, 3) the tracked take.
        evidence: of the F frames.
    """
    correlation = np.stack([told.view_correlation for told in evidence]).astype(np.float64)
    agreed = np.stack([_agreed(told) for told in evidence])
    lags = [_lag(camera, place, vertices, evidence) for place, camera in enumerate(cameras)]
    return ViewHabits(
        names=tuple(camera.name for camera in cameras),
        correlation=_median(correlation),
        agreed=_median(agreed),
        lag_frames=np.array(lags),
    )


def frame_words(
    told: FrameEvidence, likely: Floats, seen: Bools, regions: FaceRegions, habits: ViewHabits
) -> list[str]:
    """What is wrong with a frame, the gravest first; empty when nothing stands out.

    Args:
        told: its evidence.
        likely: (V,) mm, likely error.
        seen: (V,) skin that two views see.
        regions: names of the skin.
        habits: what is usual of the views.
    """
    present = told.view_seen > 0
    if not present.any() or not (told.views > 0).any():
        return ["nothing was measured: the mesh is where the frames before lead"]
    words = _whole_frame(told, habits, present)
    words += _region_words(told, likely, seen, regions)
    words += _view_words(told, habits, present)
    return words


def take_words(habits: ViewHabits) -> list[str]:
    """What is wrong with views throughout a take."""
    usual = float(np.nanmedian(habits.agreed)) if np.isfinite(habits.agreed).any() else 1.0
    words = []
    for name, agreed, lag in zip(habits.names, habits.agreed, habits.lag_frames, strict=True):
        if np.isfinite(lag) and abs(lag) > _LAG_FRAMES and agreed < usual - 0.5 * _APART:
            when = "late" if lag > 0 else "early"
            words.append(f"{name} is {when} against the others, by {abs(lag):.1f} frames or more")
        elif np.isfinite(agreed) and agreed < usual - _APART:
            words.append(
                f"{name} disagrees with the others: {_percent(agreed)} of its matches fit theirs, "
                f"usual are {_percent(usual)}"
            )
    return words


def _whole_frame(told: FrameEvidence, habits: ViewHabits, present: Bools) -> list[str]:
    words = []
    if not present.all():
        words.append(f"{_listed(habits.names, ~present)} missing")
    blind = _blind(told)
    if blind.any():
        words.append(f"no skin that matches in {_listed(habits.names, blind)}")
    usable = present & ~blind
    fell = habits.correlation - told.view_correlation > _FELL
    if usable.any() and fell[usable].mean() >= _ALL_VIEWS:
        now = float(np.nanmedian(told.view_correlation[usable]))
        usual = float(np.nanmedian(habits.correlation[usable]))
        words.append(
            f"blurred or dim: correlation fell in all views ({now:.2f}, usual {usual:.2f})"
        )
    return words


def _region_words(
    told: FrameEvidence, likely: Floats, seen: Bools, regions: FaceRegions
) -> list[str]:
    words = []
    for name, size in regions.worst(likely, seen)[:_REGIONS]:
        if size < _TOLD_MM:
            break
        own = seen & (regions.of_vertex == regions.names.index(name))
        own &= likely >= np.quantile(likely[own], 0.75)
        words.append(f"{name}: a quarter likely off by {size:.1f} mm; {_reason(told, own)}")
    return words


def _reason(told: FrameEvidence, own: Bools) -> str:
    views, able = float(told.views[own].mean()), float(told.views_open[own].mean())
    if views < 1.5:
        return f"no two of the {able:.0f} views that see it agree"
    if views < 0.5 * able:
        return f"few views agree ({views:.0f} of {able:.0f})"
    moved = _mean(told.motion_mm[own])
    if moved > 0.3:
        return f"still moving by {moved:.1f} mm in the last round"
    away = _mean(told.misfit_mm[own])
    if away > 0.3:
        return f"matches leave the smooth surface by {away:.1f} mm"
    score = _mean(told.correlation[own])
    if score < 0.85:
        return f"it looks unlike the reference (correlation {score:.2f})"
    return "its place is weakly measured"


def _view_words(told: FrameEvidence, habits: ViewHabits, present: Bools) -> list[str]:
    share = _agreed(told)
    usable = present & ~_blind(told) & np.isfinite(share)
    if usable.sum() < 3:
        return []
    usual = float(np.median(share[usable]))
    words = []
    for place in np.flatnonzero(usable & (share < usual - _APART)):
        late = np.isfinite(habits.lag_frames[place]) and habits.lag_frames[place] > _LAG_FRAMES
        words.append(
            f"{habits.names[place]} disagrees with the others ({_percent(share[place])} of its "
            f"matches fit theirs){': a frame late?' if late else ''}"
        )
    return words


def _agreed(told: FrameEvidence) -> Floats:
    """Share (C,) of each view's believed matches that agree with the others; NaN of hardly any."""
    believed = told.view_believed.astype(np.float64)
    gap = np.full(len(believed), np.nan)
    enough = (believed > 0) & ~_blind(told)
    share: Floats = np.divide(told.view_agreed, believed, out=gap, where=enough)
    return share


def _blind(told: FrameEvidence) -> Bools:
    """Views (C,) that have the frame and yet match next to nothing."""
    blind: Bools = (told.view_seen > 0) & (told.view_believed < _BLIND * told.view_seen)
    return blind


def _lag(
    camera: Camera, place: int, vertices: Floats32, evidence: Sequence[FrameEvidence]
) -> float:
    """Frames by which one view is late: its matches fall back along the skin's motion."""
    along = square = 0.0
    for row in range(1, len(evidence)):
        told = evidence[row]
        offset = told.view_offset_px[place].astype(np.float64)
        skin = told.views > 0
        if not np.isfinite(offset).all() or not skin.any():
            continue
        now, before = vertices[row][skin], vertices[row - 1][skin]
        moved = camera.project(now.astype(np.float64)) - camera.project(before.astype(np.float64))
        step = np.nanmedian(moved, axis=0)
        if float(np.linalg.norm(step)) < _SLOW_PX:
            continue
        weight = float(told.view_believed[place]) / max(float(told.view_seen[place]), 1.0)
        along -= weight * float(offset @ step)
        square += weight * float(step @ step)
    return along / square if square > 0 else float("nan")


def _median(values: Floats) -> Floats:
    """Median (C,) over frames (F, C) of what is known; NaN where nothing is."""
    out = np.full(values.shape[1], np.nan)
    for column in range(values.shape[1]):
        known = values[np.isfinite(values[:, column]), column]
        if len(known):
            out[column] = np.median(known)
    return out


def _mean(values: Floats32) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else 0.0


def _listed(names: Sequence[str], chosen: Bools) -> str:
    """Views by name, or how many when they are too many to read."""
    picked = [name for name, wanted in zip(names, chosen, strict=True) if wanted]
    if len(picked) > _NAMED:
        return f"{len(picked)} of {len(names)} views"
    return ", ".join(picked)


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"
