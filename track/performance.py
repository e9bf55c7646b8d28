"""`Performance`: one mesh's vertices through time, with confidence, and its file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from capture.archive import read_archive, write_archive
from capture.arrays import Floats, Floats32, Ints, Ints32, check_shape
from capture.errors import ShapeError

_KEYS = ("vertices", "confidence", "polygons", "frames", "head_from_neutral", "reference")


@dataclass(frozen=True, eq=False, kw_only=True)
class Performance:
    """A tracked take in the neutral's topology.

    Attributes:
        vertices: (F, V, 3) float32, world mm.
        confidence: (F, V) float32 in 0..1; 0 where nothing was seen and the prior carried it.
        polygons: (P, 4) int32; -1 pads a triangle.
        frames: (F,) int64 frame numbers of the take.
        head_from_neutral: (F, 4, 4) float64 rigid head motion from the neutral's place.
        reference: (F,) int64 the frame each was matched to; -1 is the neutral.
    """

    vertices: Floats32
    confidence: Floats32
    polygons: Ints32
    frames: Ints
    head_from_neutral: Floats
    reference: Ints

    def __post_init__(self) -> None:
        check_shape(
            vertices=(self.vertices, "F V 3"),
            confidence=(self.confidence, "F V"),
            polygons=(self.polygons, "P 4"),
            frames=(self.frames, "F"),
            head_from_neutral=(self.head_from_neutral, "F 4 4"),
            reference=(self.reference, "F"),
        )
        if self.polygons.size and int(self.polygons.max()) >= self.vertices.shape[1]:
            raise ShapeError(
                f"polygons: indices must be below the {self.vertices.shape[1]} vertices, "
                f"found {int(self.polygons.max())}"
            )

    def stabilised(self) -> Performance:
        """The same with the head held still: every frame moved back to the neutral's place.

        Its `head_from_neutral` is the one that was taken out, so that nothing is lost.
        """
        turned = self.head_from_neutral[:, :3, :3]
        away = self.vertices - self.head_from_neutral[:, None, :3, 3]
        still = np.einsum("fvx,fxy->fvy", away, turned).astype(np.float32)
        return replace(self, vertices=still)


def read_performance(path: Path) -> Performance:
    """Read performance.npz; nothing in it is unpickled.

    Raises:
        InputError: naming the file, and the key or shape that does not fit.
    """
    arrays = read_archive(path, required=_KEYS)
    try:
        return Performance(
            vertices=arrays["vertices"].astype(np.float32),
            confidence=arrays["confidence"].astype(np.float32),
            polygons=arrays["polygons"].astype(np.int32),
            frames=arrays["frames"].astype(np.int64),
            head_from_neutral=arrays["head_from_neutral"].astype(np.float64),
            reference=arrays["reference"].astype(np.int64),
        )
    except ShapeError as error:
        raise ShapeError(f"{path}: {error}") from error


def write_performance(path: Path, performance: Performance) -> None:
    """Write performance.npz, whole or not at all, the same bytes for the same arrays."""
    write_archive(path, {key: getattr(performance, key) for key in _KEYS})
