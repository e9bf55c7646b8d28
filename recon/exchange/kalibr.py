"""Cameras in Kalibr's camera chain, camchain.yaml.

Each of cam0, cam1, ... has `camera_model` pinhole, `intrinsics` [fu, fv, pu, pv],
`distortion_model` radtan [k1, k2, p1, p2] (OpenCV's, without k3) or none, `resolution` [width,
height] and, from cam1 on, `T_cn_cnm1`, which takes the space of the camera before it to its own, in
metres. Axes and pixel centres are OpenCV's. Kalibr has no world: cam0's space is the world, unless
cam0 too has a `T_cn_cnm1`, which is then cam0_from_world (mrcal's custom; Kalibr does not look at
it).

The chain names no cameras; ours are kept in `rostopic`, as /NAME/image_raw.

References:
    ethz-asl/kalibr, wiki "Yaml formats" and kalibr_common/ConfigReader.py; mrcal-to-kalibr(1).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from capture.camera import Camera, CameraArray
from capture.errors import CameraError
from capture.names import is_plain_name
from capture.pose import Pose
from capture.product import replacing
from recon.camera_parts import (
    Lens,
    check_unit,
    gather,
    numbers,
    read_text,
    refuse_terms,
    rigid,
    shown,
    whole,
)

_LIMIT = 1 << 17  # some hundred cameras; PyYAML needs seconds for that much
_DEEPEST = 64
_FAULTS = (
    yaml.YAMLError, ValueError, KeyError, IndexError, AttributeError, TypeError, OverflowError,
)  # fmt: skip
"""What PyYAML raises at odd input: its own errors, and those of Python's number and date types."""
_RADTAN = ("k1", "k2", "p1", "p2")


class _Loader(yaml.SafeLoader):
    """Plain values alone, nested little, without aliases, by which a short file can mean much."""

    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("an alias (*name); write the values out")
        self.depth += 1
        if self.depth > _DEEPEST:
            raise yaml.YAMLError(f"nested more than {_DEEPEST} levels deep")
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node


def read_kalibr(path: Path, unit_mm: float = 1000.0) -> CameraArray:
    """Read a camera chain.

    Args:
        path: the .yaml file.
        unit_mm: millimetres of the chain's unit.

    Raises:
        CameraError: naming the file and every camera that does not fit.
    """
    check_unit(unit_mm)
    where = str(path)
    text = re.sub(r"\A%YAML[^\n]*\n(?!---)", "", read_text(path, _LIMIT))
    try:
        chain = yaml.load(text, Loader=_Loader)
    except _FAULTS as error:
        said = " ".join(str(error).split())[:200] or type(error).__name__
        raise CameraError(f"{where}: not readable as YAML: {said}") from error
    if not isinstance(chain, Mapping) or not isinstance(chain.get("cam0"), Mapping):
        raise CameraError(f"{where}: expected a Kalibr chain of cam0, cam1, ...")
    count = sum(1 for key in chain if isinstance(key, str) and re.fullmatch(r"cam\d+", key))
    missing = [f"cam{at}" for at in range(count) if not isinstance(chain.get(f"cam{at}"), Mapping)]
    if missing:
        raise CameraError(f"{where}: {count} cameras, but no {', '.join(missing[:8])}")
    entries = [chain[f"cam{at}"] for at in range(count)]
    names = _names(entries)
    places: list[Pose | None] = []

    def make(at: int) -> Camera:
        before = places[at - 1] if at > 0 else Pose.identity()
        places.append(None)  # until it is known; the cameras after it hang on it
        if "T_cn_cnm1" in entries[at] or at > 0:
            step = _step(entries[at], unit_mm)
            if before is None:
                raise CameraError(f"hangs on cam{at - 1}, which does not fit")
            before = step @ before
        places[at] = before
        return _lens(entries[at]).camera(names[at], before or Pose.identity())

    return gather(where, [(names[at], partial(make, at)) for at in range(count)])


def write_kalibr(path: Path, cameras: CameraArray, unit_mm: float = 1000.0) -> None:
    """Write the array as a camera chain.

    Args:
        path: the .yaml file, replaced whole or not at all.
        cameras: the array; k3 must be 0.
        unit_mm: millimetres of the chain's unit.

    Raises:
        CameraError: naming every camera with a k3.
    """
    check_unit(unit_mm)
    instead = "radtan is k1 k2 p1 p2: solve with k3 = 0, or choose another format"
    refuse_terms(str(path), cameras, ("k3",), instead)
    chain: dict[str, Any] = {}
    before = Pose.identity()
    for at, camera in enumerate(cameras):
        step = (camera.camera_from_world @ before.inverse()).matrix()
        step[:3, 3] /= unit_mm
        chain[f"cam{at}"] = {
            "T_cn_cnm1": step.tolist(),
            "camera_model": "pinhole",
            "distortion_coeffs": camera.distortion[:4].tolist(),
            "distortion_model": "radtan",
            "intrinsics": [float(v) for v in (camera.fx, camera.fy, camera.cx, camera.cy)],
            "resolution": [camera.width, camera.height],
            "rostopic": f"/{camera.name}/image_raw",
        }
        before = camera.camera_from_world
    text = yaml.safe_dump(chain, allow_unicode=True, sort_keys=False, width=200)
    with replacing(Path(path)) as partial_path:
        partial_path.write_text(text, encoding="utf-8")


def _lens(entry: Mapping[str, Any]) -> Lens:
    model, bend = entry.get("camera_model"), entry.get("distortion_model")
    if model != "pinhole":
        raise CameraError(f"camera_model {shown(model)}; only pinhole is a camera of ours")
    if bend not in ("radtan", "none"):
        raise CameraError(
            f"distortion_model {shown(bend)}; only radtan (and none) is Brown-Conrady: "
            "calibrate it again with pinhole-radtan"
        )
    coefficients = entry.get("distortion_coeffs", [])
    terms = _RADTAN if bend == "radtan" or coefficients else ()
    values = numbers(coefficients, len(terms), "distortion_coeffs")
    if bend == "none" and any(values):
        raise CameraError("distortion_model none, but distortion_coeffs are not 0")
    fx, fy, cx, cy = numbers(entry.get("intrinsics"), 4, "intrinsics")
    width, height = numbers(entry.get("resolution"), 2, "resolution")
    return Lens(
        width=whole(width, "resolution"), height=whole(height, "resolution"),
        focal_px=(fx, fy), centre_px=(cx, cy), distortion=dict(zip(terms, values, strict=True)),
    )  # fmt: skip


def _step(entry: Mapping[str, Any], unit_mm: float) -> Pose:
    rows = entry.get("T_cn_cnm1")
    if not isinstance(rows, list) or len(rows) != 4:
        raise CameraError("T_cn_cnm1 must be a 4 x 4 matrix; without it the camera has no place")
    matrix = np.array([numbers(row, 4, "a row of T_cn_cnm1") for row in rows])
    return rigid(matrix, unit_mm, "T_cn_cnm1")


def _names(entries: list[Mapping[str, Any]]) -> list[str]:
    """The names in /NAME/image_raw, when all cameras have one of their own; else cam0, cam1, ..."""
    topics = [entry.get("rostopic") for entry in entries]
    texts = [topic if isinstance(topic, str) else "" for topic in topics]
    found = [re.fullmatch(r"/([^/]+)/image_raw", text) for text in texts]
    names = [match[1] for match in found if match is not None]
    kept = len(set(names)) == len(entries) and all(is_plain_name(name) for name in names)
    return names if kept else [f"cam{at}" for at in range(len(entries))]
