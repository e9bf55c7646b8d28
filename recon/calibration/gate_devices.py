"""What is wrong with single devices of a calibration: faults, and poses they lack, and where."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
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
from recon.calibration.place_words import image_regions, listed

_MOST_GROUPS = 5  # findings on lacking poses; more are merged further
_MOST_NAMED = 6
_GAP_POSES = 2  # to fill one part of an image
_LEAST_SHARE = 0.25  # of the poses of a take that a device sees when it sees few
_LEAST_CELL = 20  # corners in a cell of the image whose mean says something
_LEAST_CELLS = 6
_OF_RESIDUAL = 0.7  # a coordinate of a vector over its length: what points the same way leads


@dataclass(frozen=True, kw_only=True)
class _Case:
    """What one device shows: by kind of fact its value, the advice, the poses it lacks."""

    name: str
    level: str
    facts: Mapping[str, float]
    tilts: tuple[str, ...] = ()
    gaps: tuple[tuple[int, ...], ...] = ()
    more: int = 0
    share: float = field(default=1.0, compare=False)


def fault_findings(
    report: Mapping[str, Any], settings: GateSettings
) -> tuple[list[Finding], frozenset[str]]:
    """Devices whose images do not fit the rest, and their names; equal ones in one finding."""
    rows = rows_of(report, "devices")
    usual = _median([number_at(row, "mean_reprojection_px") for row in rows])
    noise = number_at(report, "robust_sigma_px")
    views = part_of(part_of(report, "rejected"), "devices")
    cases = []
    for row in rows:
        facts: dict[str, float] = {}
        levels: list[str | None] = []
        ratio = number_at(row, "mean_reprojection_px") / max(usual, 1e-12)
        if ratio > settings.odd_one:
            facts["residual"] = ratio * usual
            levels.append(settings.level(ratio, settings.odd_one, settings.very_odd))
        total = row["corners_used"] + row["corners_rejected"]
        share = row["corners_rejected"] / max(total, 1)
        if share > settings.good_rejected:
            facts["rejected"] = share
            levels.append(settings.level(share, settings.good_rejected, settings.usable_rejected))
            off = number_at(part_of(views, row["name"]), "median_px")
            if off < settings.slight_px:
                facts["slight"] = off
        same_way = _systematic(row, noise) * noise
        whole = number_at(part_of(views, row["name"]), "whole_views")
        if same_way > settings.systematic * max(noise, _OF_RESIDUAL * ratio * usual):
            facts["systematic"] = same_way
            levels.append(WARN)
        elif facts and whole > settings.good_rejected * row["views"]:
            facts["whole"] = whole
        level = worse(levels)
        if level is not None:
            cases.append(_Case(name=row["name"], level=level, facts=facts))
    groups = _grouped(cases, lambda case: (case.level, frozenset(case.facts)))
    return [_fault(group, usual, settings) for group in groups], frozenset(c.name for c in cases)


def lack_findings(
    report: Mapping[str, Any],
    settings: GateSettings,
    faulty: frozenset[str] = frozenset(),
    spoiled: bool = False,
) -> tuple[list[Finding], int]:
    """Devices that need more poses, and where; and how many poses of a take that makes.

    Args:
        report: of a calibration.
        settings: the levels.
        faulty: devices told of by another finding: of these only few views are told as well.
        spoiled: whether a grave fault of one of them makes the halves of the solve differ anyway.

    Returns:
        Findings, and the lesser of: poses waved as before until the last device has its share, and
        poses aimed at each group of devices in turn. What noisy corners cost is not made up by
        poses: another finding tells of the noise.
    """
    rows = rows_of(report, "devices")
    place = _median([_place_um(row) for row in rows])
    split = part_of(part_of(report, "split_half"), "by_device")
    poses = max(number_at(report, "poses_used"), 1.0)
    calm = settings.noise_excess(number_at(report, "robust_sigma_px"))
    told = any(math.isfinite(number_at(row, "fx_sigma_px")) for row in rows)
    cases = []
    for row in rows:
        apart = math.nan if spoiled else number_at(split, row["name"]) / calm
        case = _lacking(row, place, apart, calm, told, settings)
        if case is not None and (row["name"] not in faulty or "views" in case.facts):
            share = float(np.clip(row["views"] / poses, _LEAST_SHARE, 1.0))
            cases.append(_Case(**{**case.__dict__, "share": share}))
    findings = [_lack(group, len(rows), settings) for group in _few_groups(cases)]
    waved = max((math.ceil(case.more / case.share) for case in cases), default=0)
    aimed = sum(finding.more_poses or 0 for finding in findings)
    return findings, min(waved, aimed, settings.most_poses)


def _lacking(
    row: Mapping[str, Any],
    place: float,
    split: float,
    calm: float,
    told: bool,
    settings: GateSettings,
) -> _Case | None:
    views = int(row["views"])
    facts: dict[str, float] = {}
    levels: list[str | None] = []
    more = [0]
    gaps = tuple(tuple(int(s) for s in gap) for gap in rows_of(row, "image_gaps"))

    def judge(kind: str, value: float, good: float, usable: float) -> None:
        level = settings.level(value, good, usable)
        if level is not None:
            facts[kind] = value
            levels.append(level)
            need = settings.poses_needed(views, value, good)
            more.append(min(need, settings.usable_views) if gaps else need)  # the gap explains it

    if views < settings.good_views:
        facts["views"] = views
        levels.append(BAD if views < settings.usable_views else WARN)
        more.append(settings.good_views - views)
    loose = number_at(row, "fx_sigma_px") / max(number_at(row, "fx_px"), 1e-9) / calm
    judge("focal", loose, settings.good_focal, settings.usable_focal)
    if loose != loose and told:
        facts["undetermined"] = 1.0
        levels.append(BAD)
        more.append(settings.usable_views)
    odd = settings.odd_one + 1.0
    judge("place", _place_um(row) / max(place, 1e-9), odd, math.inf)
    if "place" in facts:
        facts["place"] = _place_um(row)
    judge("split", split, *settings.device_split_px)
    tilts = part_of(row, "tilts_deg")
    tilted = max((number_at(tilts, way) for way in tilts), default=math.nan)
    if tilted < settings.least_tilt_deg:
        facts["tilt"] = tilted
        levels.append(WARN)
        more.append(settings.usable_views // 2)
    if gaps:
        facts["gaps"] = len(gaps)
        levels.append(WARN)
        more.append(_GAP_POSES * len(gaps))
    level = worse(levels)
    if level is None:
        return None
    ways = tuple(str(way) for way in rows_of(row, "tilt_gaps"))
    count = min(max(more), settings.most_poses)
    return _Case(name=row["name"], level=level, facts=facts, tilts=ways, gaps=gaps, more=count)


def _lack(group: Sequence[_Case], devices: int, settings: GateSettings) -> Finding:
    few = any(case.facts.get("views", math.inf) < settings.usable_views for case in group)
    least = f"{settings.good_views} are good"
    least = f"{settings.usable_views} are the least, {least}" if few else least
    words = {
        "views": f"saw the board in {_range(group, 'views', '{:.0f}')} poses only ({least})",
        "undetermined": "the focal length could not be determined",
        "focal": f"focal length known to {_range(group, 'focal', '{:.2g}', 100.0)} % "
        f"({100 * settings.good_focal:g} % is good)",
        "place": f"its place is known to {_range(group, 'place', '{:.2g}')} um only, far worse "
        "than the others'",
        "split": "solves from either half of the poses put it "
        f"{_range(group, 'split', '{:.2f}')} px apart ({settings.device_split_px[0]:g} px is good)",
        "tilt": f"the board was tilted by {_range(group, 'tilt', '{:.0f}')} degrees at most",
    }
    kinds = {kind for case in group for kind in case.facts}
    facts = [text for kind, text in words.items() if kind in kinds]
    low, high = min(case.more for case in group), max(case.more for case in group)
    count = plural(high, "more pose") if low == high else f"{low} to {high} more poses"
    if "tilt" in kinds:
        count += " with the board tilted by 45 degrees, every way"
    else:
        count += _tilt_advice(group)
    count += _gap_advice(group)
    said = f"{listed(facts)}: {count}" if facts else count
    level = worse([case.level for case in group]) or WARN
    return Finding(
        level=level, rank=2, words=f"{_names(group, devices)}: {said}",
        device=group[0].name if len(group) == 1 else None, more_poses=high,
    )  # fmt: skip


def _tilt_advice(group: Sequence[_Case]) -> str:
    ways = group[0].tilts
    if any(case.tilts != ways for case in group):
        return ", tilted the ways each has not seen yet"
    return f" with the board tilted {listed([_WAY[way] for way in ways])}" if ways else ""


def _gap_advice(group: Sequence[_Case]) -> str:
    gaps = group[0].gaps
    if any(case.gaps != gaps for case in group):
        return ", in the parts of each image where the board is missing"
    return f", in {image_regions(gaps)}, where it has not been" if gaps else ""


def _fault(group: Sequence[_Case], usual: float, settings: GateSettings) -> Finding:
    whole = _range(group, "whole", "{:.0f}")
    views = "view does" if whole == "1" else "views do"
    words = {
        "residual": f"residual {_range(group, 'residual', '{:.2f}')} px where {usual:.2f} px is "
        "usual here",
        "rejected": f"{_range(group, 'rejected', '{:.0f}', 100.0)} % of the corners dropped",
        "slight": f"off by {_range(group, 'slight', '{:.1f}')} px",
        "whole": f"{whole} whole {views} not fit the other devices",
        "systematic": f"residuals of {_range(group, 'systematic', '{:.2f}')} px that point the "
        "same way in parts of the image",
    }
    facts = [text for kind, text in words.items() if kind in group[0].facts]
    asked = "is its lens sharp and tight, and nothing before it?"
    if "whole" in group[0].facts:
        asked = "was it triggered with the others, and did it stay in its place?"
    if "slight" in group[0].facts:
        asked = "a board seen at a slant or a little blurred does that: tilt it less, hold it still"
    if "systematic" in group[0].facts:
        asked = "the lens model does not fit; is there glass before it, or did zoom or focus move?"
    return Finding(
        level=group[0].level, rank=0 if group[0].level == BAD else 1,
        words=f"{_names(group, 0)}: {listed(facts)}: {asked}",
        device=group[0].name if len(group) == 1 else None,
    )  # fmt: skip


def _systematic(row: Mapping[str, Any], noise: float) -> float:
    """Root mean square of the cells' mean residuals, less what noise gives, over the noise."""
    heat = part_of(row, "heat")
    counts = np.array(rows_of(row, "coverage"), dtype=np.float64)
    if not heat or not noise > 0:
        return math.nan
    dx, dy = (
        np.array([[math.nan if v is None else float(v) for v in line] for line in heat[key]])
        for key in ("dx_px", "dy_px")
    )
    full = counts >= _LEAST_CELL
    if full.sum() < _LEAST_CELLS:
        return math.nan
    square = (dx[full] ** 2 + dy[full] ** 2) / 2.0 - noise**2 / counts[full]
    return math.sqrt(max(float(square.mean()), 0.0)) / noise


