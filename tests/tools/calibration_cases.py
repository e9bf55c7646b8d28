"""A calibration's report with every key that its page draws, of made-up but plausible numbers."""

from __future__ import annotations

from typing import Any

import numpy as np

from capture.camera import CameraArray
from tests.tools.report_cases import camera

LOG = "rejected.csv"
NODES, CELLS = 7, 6  # along each edge of the uncertainty map and of the volume


def array_of(names: tuple[str, ...], size: int = 1200) -> CameraArray:
    """Cameras on an arc before the face."""
    yaws = np.linspace(-1.0, 1.0, len(names))
    return CameraArray(
        tuple(camera(name, float(yaw), size) for name, yaw in zip(names, yaws, strict=True))
    )


def full_report(names: tuple[str, ...], size: int = 1200, poses: int = 30) -> dict[str, Any]:
    """A report with every key; the last device is the odd one."""
    random = np.random.default_rng(7)
    devices = [_device(name, name == names[-1], random) for name in names]
    vectors = {
        name: np.hstack(
            [random.uniform(0, size - 1, (60, 2)), random.normal(0, 0.1, (60, 2))]
        ).round(3).tolist()
        for name in names
    }  # fmt: skip
    odd = names[-1]
    reason = {"level": "bad", "device": odd, "words": f"{odd} moved during the take",
              "more_poses": 6}  # fmt: skip
    thin = {"level": "warn", "device": None, "more_poses": 1,
            "words": "little was shown at the chin: hold the board there"}  # fmt: skip
    return {
        "mean_reprojection_px": 0.127,
        "rms_per_coordinate_px": 0.1,
        "robust_sigma_px": 0.099,
        "corners_used": 9000,
        "corners_rejected": 90,
        "rejection": "further off than the robust limit of its device",
        "poses_used": poses,
        "devices": devices,
        "poses": [
            {"frame": 3 * k, "mean_reprojection_px": 0.12 + 0.002 * k, "corners_rejected": k}
            for k in range(poses)
        ],
        "board": {"bow_mm": 0.31, "width_over_height": 1.00004},
        "held_out": {"frames": [3, 24], "ratio": 1.04, "remark": ""},
        "split_half": {
            "p95_px": 0.06, "median_px": 0.03, "remark": "",
            "by_device": {name: 0.05 + 0.1 * (name == odd) for name in names},
        },
        "scale_bar": {"length_mm": 300.0, "measured_mm": 300.012, "sigma_mm": 0.006, "frames": 12,
                      "ratio": 1.00004},
        "volume": _volume(random),
        "uncertainty": _uncertainty(),
        "log": LOG,
        "warnings": ["The board is bent by 0.31 mm."],
        "gate": {"verdict": "bad", "headline": f"Do not shoot: {odd} is not calibrated",
                 "reasons": [reason, thin], "more_poses": 7},
        "residual_vectors": vectors,
        "board_places": [_place(random) for _ in range(poses)],
    }  # fmt: skip


def _device(name: str, odd: bool, random: np.random.Generator) -> dict[str, Any]:
    counts = random.integers(0, 9, (8, 8))
    lengths = random.uniform(0.08, 0.16, (8, 8)) * (3.0 if odd else 1.0)
    means = random.normal(0.02 if odd else 0.0, 0.01, (2, 8, 8))
    missing = counts == 0

    def told(table: np.ndarray) -> list[list[float | None]]:
        return [
            [
                None if gone else round(float(value), 4)
                for value, gone in zip(row, line, strict=True)
            ]
            for row, line in zip(table, missing, strict=True)
        ]

    return {
        "name": name,
        "views": 20 - 15 * odd,
        "corners_used": 1500,
        "corners_rejected": 12 + 60 * odd,
        "frames": {"used": 20, "no board": 4},
        "mean_reprojection_px": 0.12 + 0.6 * odd,
        "fx_px": 2640.25,
        "fy_px": 2641.5,
        "fx_sigma_px": 0.4,
        "covered": float((counts > 0).mean()),
        "coverage": counts.tolist(),
        "sigmas": {"fx_px": 0.31, "fy_px": 0.32, "cx_px": 0.5, "cy_px": 0.5, "k1": 1e-3, "k2": None,
                   "p1": 1e-5, "p2": 1e-5, "place_um": [12.0, 10.0, 22.0 + 60 * odd],
                   "turn_mdeg": [1.1, 1.2, 0.6]},
        "tilts_deg": {"left": 31.0, "right": 28.5, "up": 35.0, "down": None if odd else 22.0},
        "heat": {"size_px": told(lengths), "dx_px": told(means[0]), "dy_px": told(means[1])},
    }  # fmt: skip


def _volume(random: np.random.Generator) -> dict[str, Any]:
    edge = 240.0 / CELLS
    along = edge * (np.arange(CELLS) - (CELLS - 1) / 2)
    z, y, x = np.meshgrid(along, along, along, indexing="ij")
    inside = np.sqrt(x**2 + y**2 + z**2) <= 120.0
    counts = random.integers(20, 400, x.shape)
    counts[:, :2, :] = 0
    return {
        "centre_mm": [0.0, 0.0, 0.0], "radius_mm": 120.0, "edge_mm": edge, "shape": [CELLS] * 3,
        "origin_mm": [float(along[0])] * 3,
        "corners": [int(n) if ok else None
                    for n, ok in zip(counts.ravel(), inside.ravel(), strict=True)],
        "thin": ["little was shown at the chin: hold the board there"],
    }  # fmt: skip


def _uncertainty() -> dict[str, Any]:
    step = 240.0 / (NODES - 1)
    along = step * (np.arange(NODES) - (NODES - 1) / 2)
    z, y, x = np.meshgrid(along, along, along, indexing="ij")
    away = np.sqrt(x**2 + y**2 + z**2)
    alone = 1.2 + 2.0 * (away / 120.0) ** 2 + 0.004 * (x + z)

    def told(values: np.ndarray) -> list[float | None]:
        return [float(round(v, 3)) if r <= 120.1 else None
                for v, r in zip(values.ravel(), away.ravel(), strict=True)]  # fmt: skip

    return {"origin_mm": [-120.0] * 3, "step_mm": step, "shape": [NODES] * 3,
            "calibration_um": told(alone), "with_noise_um": told(alone + 12.0),
            "rms_um": 2.31, "p95_um": 3.2, "rms_with_noise_um": 14.4}  # fmt: skip


def _place(random: np.random.Generator) -> list[list[float]]:
    middle = random.normal(0, 40.0, 3)
    turn, _ = np.linalg.qr(np.eye(3) + random.normal(0, 0.3, (3, 3)))
    flat = np.array([[-90.0, -60, 0], [90, -60, 0], [90, 60, 0], [-90, 60, 0]])
    place: list[list[float]] = (middle + flat @ turn.T).round(2).tolist()
    return place
