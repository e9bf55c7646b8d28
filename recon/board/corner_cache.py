"""Corners found once are kept beside the take, one small file an image.

::

    TAKE/products/corners/<search>/<device>/000017.json

`<search>` is a digest of the board file and of the code that searches; an entry also names the
image it was made from, by the check sum that stands in the frame's header, so that on a hit no
pixel is read. Limits are no part of it: they are judged anew each time. An entry is written whole
or not at all and carries a check sum of its own: one that is damaged counts as missing.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from capture.arrays import Floats, Ints
from capture.errors import TakeError
from capture.product import replacing
from capture.take import Take
from recon.board.body import BoardBody, FlatBoard
from recon.board.corners import CornerFinds, FaceCorners

# The modules of this package whose code decides what is found.
_SEARCHERS = ("corners", "marker_search", "marker_dictionary", "charuco", "april_grid", "../images")
_LONGEST_BYTES = 1 << 24


class CornerCache:
    """The corners that earlier runs found in the images of one take.

    Attributes:
        folder: where the entries stand.
        fault: why entries cannot be kept, or ""; nothing is lost but time.
    """

    def __init__(self, take: Take, board: FlatBoard | BoardBody) -> None:
        """Prepare the cache of a take; nothing is read or written yet.

        Args:
            take: whose images are searched.
            board: what is searched for.
        """
        body = board if isinstance(board, BoardBody) else BoardBody.of(board)
        self._take = take
        self._counts = [face.board.corner_count for face in body.faces]
        self.folder = take.products / "corners" / _search_digest(body)
        self.fault = ""
        self._identities: dict[str, dict[int, str]] = {}

    def load(self, device: str, frame: int) -> CornerFinds | None:
        """What was found in an image, or None when that must be done (again).

        Args:
            device: the device's name.
            frame: the frame number, of a frame that is not lost.

        Raises:
            TakeError: when that frame was lost.
        """
        identity = self._identity(device, frame)
        path = self._path(device, frame)
        try:
            if not path.is_file() or path.stat().st_size > _LONGEST_BYTES:
                return None
            seal, _, text = path.read_text(encoding="ascii").partition("\n")
            if seal != hashlib.sha256(text.encode()).hexdigest():
                return None
            entry = json.loads(text)
            return self._finds(entry) if entry["image"] == identity else None
        except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
            return None  # damaged: done again

    def store(self, device: str, frame: int, finds: CornerFinds) -> None:
        """Keep what was found in an image; a full or read-only disk is told by `fault`.

        Args:
            device: the device's name.
            frame: the frame number.
            finds: what the detector found.

        Raises:
            TakeError: when that frame was lost.
        """
        identity = self._identity(device, frame)
        if self.fault:
            return
        entry = {
            "image": identity,
            "faces": [
                {
                    "ids": face.ids.tolist(),
                    "pixels": face.pixels.tolist(),
                    "blur_px": _plain(face.blur_px),
                }
                for face in finds.faces
            ],
            "ends": finds.ends.tolist(),
            "end_pixels": finds.end_pixels.tolist(),
        }
        text = json.dumps(entry, allow_nan=False)
        seal = hashlib.sha256(text.encode()).hexdigest()
        try:
            with replacing(self._path(device, frame)) as partial:
                partial.write_text(f"{seal}\n{text}", encoding="ascii")
        except OSError as error:
            self.fault = f"{self.folder}: {error.strerror or error}"

    def _path(self, device: str, frame: int) -> Path:
        return self.folder / device / f"{frame:06d}.json"

    def _identity(self, device: str, frame: int) -> str:
        """Size, type and check sum of an image, from the index of its file."""
        if device not in self._identities:
            reader = self._take.reader(device)
            self._identities[device] = {
                header.trigger_index: f"{reader.layout} {header.pixel_crc:08x}"
                for header in reader.headers
                if header.status == 0
            }
        if frame not in self._identities[device]:
            raise TakeError(f"{self._take.folder}: frame {frame} of {device} was lost")
        return self._identities[device][frame]

    def _finds(self, entry: dict[str, Any]) -> CornerFinds:
        if len(entry["faces"]) != len(self._counts):
            raise ValueError("another number of faces")
        faces = []
        for face, count in zip(entry["faces"], self._counts, strict=True):
            ids, pixels = _sightings(face["ids"], face["pixels"], count)
            blur = face["blur_px"]
            faces.append(FaceCorners(ids, pixels, _number(blur) if len(ids) else float("nan")))
        return CornerFinds(tuple(faces), *_sightings(entry["ends"], entry["end_pixels"], 2))


def _sightings(ids: Any, pixels: Any, count: int) -> tuple[Ints, Floats]:
    if not all(type(number) is int for number in ids):
        raise ValueError("ids that are no whole numbers")
    where = np.array(pixels, dtype=np.float64).reshape(-1, 2)
    which = np.array(ids, dtype=np.int64)
    if len(where) != len(which) or not np.isfinite(where).all():
        raise ValueError("pixels that do not fit the ids")
    if len(which) and (which[0] < 0 or which[-1] >= count or (np.diff(which) <= 0).any()):
        raise ValueError("ids that are not of this board")
    return which, where


def _number(value: Any) -> float:
    return float("inf") if value is None else float(value)


def _plain(blur_px: float) -> float | None:
    return blur_px if np.isfinite(blur_px) else None


def _search_digest(body: BoardBody) -> str:
    """A digest of all that decides what is found in an image."""
    digest = hashlib.sha256(f"OpenCV {cv2.__version__}\n".encode())
    here = Path(__file__).parent
    for name in _SEARCHERS:
        digest.update(name.encode() + b"\0" + (here / f"{name}.py").read_bytes())
    shape = [dataclasses.asdict(face.board) for face in body.faces]
    bar = None if body.scale_bar is None else dataclasses.asdict(body.scale_bar)
    digest.update(json.dumps([shape, bar], sort_keys=True).encode())
    return digest.hexdigest()[:16]
