"""COLMAP model folders before COLMAP reads them: are the files whole, and whose are the images?

COLMAP's reader of binary models trusts every count in the file: one cut short, or of hostile make,
lets it run without end. So the records are walked here first, and what does not fit is refused.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath

from capture.errors import CameraError, raise_all
from capture.names import is_plain_name

_REQUIRED = ("cameras", "images", "points3D")
_PARAMETERS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16)  # by COLMAP's number of the camera model
_POSE = 7 * 8  # a quaternion and a translation
_POINT_LEAST = 8 + 3 * 8 + 3 + 8 + 8  # a point in space without a track
_TEXT_LIMIT = 1 << 30
_SHOWN = 4  # names that a message lists
_IMAGE_FIELDS = 10  # of a line of images.txt: number, pose, camera, name


def check_model_files(folder: Path) -> None:
    """Refuse a folder that holds no COLMAP model, or one whose files are not whole.

    Binary files win over text files where both stand, as in COLMAP.

    Args:
        folder: holding cameras, images and points3D (rigs and frames too, since COLMAP 3.12) as
            .bin or .txt.

    Raises:
        CameraError: naming the folder and every file that is cut short or damaged.
    """
    folder = Path(folder)
    for suffix in (".bin", ".txt"):
        if all((folder / f"{name}{suffix}").is_file() for name in _REQUIRED):
            break
    else:
        raise CameraError(
            f"{folder}: expected a COLMAP model: cameras, images and points3D, all .bin or all .txt"
        )
    problems = []
    for name, walk in _WALKS.items():
        path = folder / f"{name}{suffix}"
        if not path.is_file():
            continue
        try:
            if suffix == ".bin":
                _walk(path, walk)
            elif path.stat().st_size > _TEXT_LIMIT:
                raise ValueError("larger than 1 GiB")
            elif name == "images":
                _check_image_names(path)
        except (struct.error, ValueError) as error:
            problems.append(f"{path.name}: not readable as a COLMAP model: {error}")
        except OSError as error:
            problems.append(f"{path.name}: {error.strerror or error}")
    raise_all(str(folder), problems, CameraError)


def check_replaceable(folder: Path) -> None:
    """Refuse to replace a folder that holds more than the files of a COLMAP model.

    Raises:
        CameraError: naming the folder and what it holds.
    """
    folder = Path(folder)
    if not folder.is_dir():
        return
    known = {f"{name}{suffix}" for name in _WALKS for suffix in (".bin", ".txt")}
    try:
        others = sorted({entry.name for entry in folder.iterdir()} - known)
    except OSError as error:
        raise CameraError(f"{folder}: not readable: {error.strerror or error}") from error
    if others:
        more = " ..." if len(others) > _SHOWN else ""
        raise CameraError(
            f"{folder}: holds {', '.join(others[:_SHOWN])}{more}, which a model in its place "
            f"would delete; choose a folder that does not exist, as {folder / 'sparse'}"
        )


def name_images(
    images: Sequence[tuple[str, int]], where: str, *, one_rig: bool = False
) -> list[str]:
    """The name of the camera that took each image.

    A camera is named after the folder its images lie in, or, when all images lie in one folder,
    after its image. In a rig each sensor is one camera, whatever the number of its images; where
    neither folders nor images tell the sensors apart they are camera1, camera2 and so on.

    Args:
        images: by image, its path in the model and COLMAP's number of its camera.
        where: the model, for messages.
        one_rig: whether all images were taken by the sensors of one rig.

    Raises:
        CameraError: listing the names that are not plain.
    """
    paths = [PurePosixPath(name.replace("\\", "/")) for name, _ in images]
    flat = len({path.parent for path in paths}) == 1 and len(paths) > 1
    stems = [path.stem for path in paths]
    folders = [path.parent.name or path.stem for path in paths]
    names = stems if flat else folders
    if one_rig:
        sensors = [camera for _, camera in images]
        numbered = [f"camera{camera}" for camera in sensors]
        choices = (stems,) if flat else (folders, stems)
        names = next((c for c in choices if _tells_apart(c, sensors)), numbered)
    wrong = sorted({name for name in names if not is_plain_name(name)})
    plain = "letters, digits, '-', '_' or '.', at most 64"
    raise_all(
        where,
        [f"{name!r}, the folder of a camera's images, must be {plain}" for name in wrong],
        CameraError,
    )
    return names


def _check_image_names(path: Path) -> None:
    """Refuse names with spaces in images.txt: COLMAP cuts them short without a word."""
    with path.open(encoding="utf-8", errors="replace") as lines:
        for line in lines:
            words = line.split(maxsplit=_IMAGE_FIELDS - 1)
            if not words or words[0].startswith("#"):
                continue
            if len(words) == _IMAGE_FIELDS and len(words[-1].split()) > 1:
                raise ValueError(
                    f"the image name {words[-1].strip()!r} has spaces, where COLMAP cuts it in "
                    "text files; rename the images and their folders"
                )
            next(lines, None)  # the points seen in that image


def _tells_apart(names: Sequence[str], sensors: Sequence[int]) -> bool:
    pairs = set(zip(names, sensors, strict=True))
    return len(pairs) == len(set(names)) == len(set(sensors))


def _walk(path: Path, record: Callable[[mmap.mmap, int], int]) -> None:
    size = path.stat().st_size
    if size < 8:
        raise ValueError(f"{size} bytes, cut short")
    with path.open("rb") as handle, mmap.mmap(handle.fileno(), 0, access=mmap.ACCESS_READ) as data:
        (count,) = struct.unpack_from("<Q", data, 0)
        if count > size:
            raise ValueError(f"says it holds {count} records, in {size} bytes")
        at = 8
        for number in range(count):
            at = record(data, at)
            if at > size:
                raise ValueError(f"cut short in record {number + 1} of {count}")


def _camera(data: mmap.mmap, at: int) -> int:
    model = struct.unpack_from("<IiQQ", data, at)[1]
    if not 0 <= model < len(_PARAMETERS):
        raise ValueError(f"camera model number {model} is not known")
    return at + 24 + 8 * _PARAMETERS[model]


def _image(data: mmap.mmap, at: int) -> int:
    name = at + 4 + _POSE + 4
    end = data.find(b"\0", name)
    if end < 0:
        raise ValueError("cut short in the name of an image")
    (points,) = struct.unpack_from("<Q", data, end + 1)
    return end + 9 + 24 * int(points)


def _rig(data: mmap.mmap, at: int) -> int:
    (sensors,) = struct.unpack_from("<I", data, at + 4)
    at += 8
    for place in range(sensors):
        if place == 0:
            struct.unpack_from("<iI", data, at)
            at += 8
        else:
            placed = struct.unpack_from("<iIB", data, at)[2]
            at += 9 + (_POSE if placed else 0)
    return at


def _frame(data: mmap.mmap, at: int) -> int:
    (count,) = struct.unpack_from("<I", data, at + 8 + _POSE)
    return at + 12 + _POSE + 16 * int(count)


def _point(data: mmap.mmap, at: int) -> int:
    (track,) = struct.unpack_from("<Q", data, at + _POINT_LEAST - 8)
    return at + _POINT_LEAST + 8 * int(track)


_WALKS: dict[str, Callable[[mmap.mmap, int], int]] = {
    "cameras": _camera,
    "images": _image,
    "points3D": _point,
    "rigs": _rig,
    "frames": _frame,
}
