"""Where the devices of synthetic arrays stand: arcs, rows, rings, clusters, pairs, turned ones."""

from __future__ import annotations

import numpy as np

from capture.arrays import Floats
from capture.errors import SettingsError

_PITCHES = (-18.0, 4.0, 22.0)
_PAIR_DEG = 8.0  # between the two devices of a stereo pair
_CLUSTER_DEG = 9.0  # between neighbours of a cluster
LAYOUTS = ("arc", "row", "rows", "ring", "clusters", "pairs", "turned")


def device_directions(layout: str, devices: int, span_deg: float) -> Floats:
    """Yaw, pitch and roll (C, 3), degrees, of the devices of one layout, all looking at the origin.

    Args:
        layout: "arc" (three heights), "row" (one height), "rows" (two, one above the other),
            "ring" (all around), "clusters" (two groups with a gap), "pairs" (stereo pairs),
            "turned" (an arc whose devices are mounted upright, turned left, turned right by turns).
        devices: how many.
        span_deg: the array reaches from -span to +span; a ring always goes around.

    Raises:
        SettingsError: naming the layouts there are.
    """
    index = np.arange(devices)
    along = np.linspace(-span_deg, span_deg, devices) if devices > 1 else np.zeros(1)
    out = np.zeros((devices, 3))
    if layout in ("arc", "turned"):
        out[:, 0] = [-span_deg + 2 * span_deg * i / max(devices - 1, 1) for i in range(devices)]
        out[:, 1] = np.array(_PITCHES)[index % 3]
        if layout == "turned":
            out[:, 2] = np.array([0.0, 90.0, -90.0, 90.0])[index % 4]
    elif layout == "row":
        out[:, 0] = along
    elif layout == "rows":
        columns = (devices + 1) // 2
        out[:, 0] = np.linspace(-span_deg, span_deg, columns)[index // 2]
        out[:, 1] = np.where(index % 2, -14.0, 16.0)
    elif layout == "ring":
        out[:, 0] = 360.0 * index / devices
        out[:, 1] = np.where(index % 2, -6.0, 10.0)
    elif layout == "clusters":
        half = (devices + 1) // 2
        place = np.where(index < half, index, index - half)
        columns = int(np.ceil(np.sqrt(half)))
        middle = np.where(index < half, -0.6, 0.6) * span_deg
        out[:, 0] = middle + _CLUSTER_DEG * (place % columns - (columns - 1) / 2)
        out[:, 1] = _CLUSTER_DEG * (place // columns - 0.5)
    elif layout == "pairs":
        pairs = (devices + 1) // 2
        out[:, 0] = np.linspace(-span_deg, span_deg, pairs)[index // 2]
        out[:, 0] += np.where(index % 2, 0.5, -0.5) * _PAIR_DEG
        out[:, 1] = np.array(_PITCHES)[(index // 2) % 3]
    else:
        raise SettingsError(f"layout: one of {', '.join(LAYOUTS)}, found {layout!r}")
    return out


def board_yaws(layout: str, span_deg: float, poses: int) -> Floats:
    """Mean yaw (P,), degrees, of a board that is shown to every device of the array in turn."""
    reach = 180.0 * (1.0 - 1.0 / max(poses, 1)) if layout == "ring" else max(span_deg - 12.0, 30.0)
    yaws: Floats = np.linspace(-reach, reach, poses)
    return yaws
