"""What the readers and writers of foreign camera files share: bytes, numbers, lenses, units.

A foreign lens that Brown-Conrady k1 k2 p1 p2 k3 without skew cannot hold is refused by name;
nothing of it is dropped. The same holds the other way for a format that knows fewer terms.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from capture.arrays import Floats
from capture.camera import Camera, CameraArray
from capture.errors import CameraError, LikenessError, raise_all
from capture.names import is_plain_name
from capture.pose import Pose

TERMS = ("k1", "k2", "p1", "p2", "k3")
"""The distortion terms of our camera, in its order."""
_HELD = "likeness holds fx fy cx cy k1 k2 p1 p2 k3 without skew"
_FARTHEST_MM = 1e12
_UNITS_MM = (1e-6, 1e9)
_SHOWN = 60  # characters of a wrong value that a message repeats


@dataclass(frozen=True, kw_only=True)
class Lens:
    """A lens as a foreign file has it, in OpenCV's terms.

    Attributes:
        width: image columns, px.
        height: image rows, px.
        focal_px: focal lengths fx, fy.
        centre_px: principal point cx, cy, centre of the first pixel at 0.
        distortion: terms by name; those that our camera has no place for must be 0.
    """

    width: int
    height: int
    focal_px: tuple[float, float]
    centre_px: tuple[float, float]
    distortion: dict[str, float]

    def camera(self, name: str, camera_from_world: Pose) -> Camera:
        """Our camera with this lens.

        Raises:
            CameraError: naming every term that is not 0 and has no place in our camera.
        """
        over = {
            term: value
            for term, value in self.distortion.items()
            if term not in TERMS and value != 0  # NaN included
        }
        if over:
            found = ", ".join(f"{term} = {value:g}" for term, value in over.items())
            raise CameraError(
                f"{name}: the lens has {found}; {_HELD}: calibrate it again with these fixed at 0"
            )
        return Camera(
            name=name, width=self.width, height=self.height,
            fx=self.focal_px[0], fy=self.focal_px[1], cx=self.centre_px[0], cy=self.centre_px[1],
            distortion=np.array([self.distortion.get(term, 0.0) for term in TERMS]),
            camera_from_world=camera_from_world,
        )  # fmt: skip


def read_bytes(path: Path, limit: int) -> bytes:
    """The bytes of a file of at most `limit` bytes.

    Raises:
        CameraError: naming the file, when it is missing, unreadable or larger.
    """
    try:
        with Path(path).open("rb") as handle:
            found = handle.read(limit + 1)
    except FileNotFoundError as error:
        raise CameraError(f"{path}: no such file") from error
    except OSError as error:
        raise CameraError(f"{path}: not readable: {error.strerror or error}") from error
    if len(found) > limit:
        raise CameraError(
            f"{path}: larger than {limit} bytes, which no file of cameras of this kind is"
        )
    return found


def read_text(path: Path, limit: int) -> str:
    """The text of a UTF-8 file of at most `limit` bytes; errors as of `read_bytes`."""
    try:
        return read_bytes(path, limit).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise CameraError(f"{path}: expected text in UTF-8, found {error.reason}") from error


def number(value: Any, what: str) -> float:
    """A finite number, which may be written as text (YAML reads `1e-5` as text).

    Raises:
        CameraError: naming `what` and what was found.
    """
    try:
        if isinstance(value, bool) or not isinstance(value, int | float | str):
            raise TypeError(type(value).__name__)
        found = float(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise CameraError(f"{what} must be a number, found {shown(value)}") from error
    if not math.isfinite(found):
        raise CameraError(f"{what} must be finite, found {shown(value)}")
    return found


def numbers(values: Any, count: int, what: str) -> list[float]:
    """`count` finite numbers of a list.

    Raises:
        CameraError: naming `what` and what was found.
    """
    if not isinstance(values, Sequence) or isinstance(values, str) or len(values) != count:
        raise CameraError(f"{what} must be a list of {count} numbers, found {shown(values)}")
    return [number(value, what) for value in values]


def whole(value: Any, what: str) -> int:
    """A whole number above 0, of px.

    Raises:
        CameraError: naming `what` and what was found.
    """
    found = number(value, what)
    if found < 1 or found != int(found) or found >= 2**31:
        raise CameraError(f"{what} must be a whole number of px above 0, found {shown(value)}")
    return int(found)


def rigid(matrix: Floats, unit_mm: float, what: str) -> Pose:
    """The motion of a (3, 4) or (4, 4) matrix whose translation is in units of `unit_mm`.

    Raises:
        CameraError: naming `what`, when the matrix is no rigid motion.
    """
    matrix = np.asarray(matrix, dtype=np.float64)
    if matrix.shape[0] == 4 and not np.array_equal(matrix[3], [0.0, 0.0, 0.0, 1.0]):
        raise CameraError(f"{what}: expected last row 0 0 0 1, found {matrix[3].tolist()}")
    if not np.abs(matrix[:3, :3]).max() <= 2.0:  # NaN too; beyond that its square may overflow
        raise CameraError(f"{what}: expected a rotation, found {matrix[:3, :3].tolist()}")
    if not np.abs(matrix[:3, 3]).max() <= _FARTHEST_MM / unit_mm:
        raise CameraError(f"{what}: a place beyond 1e12 mm, {matrix[:3, 3].tolist()}")
    try:
        return Pose(matrix[:3, :3], matrix[:3, 3] * unit_mm)
    except LikenessError as error:
        raise CameraError(f"{what}: {error}") from error


def check_unit(unit_mm: float, what: str = "unit_mm") -> None:
    """Refuse a unit that is no length between a nanometre and a thousand kilometres, in mm.

    Raises:
        CameraError: naming `what` and what was found.
    """
    if not _UNITS_MM[0] <= unit_mm <= _UNITS_MM[1]:
        raise CameraError(f"{what}: expected a number between 1e-6 and 1e9, found {unit_mm:g}")


def scaled(cameras: CameraArray, factor: float) -> CameraArray:
    """The array with every distance times `factor`, about the world's origin; lenses untouched."""
    return CameraArray(
        tuple(
            camera.posed(
                Pose(
                    camera.camera_from_world.rotation,
                    camera.camera_from_world.translation * factor,
                )
            )
            for camera in cameras
        )
    )


