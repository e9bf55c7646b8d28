"""Reading and writing cameras.json, the exchange format of calibrated arrays.

::

    {"units": "mm", "cameras": [{"name", "width", "height", "K": 3x3,
                                 "dist": [k1,k2,p1,p2,k3], "R": 3x3, "t": 3}]}

with x_cam = R x_world + t, OpenCV axes, pixel centres at integers.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from capture.camera import Camera, CameraArray
from capture.documents import is_whole, key_problems, read_json, write_json
from capture.errors import CameraError, LikenessError, raise_all
from capture.names import is_plain_name
from capture.pose import Pose

_REQUIRED = ("name", "width", "height", "K", "dist", "R", "t")
_OPTIONAL = ("gain",)  # a device's relative gain: a remark that no stage needs
_SHOWN = 200  # characters of a wrong value that a message repeats
_TOP = ("units", "cameras", "convention", "report")


def read_cameras(path: Path) -> CameraArray:
    """Read cameras.json.

    Raises:
        CameraError: naming the file and every camera that does not fit.
    """
    absent = "no such file; `likeness calibrate` writes one"
    document = read_json(path, CameraError, absent=absent)
    return cameras_from_document(document, str(path))


def cameras_from_document(document: Any, where: str) -> CameraArray:
    """Build an array from the parsed JSON document.

    Args:
        document: the parsed file.
        where: the name to use in messages.

    Raises:
        CameraError: listing every key, size or value that does not fit.
    """
    if not isinstance(document, Mapping):
        raise CameraError(
            f"{where}: expected an object with 'cameras', found {type(document).__name__}"
        )
    problems = key_problems(document, ("units", "cameras"), _TOP, "top level")
    raise_all(where, problems, CameraError)
    if document["units"] != "mm":
        raise CameraError(f'{where}: units must be "mm", found {document["units"]!r}')
    entries = document["cameras"]
    if not isinstance(entries, list) or not entries:
        raise CameraError(f"{where}: 'cameras' must be a list of at least one camera")
    cameras: list[Camera] = []
    for index, entry in enumerate(entries):
        try:
            cameras.append(_camera(entry, index))
        except LikenessError as error:
            problems.append(str(error))
    raise_all(where, problems, CameraError)
    try:
        return CameraArray(tuple(cameras))
    except CameraError as error:
        raise CameraError(f"{where}: {error}") from error


def write_cameras(
    path: Path, cameras: CameraArray, report: Mapping[str, Any] | None = None
) -> None:
    """Write cameras.json, whole or not at all.

    Args:
        path: the file to write or replace.
        cameras: the array.
        report: what the calibration says of itself, stored under "report".
    """
    document: dict[str, Any] = {
        "units": "mm",
        "convention": "OpenCV axes; pixel centres at integers; x_cam = R x_world + t; "
        "dist = k1 k2 p1 p2 k3",
        "cameras": [
            {
                "name": camera.name,
                "width": camera.width,
                "height": camera.height,
                "K": camera.matrix.tolist(),
                "dist": camera.distortion.tolist(),
                "R": camera.camera_from_world.rotation.tolist(),
                "t": camera.camera_from_world.translation.tolist(),
            }
            for camera in cameras
        ],
    }
    if report is not None:
        document["report"] = dict(report)
    write_json(path, document)


def _camera(entry: Any, index: int) -> Camera:
    if not isinstance(entry, Mapping):
        raise CameraError(f"camera {index}: expected an object, found {type(entry).__name__}")
    label = str(entry.get("name", f"camera {index}"))
    raise_all(label, key_problems(entry, _REQUIRED, _REQUIRED + _OPTIONAL, "camera"), CameraError)
    if not is_plain_name(entry["name"]):
        raise CameraError(
            f"camera {index}: name must be letters, digits, '-', '_' or '.', "
            f"found {entry['name']!r}"
        )
    k = _numbers(entry, "K", (3, 3), label)
    if k[0, 1] != 0 or k[1, 0] != 0 or not np.array_equal(k[2], [0, 0, 1]):
        raise CameraError(f"{label}: K must be [[fx,0,cx],[0,fy,cy],[0,0,1]], found {k.tolist()}")
    for key in ("width", "height"):
        if not is_whole(entry[key]):
            raise CameraError(f"{label}: {key} must be a whole number of px, found {entry[key]!r}")
    try:
        pose = Pose(_numbers(entry, "R", (3, 3), label), _numbers(entry, "t", (3,), label))
    except CameraError:
        raise
    except LikenessError as error:
        raise CameraError(f"{label}: R, t: {error}") from error
    return Camera(
        name=entry["name"], width=entry["width"], height=entry["height"],
        fx=float(k[0, 0]), fy=float(k[1, 1]), cx=float(k[0, 2]), cy=float(k[1, 2]),
        distortion=_numbers(entry, "dist", (5,), label), camera_from_world=pose,
    )  # fmt: skip


def _numbers(
    entry: Mapping[str, Any], key: str, shape: tuple[int, ...], label: str
) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    try:
        found = np.array(entry[key])
        if found.dtype.kind not in "iuf":  # text, null, true, or an integer of 20 digits
            raise TypeError(f"numbers cannot be made of {found.dtype}")
    except (TypeError, ValueError) as error:
        shown = repr(entry[key])
        shown = shown if len(shown) <= _SHOWN else f"{shown[:_SHOWN]} ..."
        raise CameraError(f"{label}: {key} must hold numbers, found {shown}") from error
    array = found.astype(np.float64)
    if array.shape != shape:
        raise CameraError(f"{label}: {key} must have shape {shape}, found {array.shape}")
    if not np.isfinite(array).all():
        raise CameraError(f"{label}: {key} holds NaN or infinity: {array.tolist()}")
    return array
