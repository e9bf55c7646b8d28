"""`FaceRig`: an actor's neutral and shapes, solved weights and head motion, and its file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from capture.archive import read_archive, whole_numbers, write_archive
from capture.arrays import Floats, Ints32, check_finite, check_shape
from capture.errors import InputError, ShapeError, raise_all
from rig.template import duplicate_names, text_names

_REQUIRED = ("neutral", "deltas", "names", "polygons", "weights", "head_from_rig")


@dataclass(frozen=True, eq=False, kw_only=True)
class FaceRig:
    """A personalised rig with the performance it was solved on.

    `vertices[f] ~ head_from_rig[f] (neutral + sum_b weights[f, b] deltas[b])`, world mm.

    Attributes:
        neutral: (V, 3) float64, rig space (the template's place and axes), mm.
        deltas: (B, V, 3) float64, rig space, mm at weight 1.
        names: B names in the template's order.
        polygons: (P, 4) int32; -1 pads a triangle.
        weights: (F, B) float64 in 0..1.
        head_from_rig: (F, 4, 4) float64 rigid motions to world.
    """

    neutral: Floats
    deltas: Floats
    names: tuple[str, ...]
    polygons: Ints32
    weights: Floats
    head_from_rig: Floats

    def __post_init__(self) -> None:
        check_shape(
            neutral=(self.neutral, "V 3"),
            deltas=(self.deltas, "B V 3"),
            names=(np.asarray(self.names), "B"),
            polygons=(self.polygons, "P 4"),
            weights=(self.weights, "F B"),
            head_from_rig=(self.head_from_rig, "F 4 4"),
        )
        check_finite(neutral=self.neutral, deltas=self.deltas, weights=self.weights)
        raise_all("rig", duplicate_names(self.names), ShapeError)
        if self.polygons.size and int(self.polygons.max()) >= len(self.neutral):
            raise ShapeError(
                f"polygons: vertex ids must be below the {len(self.neutral)} vertices, "
                f"found {int(self.polygons.max())}"
            )

    def shape(self, weights: Floats) -> Floats:
        """The face in rig space (V, 3), mm, of one frame's weights (B,)."""
        check_shape(deltas=(self.deltas, "B V 3"), weights=(weights, "B"))
        posed: Floats = self.neutral + np.tensordot(weights, self.deltas, axes=1)
        return posed

    def evaluate(self, frame: int) -> Floats:
        """The face in world space (V, 3), mm, at the solved weights and head motion of a frame."""
        if not 0 <= frame < len(self.weights):
            raise ShapeError(f"frame {frame}: the rig holds frames 0..{len(self.weights) - 1}")
        motion = self.head_from_rig[frame]
        placed: Floats = self.shape(self.weights[frame]) @ motion[:3, :3].T + motion[:3, 3]
        return placed

    def frames(self) -> Iterator[Floats]:
        """Every solved frame in world space, one (V, 3) at a time, mm."""
        return (self.evaluate(frame) for frame in range(len(self.weights)))


def read_rig(path: Path) -> FaceRig:
    """Read rig.npz; nothing in it is unpickled.

    Raises:
        InputError: naming the file, and the key or shape that does not fit.
    """
    arrays = read_archive(path, _REQUIRED)
    try:
        return FaceRig(
            neutral=arrays["neutral"].astype(np.float64),
            deltas=arrays["deltas"].astype(np.float64),
            names=text_names(arrays["names"]),
            polygons=whole_numbers(arrays["polygons"], "polygons").astype(np.int32),
            weights=arrays["weights"].astype(np.float64),
            head_from_rig=arrays["head_from_rig"].astype(np.float64),
        )
    except InputError as error:
        raise ShapeError(f"{path}: {error}") from error


def write_rig(path: Path, rig: FaceRig) -> None:
    """Write rig.npz, whole or not at all: meshes as float32, weights and motions as float64."""
    write_archive(
        path,
        {
            "neutral": rig.neutral.astype(np.float32),
            "deltas": rig.deltas.astype(np.float32),
            "names": np.array(rig.names, dtype=np.str_),
            "polygons": rig.polygons,
            "weights": rig.weights,
            "head_from_rig": rig.head_from_rig,
        },
    )
