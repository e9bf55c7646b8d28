"""The numbers of one scan: what stands in its JSON, the diagnosis of every device included."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from capture.arrays import Image
from capture.camera import CameraArray
from recon.aim import Aims
from recon.disparity import Reason
from recon.fusion import Points
from recon.scan_quality import CameraQuality, camera_qualities, matched_share
from recon.scan_warnings import camera_warnings, missing_warnings, scan_warnings
from recon.stereo import PairDepth


def aim_numbers(names: Sequence[str], aims: Aims) -> dict[str, Any]:
    """By how much the images have moved on their sensors since calibration, fit for JSON."""
    return {
        "samples": aims.samples,
        "corrected": aims.correct,
        "deviation_before": _plain(aims.agreement[0]),
        "deviation_after": _plain(aims.agreement[1]),
        "cameras": {
            name: {
                "columns_px": _plain(float(shift[0])),
                "rows_px": _plain(float(shift[1])),
                "sigma_px": _plain(float(max(sigma))),
            }
            for name, shift, sigma in zip(names, aims.shift_px, aims.shift_sigma_px, strict=True)
        },
    }


def scan_numbers(
    cameras: CameraArray,
    images: Mapping[str, Image],
    pairs: Sequence[PairDepth],
    points: Points,
    footprint_mm: float,
) -> dict[str, Any]:
    """What a reader wants to know of a scan before its mesh, fit for JSON.

    Args:
        cameras: of the whole array.
        images: by name, of the cameras that took part; the others are told as missing.
        pairs: what each pair of them saw.
        points: what the pairs agree on.
        footprint_mm: what a pixel covers on the skin.
    """
    there = CameraArray(tuple(camera for camera in cameras if camera.name in images))
    missing = [camera.name for camera in cameras if camera.name not in images]
    qualities = camera_qualities(there, images, pairs, points)
    share = matched_share(pairs)
    warnings = scan_warnings(
        qualities,
        matched_share=share,
        agreement_p95_mm=points.agreement_mm[1],
        footprint_mm=footprint_mm,
    )
    strays = [q.unconfirmed_share for q in qualities if math.isfinite(q.unconfirmed_share)]
    return {
        "missing": missing,
        "cameras": list(there.names),
        "warnings": missing_warnings(missing) + warnings,
        "pairs": [_pair(pair, there) for pair in pairs],
        "pair_reasons": [dict(pair.reasons) for pair in pairs],
        "reasons": _reasons(pairs),
        "matched_share": _plain(share),
        "unconfirmed_share": _plain(float(np.mean(strays))) if strays else None,
        "points": len(points),
        "rejected": dict(points.rejected),
        "spacing_mm": _plain(points.spacing_mm),
        "footprint_mm": _plain(footprint_mm),
        "agreement_median_mm": _plain(points.agreement_mm[0]),
        "agreement_p95_mm": _plain(points.agreement_mm[1]),
        "support_median": float(np.median(points.support)),
        "lone_share": _plain(float((points.support <= 1).mean())),
        "cameras_report": _camera_rows(qualities),
    }


def _camera_rows(qualities: Sequence[CameraQuality]) -> list[dict[str, Any]]:
    told = camera_warnings(qualities)
    return [
        {key: _plain(value) for key, value in asdict(quality).items()}
        | {"warnings": told.get(quality.name, [])}
        for quality in qualities
    ]


def _pair(pair: PairDepth, cameras: CameraArray) -> dict[str, Any]:
    return {
        "left": cameras[pair.pair.left].name,
        "right": cameras[pair.pair.right].name,
        "angle_deg": round(pair.pair.angle_deg, 2),
        "coverage": round(pair.coverage, 4),
    }


def _reasons(pairs: Sequence[PairDepth]) -> dict[str, int]:
    return {
        reason.name: sum(pair.reasons.get(reason.name, 0) for pair in pairs) for reason in Reason
    }


def _plain(value: Any) -> Any:
    """A number as JSON can hold it: four digits, null for NaN; anything else as it is."""
    if not isinstance(value, float):
        return value
    return round(value, 4) if math.isfinite(value) else None
