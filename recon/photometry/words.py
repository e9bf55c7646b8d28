"""What a photometric calibration has to say to an operator: refusals and warnings in words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.arrays import Bools, Floats, Ints
from recon.photometry.model import DevicePhotometry, PhotometricModel

WEAK_SIGMA = 0.01  # of V over V: a correction that is less well known is told
_LOST_SIGMA = 0.1  # from which it is refused
GAIN_OFF = 0.15
_FALLOFF_OFF = 0.08
_RISE = 0.02
_SCATTER = 0.02
_DROPPED = 0.2
_CLIPPED = 0.3
_INK = 0.18  # printed black reads 0.03 to 0.1 of white where values are linear
_SLOPE_OFF = 0.05
_BELOW_BLACK = 0.004  # part of the range by which a darkest value may lie below black: noise
_EDGE = 0.7  # half diagonals: the middle of an image's longer edge
_REGIONS = (
    ("upper left", "top", "upper right"),
    ("left", "middle", "right"),
    ("lower left", "bottom", "lower right"),
)


@dataclass(frozen=True, eq=False, kw_only=True)
class Evidence:
    """What was seen of each device beside what was solved.

    Attributes:
        readings: (C,) readings offered to the solve.
        dropped: (C,) share of them that did not fit.
        clipped: (C,) share of what was looked at that was clipped.
        ink_ratio: (C,) brightness of black ink over that of white; NaN when unknown.
        exposure_slope: (C,) growth of log brightness with log exposure; NaN when unknown.
        darkest: (C,) lowest value in any image, as a part of the range.
    """

    readings: Ints
    dropped: Floats
    clipped: Floats
    ink_ratio: Floats
    exposure_slope: Floats
    darkest: Floats


def cell_middles(width: int, height: int, shape: tuple[int, int]) -> Floats:
    """Middles (rows * columns, 2), px, of the cells of a grid over an image, row by row."""
    rows, columns = shape
    x = (np.arange(columns) + 0.5) * width / columns - 0.5
    y = (np.arange(rows) + 0.5) * height / rows - 0.5
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def coverage_refusals(model: PhotometricModel) -> list[str]:
    """One line for each device whose falloff the readings do not tell, and where not."""
    out = []
    for device in model:
        sigma = _cell_sigma(device)
        if not sigma.max() <= _LOST_SIGMA:
            out.append(
                f"{device.name}: its falloff is not told by {device.samples} readings "
                f"({_percent(float(sigma.max()))} unsure {_where(device, sigma > _LOST_SIGMA)}); "
                "show it white there, of light that other devices see too"
            )
    return out


def gain_ratios(model: PhotometricModel) -> Floats:
    """Gain (C,) of each device over the median of the others; 1 where gains are not known."""
    gains = np.array([device.gain for device in model])
    if len(gains) < 2 or any(np.isnan(device.gain_sigma) for device in model):
        return np.ones(len(gains))
    return np.array([gain / np.median(np.delete(gains, k)) for k, gain in enumerate(gains)])


def photometric_warnings(model: PhotometricModel, evidence: Evidence) -> list[str]:
    """What an operator should look at, one line each, in the order of the devices."""
    ratios = gain_ratios(model)
    edges = np.array([_edge(device) for device in model])
    out = []
    for index, device in enumerate(model):
        out += _gain_words(device.name, float(ratios[index]))
        if len(edges) > 1:
            out += _falloff_words(device.name, edges[index], np.delete(edges, index))
        out += _shape_words(device)
        out += _evidence_words(device, evidence, index)
    return out


def _gain_words(name: str, ratio: float) -> list[str]:
    if abs(ratio - 1.0) <= GAIN_OFF:
        return []
    share = f"{100 * abs(1.0 - ratio):.0f} %" if ratio < 2 else f"{ratio:.1f} times"
    words = f"{share} less light than" if ratio < 1 else f"{share} more light than"
    words = words if ratio < 2 else f"{share} the light of"
    return [
        f"{name} passes {words} the others: check its aperture ring, exposure time and gain setting"
    ]


def _falloff_words(name: str, edge: float, others: Floats) -> list[str]:
    usual = float(np.median(others))
    if abs(edge - usual) <= _FALLOFF_OFF or edge > 1.0:  # `_shape_words` tells of a rise
        return []
    return [
        f"{name} loses {_percent(1.0 - edge)} of the light at the image's edge, the others "
        f"{_percent(1.0 - usual)}: check its aperture ring, and for a hood or filter in the way"
    ]


def _shape_words(device: DevicePhotometry) -> list[str]:
    out = []
    cells = cell_middles(device.width, device.height, device.coverage.shape)
    fall, sigma = device.falloff(cells), _cell_sigma(device)
    sure = sigma <= WEAK_SIGMA
    if (fall[sure] > 1.0 + _RISE).any():
        out.append(
            f"{device.name}: images brighten by {_percent(float(fall[sure].max()) - 1.0)} away "
            "from the centre, which no lens does: was the light even, and is the black level right?"
        )
    if not sure.all():
        out.append(
            f"{device.name}: no light was seen {_where(device, ~sure)}, where the falloff is known "
            f"to {_percent(float(sigma.max()))} only; show it white there"
        )
    if device.residual > _SCATTER:
        out.append(
            f"{device.name}: readings scatter by {_percent(device.residual)}: a glossy board, "
            "an uneven field, flicker, or a wrong black level"
        )
    return out


def _evidence_words(device: DevicePhotometry, evidence: Evidence, index: int) -> list[str]:
    name, out = device.name, []
    if evidence.dropped[index] > _DROPPED:
        out.append(
            f"{name}: {_percent(evidence.dropped[index])} of its readings did not fit and were "
            "left out: gloss on the board, or something before the lens"
        )
    if evidence.clipped[index] > _CLIPPED:
        out.append(
            f"{name}: {_percent(evidence.clipped[index])} of the white is clipped: "
            "less light or a shorter exposure"
        )
    ratio = evidence.ink_ratio[index]
    if ratio > _INK:
        out.append(
            f"{name}: black ink reads {_percent(ratio)} of white, where 3 to 10 % is usual: the "
            "values are gamma-encoded (record linear ones), or light falls into the lens, or the "
            "black level is not taken away (give a dark take)"
        )
    slope = evidence.exposure_slope[index]
    if abs(slope - 1.0) > _SLOPE_OFF:
        out.append(
            f"{name}: brightness grows with the power {slope:.2f} of the exposure time, "
            "1 for linear values: gamma-encoded, a wrong black level, or a light that changed"
        )
    black = device.black_dn / device.range_dn
    if evidence.darkest[index] < black - _BELOW_BLACK:
        out.append(
            f"{name}: the black level of {device.black_dn:.4g} is above values it shows, down to "
            f"{evidence.darkest[index] * device.range_dn:.4g}; take dark frames with the lens "
            "capped"
        )
    return out


def _edge(device: DevicePhotometry) -> float:
    """V at 0.7 half diagonals from the centre."""
    unit = 0.5 * float(np.hypot(device.width, device.height))
    return float(device.falloff(device.centre_px[None] + [[_EDGE * unit, 0.0]])[0])


def _cell_sigma(device: DevicePhotometry) -> Floats:
    return device.falloff_sigma(cell_middles(device.width, device.height, device.coverage.shape))


def _where(device: DevicePhotometry, weak: Bools) -> str:
    """The parts of an image that hold weak cells, in words; those without readings when any."""
    rows, columns = device.coverage.shape
    empty = weak & (device.coverage.ravel() == 0)
    row, column = np.divmod(np.flatnonzero(empty if empty.any() else weak), columns)
    parts = {
        _REGIONS[int(3 * r / rows)][int(3 * c / columns)]
        for r, c in zip(row.tolist(), column.tolist(), strict=True)
    }
    names = [name for line in _REGIONS for name in line if name in parts]
    if len(names) > 5:
        return "in most of the image" if "middle" in names else "all around the border"
    return "in the " + ", ".join(names)


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if abs(share) < 0.1 else f"{100 * share:.0f} %"
