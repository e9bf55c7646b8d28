"""`BoardObservations`: which device saw which corner of the board where, at which board pose."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from capture.arrays import Bools, Floats, Ints, check_finite, check_shape
from capture.errors import ShapeError


@dataclass(frozen=True, eq=False, kw_only=True)
class BoardObservations:
    """Corner sightings of one board take, one row each, sorted by device, pose, corner.

    Attributes:
        device_names: (C) unique names.
        sizes: (C) (width, height) of each device's images, px.
        frames: (P) the frame number at which each board pose was seen.
        device: (M,) index of the device.
        pose: (M,) index of the board pose.
        corner: (M,) id of the corner on the board.
        pixels: (M, 2) (column, row), px.
    """

    device_names: tuple[str, ...]
    sizes: tuple[tuple[int, int], ...]
    frames: tuple[int, ...]
    device: Ints
    pose: Ints
    corner: Ints
    pixels: Floats

    def __post_init__(self) -> None:
        columns = {
            key: np.asarray(getattr(self, key), np.int64) for key in ("device", "pose", "corner")
        }
        pixels = np.asarray(self.pixels, dtype=np.float64)
        check_shape(
            device=(columns["device"], "M"), pose=(columns["pose"], "M"),
            corner=(columns["corner"], "M"), pixels=(pixels, "M 2"),
        )  # fmt: skip
        check_finite(pixels=pixels)
        if len(self.sizes) != len(self.device_names):
            raise ShapeError(f"sizes: expected {len(self.device_names)}, found {len(self.sizes)}")
        for key, limit in (("device", len(self.device_names)), ("pose", len(self.frames))):
            if len(pixels) and (columns[key].min() < 0 or columns[key].max() >= limit):
                raise ShapeError(f"{key}: indices must lie in 0..{limit - 1}")
        order = np.lexsort((columns["corner"], columns["pose"], columns["device"]))
        for key, values in (*columns.items(), ("pixels", pixels)):
            values = values[order]
            values.flags.writeable = False
            object.__setattr__(self, key, values)

    def __len__(self) -> int:
        return len(self.pixels)

    def select(self, keep: Bools) -> BoardObservations:
        """Only the rows that `keep` (M,) names; devices and poses keep their indices."""
        check_shape(pixels=(self.pixels, "M 2"), keep=(keep, "M"))
        return BoardObservations(
            device_names=self.device_names, sizes=self.sizes, frames=self.frames,
            device=self.device[keep], pose=self.pose[keep], corner=self.corner[keep],
            pixels=self.pixels[keep],
        )  # fmt: skip

    def of_devices(self, devices: Sequence[int]) -> BoardObservations:
        """Only these devices, given by index, which are counted anew in this order."""
        place = np.full(len(self.device_names), -1, dtype=np.int64)
        place[list(devices)] = np.arange(len(devices))
        rows = place[self.device] >= 0
        return BoardObservations(
            device_names=tuple(self.device_names[index] for index in devices),
            sizes=tuple(self.sizes[index] for index in devices), frames=self.frames,
            device=place[self.device[rows]], pose=self.pose[rows], corner=self.corner[rows],
            pixels=self.pixels[rows],
        )  # fmt: skip

    def views(self) -> Iterator[tuple[int, int, slice]]:
        """Each (device, pose) with the slice of its rows, in order."""
        if not len(self):
            return
        change = np.flatnonzero((np.diff(self.device) != 0) | (np.diff(self.pose) != 0)) + 1
        starts = [0, *change.tolist(), len(self)]
        for start, stop in pairwise(starts):
            yield int(self.device[start]), int(self.pose[start]), slice(start, stop)

    def view_counts(self) -> Ints:
        """Corners seen (C, P) by each device at each pose."""
        counts = np.zeros((len(self.device_names), len(self.frames)), dtype=np.int64)
        np.add.at(counts, (self.device, self.pose), 1)
        return counts
