"""A look at all of a visiting take before anything is written; every misfit is named."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from capture.camera import CameraArray
from capture.camera_file import read_cameras
from capture.errors import InputError, TakeError, raise_all
from capture.frame_header import ImageLayout
from capture.names import is_plain_name
from capture.product import hash_file
from capture.progress import Progress, silent
from recon.mesh import read_obj
from recon.png import check_png

_LISTED = 5  # how many of a long list a message names


@dataclass(frozen=True)
class VisitingDevice:
    """The images of one device of a visiting take, in the order of their numbers."""

    name: str
    files: tuple[Path, ...]
    layout: ImageLayout


@dataclass(frozen=True, eq=False)
class Visit:
    """A visiting take that fits together.

    Attributes:
        devices: in the order of the cameras, or of the folders when there are none.
        cameras: the calibrated array, or None.
        cameras_file: the cameras.json they were read from, or None.
        neutral: the actor's neutral OBJ, or None.
        first_number: the number of the first image file.
        hashes: SHA-256 of every file, by its path in the source.
    """

    devices: tuple[VisitingDevice, ...]
    cameras: CameraArray | None
    cameras_file: Path | None
    neutral: Path | None
    first_number: int
    hashes: dict[str, str]


def survey(source: Path, *, progress: Progress = silent) -> Visit:
    """Read and check every file of a visiting take, or of images with a COLMAP model.

    Args:
        source: the folder.
        progress: told after each device.

    Raises:
        TakeError: listing everything that does not fit.
    """
    if not source.is_dir():
        raise TakeError(
            f"{source}: expected a folder, found {'a file' if source.exists() else 'nothing'}"
        )
    problems: list[str] = []
    model = None if (source / "cameras.json").exists() else _sparse_model(source)
    cameras, cameras_file = _cameras(source, model, problems)
    groups = _image_groups(source / "images" if model else source, single=model is not None)
    if not groups:
        problems.append("no image found; expected a folder a camera with 0000.png, 0001.png, ...")
    names = _match_names(groups, cameras, problems)
    numbered = {name: _numbers(name, groups[name], problems) for name in names}
    first = _check_numbers(numbered, problems) if model is None or not _singles(groups) else 0
    neutral = source / "neutral.obj"
    hashes: dict[str, str] = {}
    if neutral.is_file():
        hashes["neutral.obj"] = hash_file(neutral)
        try:
            read_obj(neutral)
        except InputError as error:
            problems.append(str(error))
    devices = []
    for place, name in enumerate(names):
        files = tuple(numbered[name][number] for number in sorted(numbered[name]))
        layout = _check_images(source, name, files, hashes, problems)
        if layout is not None:
            devices.append(VisitingDevice(name, files, layout))
            if cameras is not None:
                _check_size(name, layout, cameras, problems)
        progress(place + 1, len(names), "check")
    raise_all(str(source), problems, TakeError)
    if cameras_file is not None:
        hashes["cameras.json"] = hash_file(cameras_file)
    if model is not None:
        hashes.update(
            {
                f"sparse/{path.name}": hash_file(path)
                for path in sorted(model.iterdir())
                if path.is_file()
            }
        )
    return Visit(
        tuple(devices), cameras, cameras_file, neutral if neutral.is_file() else None, first, hashes
    )


def _sparse_model(source: Path) -> Path | None:
    if not (source / "images").is_dir():
        return None
    for folder in (source / "sparse" / "0", source / "sparse"):
        if (folder / "cameras.bin").is_file() or (folder / "cameras.txt").is_file():
            return folder
    return None


def _cameras(
    source: Path, model: Path | None, problems: list[str]
) -> tuple[CameraArray | None, Path | None]:
    path = source / "cameras.json"
    try:
        if path.exists():
            return read_cameras(path), path
        if model is not None:
            from recon.colmap import read_model  # a slow import that only this case needs

            return read_model(model), None
    except InputError as error:
        problems.append(str(error))
    return None, None


def _image_groups(folder: Path, *, single: bool) -> dict[str, list[Path]]:
    groups: dict[str, list[Path]] = {}
    for entry in sorted(folder.iterdir()):
        if entry.name.startswith("."):
            continue
        if entry.is_dir():
            files = [path for path in sorted(entry.iterdir()) if _is_png(path)]
            if files:
                groups[entry.name] = files
        elif single and _is_png(entry):
            groups[entry.stem] = [entry]
    return groups


def _is_png(path: Path) -> bool:
    return path.suffix.lower() == ".png" and not path.name.startswith(".") and path.is_file()


def _singles(groups: dict[str, list[Path]]) -> bool:
    return all(files[0].stem == name for name, files in groups.items())


def _match_names(
    groups: dict[str, list[Path]], cameras: CameraArray | None, problems: list[str]
) -> list[str]:
    for name in groups:
        if not is_plain_name(name):
            problems.append(
                f"folder {name!r}: a camera's name must be letters, digits, '-', '_' or '.'"
            )
    if cameras is None:
        return list(groups)
    for name in cameras.names:
        if name not in groups:
            problems.append(f"camera {name}: its folder {name}/ with images is missing")
    for name in groups:
        if name not in cameras.names:
            problems.append(f"folder {name}/ holds images, and no camera is called {name}")
    return [name for name in cameras.names if name in groups]


def _numbers(name: str, files: Sequence[Path], problems: list[str]) -> dict[int, Path]:
    numbers: dict[int, Path] = {}
    if len(files) == 1 and files[0].stem == name:
        return {0: files[0]}
    for path in files:
        if not (path.stem.isascii() and path.stem.isdigit()):
            problems.append(f"{path}: expected a frame number as file name, like 0000.png")
            continue
        number = int(path.stem)
        if number in numbers:
            problems.append(
                f"{path}: frame {number} is there twice, also as {numbers[number].name}"
            )
        numbers[number] = path
    return numbers


def _check_numbers(numbered: dict[str, dict[int, Path]], problems: list[str]) -> int:
    together = sorted(set().union(*numbered.values()))
    if not together:
        return 0
    counts = Counter(len(numbers) for numbers in numbered.values())
    if len(counts) > 1:
        usual = counts.most_common(1)[0][0]
        parts = [f"{len(n)} in {name}" for name, n in numbered.items() if len(n) != usual]
        problems.append(
            f"frame counts differ: {usual} in {counts[usual]} cameras, {', '.join(parts)}"
        )
    there = set(together)
    nowhere = [n for n in _span(together) if n not in there]
    if nowhere:
        problems.append(f"no camera has frame {_listed(nowhere)}")
    for name, numbers in numbered.items():
        gaps = [n for n in together if n not in numbers]
        if gaps:
            problems.append(f"{name}: missing frame {_listed(gaps)}")
    return together[0]


def _span(numbers: Sequence[int]) -> range:
    # A stray file called 99999999.png must not make a list of that length.
    return range(numbers[0], min(numbers[-1], numbers[0] + 100_000) + 1)


def _listed(numbers: Sequence[int]) -> str:
    shown = ", ".join(f"{n:04d}" for n in numbers[:_LISTED])
    return shown if len(numbers) <= _LISTED else f"{shown} and {len(numbers) - _LISTED} more"


def _check_images(
    source: Path, name: str, files: Sequence[Path], hashes: dict[str, str], problems: list[str]
) -> ImageLayout | None:
    layouts: dict[ImageLayout, list[Path]] = {}
    for path in files:
        try:
            data = path.read_bytes()
            hashes[path.relative_to(source).as_posix()] = hashlib.sha256(data).hexdigest()
            layouts.setdefault(check_png(data, path), []).append(path)
        except TakeError as error:
            problems.append(str(error))
        except OSError as error:
            problems.append(f"{path}: not readable: {error.strerror}")
    if not layouts:
        return None
    usual = max(layouts, key=lambda layout: len(layouts[layout]))
    for layout, paths in layouts.items():
        if layout != usual:
            problems.append(
                f"{name}: mixed images: {usual} in {len(layouts[usual])} frames, "
                f"{layout} in {_listed_files(paths)}"
            )
    return usual


def _listed_files(paths: Sequence[Path]) -> str:
    shown = ", ".join(path.name for path in paths[:_LISTED])
    return shown if len(paths) <= _LISTED else f"{shown} and {len(paths) - _LISTED} more"


def _check_size(name: str, layout: ImageLayout, cameras: CameraArray, problems: list[str]) -> None:
    camera = cameras.by_name(name)
    if (camera.width, camera.height) != (layout.width, layout.height):
        problems.append(
            f"camera {name}: cameras say {camera.width} x {camera.height} px, "
            f"its images are {layout.width} x {layout.height} px"
        )
