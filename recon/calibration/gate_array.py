"""What is wrong with a calibration as a whole: exactness, noise, scale, board, frames, places."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from recon.calibration.gate_levels import (
    BAD,
    WARN,
    Finding,
    GateSettings,
    number_at,
    part_of,
    plural,
    rows_of,
    worse,
)
from recon.calibration.place_words import listed, toward, viewpoint, volume_region

_MOST_NAMED = 6
_SIGNIFICANT = 3.0  # standard errors
_WORST_SHARE = 90.0  # percentile of the uncertainty map above which its worst nodes lie
_LEAST_VISIBLE = 0.25
_TOGETHER = 2  # devices whose whole view is off in one frame: it is the frame


def array_findings(
    report: Mapping[str, Any],
    settings: GateSettings,
    told: frozenset[str] = frozenset(),
    spoiled: bool = False,
) -> list[Finding]:
    """Findings on the whole array, in no special order.

    Args:
        report: of a calibration.
        settings: the levels.
        told: devices whose rejected corners another finding tells of.
        spoiled: whether a grave fault of one of them spoils the solve; poses do not mend that.
    """
    found = [
        _exactness(report, settings, spoiled),
        _settled(report),
        _determined(report, settings),
        _noise(report, settings),
        _rejected(report, settings, told),
        _scale(report, settings),
        _board(report, settings),
        _frames(report, settings),
        _unchecked(report),
    ]
    return [finding for finding in found if finding is not None]


def volume_findings(report: Mapping[str, Any], settings: GateSettings) -> list[Finding]:
    """Where in the face volume the board is missing, one finding a region."""
    volume = part_of(report, "volume")
    found = []
    alone = len(rows_of(report, "devices")) == 1  # then no face is measured
    if not alone and number_at(volume, "visible") < _LEAST_VISIBLE:
        words = (
            f"two devices see {100 * number_at(volume, 'visible'):.0f} % of the face volume only, "
            f"a ball of {number_at(volume, 'radius_mm'):.0f} mm about the point the array looks "
            "at: set volume_mm to the size of what it looks at"
        )
        found.append(Finding(level=WARN, rank=4, words=words))
    poses = rows_of(volume, "thin_poses")
    level = BAD if number_at(volume, "shown") < settings.usable_shown else WARN
    for index, words in enumerate(rows_of(volume, "thin")):
        more = int(poses[index]) if index < len(poses) else 2
        told = f"{words} in {plural(more, 'more pose')}"
        found.append(Finding(level=level, rank=3, words=told, more_poses=more))
    return found


def _exactness(report: Mapping[str, Any], settings: GateSettings, spoiled: bool) -> Finding | None:
    """Uncertainty over the volume, split halves and held-out poses: all say how exact it is."""
    pixel_mm = number_at(report, "volume", "pixel_mm")
    good, usable = settings.volume_levels_um(pixel_mm)
    rms = number_at(report, "uncertainty", "rms_um")
    split = number_at(report, "split_half", "p95_px")
    ratio = number_at(report, "held_out", "ratio")
    levels = [
        settings.level(rms, good, usable),
        settings.level(split, settings.good_split_px, settings.usable_split_px),
        settings.level(ratio, settings.good_ratio, settings.usable_ratio),
    ]
    worst = worse(levels)
    if worst is None:
        return None
    poses = number_at(report, "poses_used")
    calm = settings.noise_excess(number_at(report, "robust_sigma_px"))
    words, more = [], 0
    if levels[0]:
        more = max(more, settings.poses_needed(poses, rms / calm, good))
        words.append(
            f"the calibration alone leaves {rms:.3g} um of error over the face volume"
            f"{_worst_place(report)} ({good:.2g} um is good with these lenses, {usable:.2g} um "
            "usable)"
        )
    if levels[1]:
        more = max(more, settings.poses_needed(poses, split / calm, settings.good_split_px))
        words.append(
            f"solves from either half of the poses differ by {split:.2f} px "
            f"({settings.good_split_px:g} px is good)"
        )
    if levels[2]:
        more = max(more, settings.usable_views if worst == WARN else settings.good_views)
        words.append(
            f"poses left out of the solve fit {ratio:.2f} times worse than those in it "
            f"({settings.good_ratio:g} is good)"
        )
    advice = f"about {plural(more, 'more pose')}, tilted every way, all over the volume"
    if spoiled:
        advice, more = "mend the devices that do not fit first, then calibrate again", 0
    elif not more:
        advice = "the noise of the corners explains it; see there"
    return Finding(level=worst, rank=1, words=f"{listed(words)}: {advice}", more_poses=more or None)


def _worst_place(report: Mapping[str, Any]) -> str:
    """Where the map of uncertainty is worst, when that is on one side."""
    grid = part_of(report, "uncertainty")
    shape, values = rows_of(grid, "shape"), rows_of(grid, "calibration_um")
    if len(shape) != 3 or math.prod(int(size) for size in shape) != len(values):
        return ""
    known = np.array([math.nan if value is None else float(value) for value in values])
    nx, ny, nz = (int(size) for size in shape)
    z, y, x = np.meshgrid(*(np.linspace(-1, 1, size) for size in (nz, ny, nx)), indexing="ij")
    places = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
    with np.errstate(invalid="ignore"):
        worst = known >= np.nanpercentile(known, _WORST_SHARE)
    signs = toward(places[worst].mean(axis=0))
    return f", most in {volume_region(signs)}{viewpoint(signs)}" if any(signs) else ""


def _settled(report: Mapping[str, Any]) -> Finding | None:
    if report.get("converged", True):
        return None
    words = "the solve stopped before it settled: these cameras are not its answer"
    return Finding(level=BAD, rank=0, words=words)


def _determined(report: Mapping[str, Any], settings: GateSettings) -> Finding | None:
    """That the covariance of the whole array is not known."""
    rows = rows_of(report, "devices")
    if not rows or any(math.isfinite(number_at(row, "fx_sigma_px")) for row in rows):
        return None
    words = (
        "these poses do not determine lenses and places, or how well could not be computed: "
        f"{settings.usable_views} more poses or more, each showing most of the board"
        + (" to two devices at least" if len(rows) > 1 else "")
    )
    return Finding(level=BAD, rank=1, words=words, more_poses=settings.usable_views)


def _noise(report: Mapping[str, Any], settings: GateSettings) -> Finding | None:
    noise = number_at(report, "robust_sigma_px")
    level = settings.level(noise, settings.good_noise_px, settings.usable_noise_px)
    if level is None:
        return None
    words = (
        f"corners scatter by {noise:.2f} px ({settings.good_noise_px:g} px is good): more light or "
        "a shorter exposure, sharp lenses, and the board held still at each place"
    )
    return Finding(level=level, rank=1, words=words)


def _rejected(
    report: Mapping[str, Any], settings: GateSettings, told: frozenset[str]
) -> Finding | None:
    """Corners dropped by devices that are not told of by themselves."""
    rest = [row for row in rows_of(report, "devices") if row["name"] not in told]
    dropped = sum(int(row["corners_rejected"]) for row in rest)
    total = dropped + sum(int(row["corners_used"]) for row in rest)
    share = dropped / max(total, 1)
    level = settings.level(share, settings.good_rejected, settings.usable_rejected)
    if level is None:
        return None
    words = (
        f"{dropped} of {total} corners disagree with the rest and were dropped: was the board "
        "moving fast, bending, or reflecting light?"
    )
    return Finding(level=level, rank=1, words=words)


def _scale(report: Mapping[str, Any], settings: GateSettings) -> Finding | None:
    ratio = number_at(report, "scale_bar", "ratio")
    length = number_at(report, "scale_bar", "length_mm")
    error = number_at(report, "scale_bar", "sigma_mm") / length
    if not math.isfinite(ratio) or not ratio > 0:
        return None
    off = abs(ratio - 1.0)
    level = settings.level(off, settings.good_scale, settings.usable_scale)
    if level is None or off <= _SIGNIFICANT * error:
        return None
    frames = int(number_at(report, "scale_bar", "frames"))
    words = (
        f"the scale bar measures {number_at(report, 'scale_bar', 'measured_mm'):.2f} mm in "
        f"{plural(frames, 'frame')} where its file says {length:.2f} mm: every length is wrong by "
        f"{100 * off:.2g} % unless the bar is; measure the squares of the board again (they would "
        f"be {1.0 / ratio:.4f} times what the board file says) and the bar"
    )
    return Finding(level=level, rank=0, words=words)


def _board(report: Mapping[str, Any], settings: GateSettings) -> Finding | None:
    board = part_of(report, "board")
    faces = rows_of(board, "faces") or [board]
    words = []
    for face in faces:
        name = "the board" if len(faces) == 1 else f"board {face.get('name')}"
        bow, ratio = number_at(face, "bow_mm"), number_at(face, "width_over_height")
        if bow > settings.bow_mm:
            words.append(
                f"{name} is bent by {bow:.1f} mm and may bend further while it is waved: mount it "
                "on a stiff plate"
            )
        if abs(ratio - 1.0) > settings.stretch:
            words.append(
                f"the squares of {name} are {ratio:.4f} times as wide as high: measure both ways"
            )
        astray = number_at(face, "in_plane_rms_mm")
        if astray > settings.astray_mm:
            words.append(
                f"the corners of {name} lie {astray:.2f} mm (rms) beside the places that its file "
                "gives them: is it the file of this board?"
            )
    if board.get("shape_solved") is False:
        words.append(
            "the shape of the board was not solved for, so that a bent one would not show: let it "
            "be solved, or be sure of a plate flat to 0.02 mm"
        )
    if not words:
        return None
    return Finding(level=WARN, rank=4, words="; ".join(words[:_MOST_NAMED]))


def _frames(report: Mapping[str, Any], settings: GateSettings) -> Finding | None:
    poses = rows_of(report, "poses")
    sizes = np.array([number_at(pose, "mean_reprojection_px") for pose in poses])
    if not np.isfinite(sizes).any():
        return None
    usual = float(np.nanmedian(sizes))
    together = {
        row["frame"]
        for row in rows_of(part_of(report, "rejected"), "frames")
        if row["whole_views"] >= _TOGETHER
    }
    if len(together) <= settings.good_rejected * len(poses):
        together = set()  # dropped, and few
    odd = [
        str(pose["frame"])
        for pose, size in zip(poses, sizes.tolist(), strict=True)
        if size > settings.odd_one * usual or pose["frame"] in together
    ]
    if not odd:
        return None
    words = (
        f"{'frame' if len(odd) == 1 else 'frames'} {listed(odd, _MOST_NAMED)}: the corners fit "
        f"more than {settings.odd_one:g} times worse than usual, or not at all: the board moved "
        "during the exposure, or the devices were not together"
    )
    return Finding(level=WARN, rank=2, words=words)


def _unchecked(report: Mapping[str, Any]) -> Finding | None:
    """What would prove the calibration and was not determined."""
    missing = []
    if not math.isfinite(number_at(report, "uncertainty", "rms_um")):
        missing.append("the error over the face volume")
    for key, value, name in (
        ("held_out", "ratio", "held-out poses"),
        ("split_half", "p95_px", "solves from either half of the poses"),
    ):
        if not math.isfinite(number_at(report, key, value)):
            remark = part_of(report, key).get("remark")
            missing.append(f"{name} ({remark})" if remark else name)
    if not missing:
        return None
    words = f"not checked: {listed(missing)}; so this calibration is not proved to be good"
    return Finding(level=WARN, rank=4, words=words)