def _few_groups(cases: Sequence[_Case]) -> list[list[_Case]]:
    """Cases merged where they are equal; further, as long as the groups are too many."""
    keys: tuple[Callable[[_Case], Any], ...] = (
        lambda case: (case.level, frozenset(case.facts), case.tilts, case.gaps),
        lambda case: (case.level, frozenset(case.facts), case.gaps),
        lambda case: (case.level, frozenset(case.facts)),
        lambda case: case.level,
    )
    groups: list[list[_Case]] = []
    for key in keys:
        groups = _grouped(cases, key)
        if len(groups) <= _MOST_GROUPS:
            break
    return groups


def _grouped(cases: Sequence[_Case], key: Callable[[_Case], Any]) -> list[list[_Case]]:
    groups: dict[Any, list[_Case]] = {}
    for case in cases:
        groups.setdefault(key(case), []).append(case)
    return list(groups.values())


def _names(group: Sequence[_Case], devices: int) -> str:
    if len(group) == devices > 2:
        return "all devices"
    return listed([case.name for case in group], _MOST_NAMED)


def _range(group: Sequence[_Case], kind: str, form: str, factor: float = 1.0) -> str:
    values = [factor * case.facts[kind] for case in group if kind in case.facts]
    if not values:
        return ""
    low, high = form.format(min(values)), form.format(max(values))
    return low if low == high else f"{low} to {high}"


def _place_um(row: Mapping[str, Any]) -> float:
    place = rows_of(part_of(row, "sigmas"), "place_um")
    if len(place) != 3 or any(value is None for value in place):
        return math.nan
    return math.sqrt(sum(float(value) ** 2 for value in place))


def _median(values: Sequence[float]) -> float:
    known = [value for value in values if math.isfinite(value)]
    return float(np.median(known)) if known else math.nan


_WAY = {"left": "to the left", "right": "to the right", "up": "upwards", "down": "downwards"}
