"""Faults of a take, made from a good one's images: what tracking has to bear, or to flag.

A visiting take with truth is written again with devices gone, every other frame gone (so that all
moves twice as far from frame to frame), frames blurred, light that flickers, a device that runs a
frame late, or a neutral that is not quite on the skin. Nothing is rendered; the first frame stays
as it was, as a take's neutral is chosen.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from capture.archive import read_archive, write_archive
from capture.arrays import Floats, Image
from capture.camera import CameraArray
from capture.camera_file import read_cameras, write_cameras
from capture.errors import TakeError, WorkError
from recon.mesh import Mesh, read_obj, vertex_normals, write_obj

_BLUR = 3.0 / 1024.0  # standard deviation over the width of the image
_BLURRED, _FLICKER, _SEED = 0.10, 0.12, 23
_OFF_MM, _WAVE_MM = 0.2, np.array([45.0, 60.0, 80.0])

ReadImage = Callable[[str, int], Image]


@dataclass(frozen=True, eq=False, kw_only=True)
class TakeFault:
    """One fault.

    Attributes:
        words: what it is.
        gone: devices without images.
        step: every how manieth frame stays.
        off_mm: how far the neutral lies off the skin, rms, in smooth bumps; the truth then keeps
            that height over the skin.
        change: the image of a device (name) and frame, given all images; None leaves it.
    """

    words: str
    gone: tuple[str, ...] = ()
    step: int = 1
    off_mm: float = 0.0
    change: Callable[[ReadImage, str, int], Image] | None = None


def take_faults(names: Sequence[str], frame_count: int) -> list[TakeFault]:
    """The faults that a take of these devices is tried with."""
    rng = np.random.default_rng(_SEED)
    middle = len(names) // 2
    pair = tuple(names[index] for index in sorted(rng.choice(len(names), 2, replace=False)))
    four = tuple(names[middle - 2 : middle + 2])
    count = max(1, round(_BLURRED * frame_count))
    soft = 1 + rng.choice(frame_count - 1, min(count, frame_count - 1), replace=False)
    gains = 1.0 + rng.uniform(-_FLICKER, _FLICKER, frame_count)
    gains[0] = 1.0
    late = names[middle - 1]
    return [
        TakeFault(words="two views missing", gone=pair),
        TakeFault(words="four views missing", gone=four),
        TakeFault(words="motion doubled", step=2),
        TakeFault(words="blurred frames", change=_blurring(frozenset(soft.tolist()))),
        TakeFault(words="flickering light", change=_flickering(gains.tolist())),
        TakeFault(words="one device a frame late", change=_delaying(late)),
        TakeFault(words="neutral off the skin", off_mm=_OFF_MM),
    ]


def write_faulty(source: Path, out: Path, fault: TakeFault) -> None:
    """Write a visiting take with the fault, its neutral, and its truth.

    Args:
        source: a visiting take with cameras.json, neutral.obj and truth.npz.
        out: the folder to make.
        fault: what to do.

    Raises:
        TakeError: when an image cannot be read.
        WorkError: when one cannot be written.
    """
    cameras = read_cameras(source / "cameras.json")
    kept = CameraArray(tuple(camera for camera in cameras if camera.name not in fault.gone))
    truth = read_archive(source / "truth.npz", ["vertices", "faces"], ["face_region"])

    def read(name: str, frame: int) -> Image:
        return _read(source / name / f"{frame:04d}.png")

    for camera in kept:
        (out / camera.name).mkdir(parents=True)
        for place, frame in enumerate(range(0, len(truth["vertices"]), fault.step)):
            path = out / camera.name / f"{place:04d}.png"
            if fault.change is None:
                shutil.copyfile(source / camera.name / f"{frame:04d}.png", path)
            elif not cv2.imwrite(str(path), fault.change(read, camera.name, frame)):
                raise WorkError(f"{path}: cannot be written")
    write_cameras(out / "cameras.json", kept)
    mesh = read_obj(source / "neutral.obj")
    placed = _lifted(truth["vertices"][:: fault.step].astype(np.float64), mesh, fault.off_mm)
    write_obj(out / "neutral.obj", mesh.with_vertices(placed[0]))
    write_archive(out / "truth.npz", {**truth, "vertices": placed.astype(np.float32)})


def flagged_frames(report: Path) -> list[int] | None:
    """The frames that a track's report flags; None when it flags none because it cannot."""
    rows = json.loads(report.read_text(encoding="utf-8"))["frames"]
    if not any("flagged" in row for row in rows):
        return None
    return [int(row["frame"]) for row in rows if row.get("flagged")]


def flagging(bad: Sequence[bool], flagged: Sequence[bool]) -> dict[str, float]:
    """How well flags tell bad frames: counts, recall and precision, 1 where nothing was to tell."""
    hits = sum(one and other for one, other in zip(bad, flagged, strict=True))
    return {
        "frames": len(bad),
        "bad": sum(bad),
        "flagged": sum(flagged),
        "recall": round(hits / sum(bad), 3) if any(bad) else 1.0,
        "precision": round(hits / sum(flagged), 3) if any(flagged) else 1.0,
    }


def _lifted(frames: Floats, mesh: Mesh, off_mm: float) -> Floats:
    """Each frame's vertices (F, V, 3) off the skin along its normals, by bumps fixed to it."""
    height = off_mm * np.sqrt(2.0) * np.sin((frames[0] * (2.0 * np.pi / _WAVE_MM)).sum(axis=1))
    normals = [np.nan_to_num(vertex_normals(frame, mesh.triangles)) for frame in frames]
    lifted: Floats = frames + height[:, None] * np.stack(normals)
    return lifted


def _blurring(frames: frozenset[int]) -> Callable[[ReadImage, str, int], Image]:
    def change(read: ReadImage, name: str, frame: int) -> Image:
        image = read(name, frame)
        if frame not in frames:
            return image
        return np.asarray(cv2.GaussianBlur(image, (0, 0), _BLUR * image.shape[1]), image.dtype)

    return change


def _flickering(gains: Sequence[float]) -> Callable[[ReadImage, str, int], Image]:
    def change(read: ReadImage, name: str, frame: int) -> Image:
        image = read(name, frame)
        top = np.iinfo(image.dtype).max
        lit: Image = np.clip(np.rint(image * gains[frame]), 0, top).astype(image.dtype)
        return lit

    return change


def _delaying(late: str) -> Callable[[ReadImage, str, int], Image]:
    def change(read: ReadImage, name: str, frame: int) -> Image:
        return read(name, max(frame - 1, 0) if name == late else frame)

    return change


def _read(path: Path) -> Image:
    found = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if found is None:
        raise TakeError(f"{path}: no such picture")
    image: Image = np.asarray(found)
    return image