def gather(where: str, makers: Iterable[tuple[str, Callable[[], Camera]]]) -> CameraArray:
    """Make every camera, and the array of them, or tell in one message what does not fit.

    Args:
        where: the file, for the first line.
        makers: by camera, its name in the file and what makes it.

    Raises:
        CameraError: naming every camera that does not fit.
    """
    cameras: list[Camera] = []
    problems: list[str] = []
    for name, make in makers:
        if not is_plain_name(name):
            problems.append(
                f"{shown(name)}: a camera's name must be letters, digits, '-', '_' or '.', "
                "at most 64"
            )
            continue
        try:
            cameras.append(make())
        except LikenessError as error:
            said = str(error)
            problems.append(said if said.startswith(f"{name}:") else f"{name}: {said}")
    raise_all(where, problems, CameraError)
    if not cameras:
        raise CameraError(f"{where}: expected at least one camera, found none")
    try:
        return CameraArray(tuple(cameras))
    except CameraError as error:
        raise CameraError(f"{where}: {error}") from error


def refuse_terms(where: str, cameras: CameraArray, lacking: Sequence[str], instead: str) -> None:
    """Refuse to write lenses with terms that a format lacks.

    Args:
        where: the file to write.
        cameras: the array.
        lacking: terms of ours that the format has no place for.
        instead: what would be right.

    Raises:
        CameraError: naming every camera and term.
    """
    problems = [
        f"{camera.name}: {term} = {camera.distortion[TERMS.index(term)]:g} has no place in "
        f"this format; {instead}"
        for camera in cameras
        for term in lacking
        if camera.distortion[TERMS.index(term)] != 0
    ]
    raise_all(where, problems, CameraError)


def shown(value: Any) -> str:
    """A wrong value as a message repeats it: shortened, and never the text of a collection."""
    if isinstance(value, str | int | float | type(None)):
        text = repr(value)  # never of a collection: an alias may make its text endless
        return text if len(text) <= _SHOWN else f"{text[:_SHOWN]} ..."
    size = f" of {len(value)}" if hasattr(value, "__len__") else ""
    return f"a {type(value).__name__}{size}"
