"""What is wrong with a scan, in sentences for whoever stands beside the array."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from recon.aim import Aims
from recon.scan_quality import CameraQuality

# Thresholds. On good takes pairs agree to 0.3 to 0.45 footprints (95 %), to 1.1 with every image
# off by 0.3 px. On rendered takes without faults deviations stay below 0.03 px, sharpness within
# 0.9 to 1.1, gain within 0.92 to 1.06; a blur of 1.2 px gives 0.74, a shift of 0.3 px 0.27.
_DEVIATION_PX = 0.08
_ABOVE_OTHERS = 2.0  # a deviation is one camera's own when it is this many times the others'
_SHARPNESS = 0.82
_CLIPPED = 0.03  # share of the skin
_GAIN = 0.2  # of darker or brighter
_SHARE = 0.6  # matched, of what the neighbours match
_MATCHED = 0.15  # of all textured pixels: below it the whole scan is in doubt
_AGREEMENT_PX = 0.7  # 95th percentile of the deviation between pairs, in pixel footprints


def camera_warnings(qualities: Sequence[CameraQuality]) -> dict[str, list[str]]:
    """What each camera shows that the others do not, by name; nothing for a good camera.

    A fault that more than half of the cameras share is said by `scan_warnings` instead.
    """
    told: dict[str, list[str]] = {quality.name: [] for quality in qualities}
    for fault, words in _FAULTS:
        bad = [quality for quality in qualities if fault(quality, qualities)]
        if len(bad) <= len(qualities) / 2:
            for quality in bad:
                told[quality.name].append(words(quality))
    return {name: sentences for name, sentences in told.items() if sentences}


def scan_warnings(
    qualities: Sequence[CameraQuality],
    *,
    matched_share: float,
    agreement_p95_mm: float,
    footprint_mm: float,
) -> list[str]:
    """Every warning of one scan, those that concern all cameras first.

    Args:
        qualities: of the cameras that have an image.
        matched_share: of the textured pixels of all pairs.
        agreement_p95_mm: deviation between pairs along the normal.
        footprint_mm: what a pixel covers on the skin.
    """
    out = _shared_faults(qualities)
    if agreement_p95_mm > _AGREEMENT_PX * footprint_mm:
        out.append(
            f"all cameras: pairs agree to {agreement_p95_mm:.2f} mm (95 %) where a pixel covers "
            f"{footprint_mm:.2f} mm: calibrate again"
        )
    if not matched_share >= _MATCHED:
        out.append(
            f"all cameras: {_percent(matched_share)} of the textured pixels were matched: check "
            "focus, light, and that the calibration is of this array"
        )
    for name, sentences in camera_warnings(qualities).items():
        out += [f"{name}: {sentence}" for sentence in sentences]
    return out


def aim_warnings(names: Sequence[str], aims: Aims) -> list[str]:
    """Which images have moved on their sensors since calibration; one sentence when most have."""
    length, moved = np.hypot(*aims.shift_px.T), aims.moved
    if moved.sum() > len(names) / 2:
        columns, rows = np.median(aims.shift_px[moved], axis=0)
        return [
            f"all cameras: the images lie {np.median(length[moved]):.2f} px (median; columns "
            f"{columns:+.2f}, rows {rows:+.2f}) from where the calibration puts them; this scan is "
            "corrected for it: calibrate again"
        ]
    return [
        f"{names[k]}: its image lies {length[k]:.2f} px from where the calibration puts it; this "
        "scan is corrected for it: calibrate again"
        for k in np.flatnonzero(moved).tolist()
    ]


def missing_warnings(missing: Sequence[str]) -> list[str]:
    """That devices lost the frame, in one sentence; none when none did."""
    if not missing:
        return []
    return [f"{', '.join(missing)}: no image of this frame; the scan is made without"]


def _shared_faults(qualities: Sequence[CameraQuality]) -> list[str]:
    """Faults of more than half of the cameras, one sentence each."""
    out = []
    clipped = [quality.clipped_share for quality in qualities if quality.clipped_share > _CLIPPED]
    if len(clipped) > len(qualities) / 2:
        out.append(
            f"{len(clipped)} of {len(qualities)} cameras: {_percent(float(np.median(clipped)))} of "
            "the skin is at white: lower the light, the exposure or the gain"
        )
    rest = [quality for quality in qualities if not _is_off(quality, qualities)]
    off = [quality.deviation_px for quality in rest if quality.deviation_px > _DEVIATION_PX]
    if len(off) > len(qualities) / 2:
        out.append(
            f"{len(off)} of {len(qualities)} cameras: pairs lie {float(np.median(off)):.2f} px off "
            "each other: calibrate again"
        )
    return out


def _is_off(one: CameraQuality, all_: Sequence[CameraQuality]) -> bool:
    others = [quality.deviation_px for quality in all_ if quality.name != one.name]
    known = [value for value in others if np.isfinite(value)]
    typical = float(np.median(known)) if known else 0.0
    return one.deviation_px > max(_DEVIATION_PX, _ABOVE_OTHERS * typical)


def _off(one: CameraQuality) -> str:
    return (
        f"its pairs lie {one.deviation_px:.2f} px ({one.deviation_mm:.2f} mm) off what the others "
        "agree on: it moved since the calibration; calibrate again, or leave it out"
    )


def _blurred(one: CameraQuality) -> str:
    return (
        f"{_percent(1 - one.sharpness)} less fine detail than the others see on the same skin: out "
        "of focus, or shaken; check focus and aperture"
    )


def _clipped(one: CameraQuality) -> str:
    return f"{_percent(one.clipped_share)} of the skin is at white: lower its exposure or gain"


def _unequal(one: CameraQuality) -> str:
    way = "darker" if one.gain < 1 else "brighter"
    size = 1 - one.gain if one.gain < 1 else one.gain - 1
    return (
        f"{_percent(size)} {way} than the others on the same skin: check exposure, gain, aperture"
    )


def _poor(one: CameraQuality) -> str:
    return (
        f"{_percent(one.matched_share)} of its textured pixels were matched, "
        f"{_percent(one.neighbours_share)} of its neighbours': look at its image"
    )


def _lost(one: CameraQuality) -> str:
    if one.pairs == 0:
        return "stands too far from every other camera to be matched with one"
    return (
        f"nothing matched with any of its {one.pairs} partners: is it aimed at the face, and is "
        "its calibration of this take?"
    )


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"


_Fault = Callable[[CameraQuality, Sequence[CameraQuality]], bool]
_FAULTS: tuple[tuple[_Fault, Callable[[CameraQuality], str]], ...] = (
    (lambda one, _: not np.isfinite(one.deviation_px), _lost),
    (_is_off, _off),
    (lambda one, _: one.sharpness < _SHARPNESS, _blurred),
    (lambda one, _: one.clipped_share > _CLIPPED, _clipped),
    (lambda one, _: one.gain < 1 - _GAIN or one.gain > 1 / (1 - _GAIN), _unequal),
    (lambda one, _: one.matched_share < _SHARE * one.neighbours_share, _poor),
)
