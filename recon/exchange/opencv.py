"""Cameras in OpenCV's own files: what cv2.FileStorage writes as YAML or XML.

Three layouts are read: that of OpenCV's multi-view calibration sample (`Ks`, `distortions`, `Rs`
or `rvecs`, `Ts`, `image_sizes`, `cam_ids`), which is also the one written; that of its calibration
sample (`camera_matrix`, `distortion_coefficients`, `image_width`, `image_height`), one camera at
the world's origin; and that of its stereo sample (`M1 D1 M2 D2` and `R T`). Axes, pixel centres
and distortion are ours. OpenCV names no unit: a file is in whatever its board was measured in.

References:
    OpenCV, samples/python/multiview_calibration.py, samples/cpp/stereo_calib.cpp and the camera
    calibration tutorial; calib3d, "Detailed Description", for the order of the coefficients.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from capture.arrays import Floats
from capture.camera import Camera, CameraArray
from capture.errors import CameraError
from capture.pose import Pose
from capture.product import replacing
from recon.camera_parts import (
    Lens,
    check_unit,
    gather,
    number,
    numbers,
    read_text,
    rigid,
    scaled,
    whole,
)
from recon.exchange.xml_tree import parse_xml

_COEFFICIENTS = (
    "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y"
)  # fmt: skip
_COUNTS = (0, 4, 5, 8, 12, 14)  # of coefficients, as OpenCV takes them
_LIMIT = 1 << 25
_MOST = 20_000  # numbers of one matrix
_DEEPEST = 64
_LARGEST_TURN = 1e3  # radians
_LAYOUTS = (
    "Ks, distortions, Rs, Ts, image_sizes (multi-view sample), camera_matrix, "
    "distortion_coefficients, image_width, image_height (calibration sample), or M1, D1, M2, D2, "
    "R, T (stereo sample)"
)


def read_opencv(path: Path, unit_mm: float = 1.0) -> CameraArray:
    """Read the cameras of a file that cv2.FileStorage wrote.

    Args:
        path: .yml, .yaml or .xml.
        unit_mm: millimetres of the file's unit.

    Raises:
        CameraError: naming the file and every camera that does not fit.
    """
    path = Path(path)
    check_unit(unit_mm)
    where = str(path)
    storage = _open(path)
    keys = _keys(storage.root())
    if "Ks" in keys:
        return _multiview(storage, where, unit_mm)
    if "camera_matrix" in keys:
        return _single(storage, path)
    if {"M1", "D1", "M2", "D2"} <= keys:
        return _stereo(storage, path, unit_mm)
    raise CameraError(f"{where}: expected {_LAYOUTS}; found {', '.join(sorted(keys)[:8])}")


def write_opencv(path: Path, cameras: CameraArray, unit_mm: float = 1.0) -> None:
    """Write the array in the layout of OpenCV's multi-view calibration sample.

    Args:
        path: .yml, .yaml or .xml, replaced whole or not at all.
        cameras: the array.
        unit_mm: millimetres of the file's unit.

    Raises:
        CameraError: when the suffix is none of these.
    """
    path = Path(path)
    check_unit(unit_mm)
    suffix = path.suffix.lower()
    if suffix not in (".yml", ".yaml", ".xml"):
        raise CameraError(f"{path}: cv2.FileStorage writes .yml, .yaml or .xml")
    array = scaled(cameras, 1.0 / unit_mm)
    storage = cv2.FileStorage(
        ".xml" if suffix == ".xml" else ".yml",
        cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY,
    )
    storage.write("cam_ids", ",".join(array.names))
    sizes = [[camera.width, camera.height] for camera in array]
    storage.write("image_sizes", np.array(sizes, dtype=np.int32))
    storage.write("models", np.zeros((len(array), 1), dtype=np.int32))
    storage.write("Ks", np.stack([camera.matrix for camera in array]))
    storage.write("distortions", np.stack([camera.distortion for camera in array]))
    storage.write("Rs", np.stack([camera.camera_from_world.rotation for camera in array]))
    storage.write("Ts", np.stack([camera.camera_from_world.translation for camera in array]))
    text = storage.releaseAndGetString()
    with replacing(path) as partial_path:
        partial_path.write_text(text, encoding="utf-8")


def _open(path: Path) -> cv2.FileStorage:
    text = read_text(path, _LIMIT)
    if text.lstrip().startswith("<"):
        parse_xml(text.encode(), str(path))  # cv2 overruns its stack on nesting without end
    elif not text.startswith("%YAML"):
        raise CameraError(
            f"{path}: expected %YAML or <?xml at the start, as cv2.FileStorage writes"
        )
    elif _depth(text) > _DEEPEST:
        raise CameraError(f"{path}: nested more than {_DEEPEST} levels deep")
    storage = cv2.FileStorage()
    try:
        opened = storage.open(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    except (cv2.error, SystemError, UnicodeError, ValueError) as error:
        said = str(error).splitlines()[0].rpartition("error: ")[2]
        raise CameraError(f"{path}: not readable by cv2.FileStorage: {said}") from error
    if not opened or not storage.root().isMap():
        raise CameraError(f"{path}: expected {_LAYOUTS}; found no names at the top level")
    return storage


def _depth(text: str) -> int:
    signs = np.frombuffer(text.encode(), dtype=np.uint8)
    opened = np.isin(signs, np.frombuffer(b"[{", dtype=np.uint8)).astype(np.int64)
    closed = np.isin(signs, np.frombuffer(b"]}", dtype=np.uint8)).astype(np.int64)
    brackets = int(np.cumsum(opened - closed).max(initial=0))
    dashes = max((len(run) // 2 for run in re.findall(r"(?:-[ \t]+){2,}", text)), default=0)
    indents = {len(space) for space in re.findall(r"^ *", text, flags=re.MULTILINE)}
    return max(brackets, dashes, len(indents))


def _multiview(storage: cv2.FileStorage, where: str, unit_mm: float) -> CameraArray:
    matrices = _flat(storage, "Ks", where)
    count = len(matrices) // 9
    if count == 0 or len(matrices) != 9 * count:
        raise CameraError(f"{where}: Ks must hold 3 x 3 numbers a camera, found {len(matrices)}")
    bends = _flat(storage, "distortions", where)
    places = numbers(_flat(storage, "Ts", where), 3 * count, f"{where}: Ts")
    turned = "Rs" if "Rs" in _keys(storage.root()) else "rvecs"
    turns = _flat(storage, turned, where)
    sizes = numbers(_flat(storage, "image_sizes", where), 2 * count, f"{where}: image_sizes")
    for key, values in (("distortions", bends), (turned, turns)):
        if len(values) % count:
            raise CameraError(
                f"{where}: {key} holds {len(values)} numbers, which {count} cameras cannot share"
            )
    fish = next((key for key in ("models", "is_fisheye") if key in _keys(storage.root())), "")
    fishes = _flat(storage, fish, where) if fish else [0.0] * count
    names = _names(storage, count, where)

    def make(at: int) -> Camera:
        if at < len(fishes) and fishes[at] != 0:
            raise CameraError("a fisheye lens; calibrate it again with the pinhole model")
        turn = _rotation(_part(turns, at, count))
        place = rigid(np.column_stack([turn, _part(places, at, count)]), unit_mm, f"{turned}, Ts")
        size = (sizes[2 * at], sizes[2 * at + 1])
        return _lens(_part(matrices, at, count), _part(bends, at, count), size).camera(
            names[at], place
        )

    return gather(where, [(names[at], partial(make, at)) for at in range(count)])


def _single(storage: cv2.FileStorage, path: Path) -> CameraArray:
    where = str(path)
    node = storage.getNode("camera_name")
    name = node.string() if node.isString() else path.stem

    def make() -> Camera:
        if _scalar(storage, "fisheye_model", where) != 0:
            raise CameraError("a fisheye lens; calibrate it again with the pinhole model")
        matrix = numbers(_flat(storage, "camera_matrix", where), 9, "camera_matrix")
        bend = _flat(storage, "distortion_coefficients", where)
        return _lens(matrix, bend, _size(storage, where)).camera(name, Pose.identity())

    return gather(where, [(name, make)])


def _stereo(storage: cv2.FileStorage, path: Path, unit_mm: float) -> CameraArray:
    beside = path.with_name(f"extrinsics{path.suffix}")
    place = storage
    if "R" not in _keys(storage.root()) and beside.is_file() and beside != path:
        place = _open(beside)
    where = str(path)
    if not {"R", "T"} <= _keys(place.root()):
        raise CameraError(f"{where}: no R and T, here or in {beside.name} beside it")
    if _size(storage, where)[0] == 0:
        raise CameraError(
            f"{where}: the stereo sample stores no image size; add image_width and image_height"
        )

    def make(name: str, key: str, pose: Callable[[], Pose]) -> Camera:
        matrix = numbers(_flat(storage, f"M{key}", where), 9, f"M{key}")
        lens = _lens(matrix, _flat(storage, f"D{key}", where), _size(storage, where))
        return lens.camera(name, pose())

    def right() -> Pose:
        turn = _rotation(_flat(place, "R", where))
        move = numbers(_flat(place, "T", where), 3, "T")
        return rigid(np.column_stack([turn, move]), unit_mm, "R, T")

    makers = [("left", "1", Pose.identity), ("right", "2", right)]
    return gather(where, [(name, partial(make, name, key, at)) for name, key, at in makers])


def _lens(matrix: Sequence[float], bend: Sequence[float], size: tuple[float, float]) -> Lens:
    k = [number(value, "K") for value in matrix]
    if k[3] != 0 or k[6:] != [0.0, 0.0, 1.0]:
        raise CameraError(f"K must be [[fx,0,cx],[0,fy,cy],[0,0,1]], found {k}")
    if len(bend) not in _COUNTS:
        raise CameraError(f"expected {_COUNTS} distortion coefficients, found {len(bend)}")
    found = numbers(list(bend), len(bend), "distortion")
    return Lens(
        width=whole(size[0], "image width"), height=whole(size[1], "image height"),
        focal_px=(k[0], k[4]), centre_px=(k[2], k[5]),
        distortion={**dict(zip(_COEFFICIENTS, found, strict=False)), "skew": k[1]},
    )  # fmt: skip


def _rotation(values: Sequence[float]) -> Floats:
    if len(values) == 3:
        if not max(abs(value) for value in values) < _LARGEST_TURN:  # NaN too
            raise CameraError(f"expected a rotation vector in radians, found {values}")
        return Pose.from_rotation_vector(np.array(values), np.zeros(3)).rotation
    return np.array(numbers(list(values), 9, "a rotation")).reshape(3, 3)


def _part(values: Sequence[float], at: int, count: int) -> list[float]:
    each = len(values) // count
    return list(values[at * each : (at + 1) * each])


def _names(storage: cv2.FileStorage, count: int, where: str) -> list[str]:
    node = storage.getNode("cam_ids")
    if node.isString():
        names = [word.strip() for word in node.string().split(",")]
    elif node.isSeq():
        parts = [node.at(at) for at in range(min(node.size(), _MOST))]
        names = [p.string() if p.isString() else f"{p.real():g}" for p in parts]
    else:
        names = [f"cam{at}" for at in range(count)]
    if len(names) != count:
        raise CameraError(f"{where}: cam_ids names {len(names)} cameras, Ks holds {count}")
    return names


def _size(storage: cv2.FileStorage, where: str) -> tuple[float, float]:
    return _scalar(storage, "image_width", where), _scalar(storage, "image_height", where)


def _scalar(storage: cv2.FileStorage, key: str, where: str) -> float:
    """The number called `key`; 0 when there is none."""
    node = storage.getNode(key)
    if node.empty():
        return 0.0
    if not (node.isInt() or node.isReal()):
        raise CameraError(f"{where}: {key} must be a number")
    return float(node.real())


def _keys(node: cv2.FileNode) -> set[str]:
    return set(node.keys())


def _flat(storage: cv2.FileStorage, key: str, where: str) -> list[float]:
    """The numbers of a matrix, row by row, without trust in the size it claims to have."""
    node = storage.getNode(key)
    if node.empty():
        raise CameraError(f"{where}: missing {key}; expected {_LAYOUTS}")
    if node.isMap():
        node = node.getNode("data")
    if not node.isSeq() or node.size() > _MOST:
        raise CameraError(f"{where}: {key} must be a matrix of at most {_MOST} numbers")
    found = [node.at(at) for at in range(node.size())]
    if not all(part.isInt() or part.isReal() for part in found):
        raise CameraError(f"{where}: {key} must hold numbers")
    return [float(part.real()) for part in found]
