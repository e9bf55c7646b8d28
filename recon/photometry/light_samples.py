"""`LightSamples`: how bright each device saw evenly bright places, and which share a light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from capture.arrays import Bools, Floats, Ints, check_finite, check_shape
from capture.errors import ShapeError


@dataclass(frozen=True, eq=False, kw_only=True)
class LightSamples:
    """Brightness readings, one row each.

    Attributes:
        device_names: (C) unique names.
        sizes: (C) (width, height) of each device's images, px.
        device: (M,) index of the device.
        pixels: (M, 2) middle of the pixels read, (column, row), px.
        value: (M,) mean of their values, black level taken away, above 0; 1 is the range's end.
        sigma: (M,) expected standard deviation of the logarithm of `value`.
        light: (M,) readings with the same number looked at the same light.
        batch: (M,) readings with the same number share what is wrong with them.
        sloped: (M,) whether that light may have a slope over the image.
    """

    device_names: tuple[str, ...]
    sizes: tuple[tuple[int, int], ...]
    device: Ints
    pixels: Floats
    value: Floats
    sigma: Floats
    light: Ints
    batch: Ints
    sloped: Bools

    def __post_init__(self) -> None:
        check_shape(
            device=(self.device, "M"), pixels=(self.pixels, "M 2"), value=(self.value, "M"),
            sigma=(self.sigma, "M"), light=(self.light, "M"), batch=(self.batch, "M"),
            sloped=(self.sloped, "M"),
        )  # fmt: skip
        check_finite(pixels=self.pixels, value=self.value, sigma=self.sigma)
        count = len(self.device_names)
        if len(self.sizes) != count:
            raise ShapeError(f"sizes: expected {count}, found {len(self.sizes)}")
        if len(self) and not (self.device.min() >= 0 and self.device.max() < count):
            raise ShapeError(f"device: indices must lie in 0..{count - 1}")
        if len(self) and not (self.value.min() > 0 and self.sigma.min() > 0):
            raise ShapeError("value and sigma: every one must be above 0")

    def __len__(self) -> int:
        return len(self.value)

    def select(self, keep: Bools) -> LightSamples:
        """Only the rows that `keep` (M,) names."""
        check_shape(device=(self.device, "M"), keep=(keep, "M"))
        return LightSamples(
            device_names=self.device_names, sizes=self.sizes, device=self.device[keep],
            pixels=self.pixels[keep], value=self.value[keep], sigma=self.sigma[keep],
            light=self.light[keep], batch=self.batch[keep], sloped=self.sloped[keep],
        )  # fmt: skip

    def counts(self) -> Ints:
        """Readings (C,) of each device."""
        return np.bincount(self.device, minlength=len(self.device_names)).astype(np.int64)

    def radius_squared(self, centres: Floats) -> Floats:
        """Squared distance (M,) from the centres (C, 2), px, in units of half the diagonal."""
        check_shape(centres=(centres, f"{len(self.sizes)} 2"))
        away = (self.pixels - centres[self.device]) / half_diagonals(self.sizes)[self.device, None]
        squared: Floats = (away**2).sum(axis=1)
        return squared


def half_diagonals(sizes: Sequence[tuple[int, int]]) -> Floats:
    """Half the diagonal (C,), px, of images of these (width, height)."""
    wide, high = np.array(sizes, dtype=np.float64).reshape(-1, 2).T
    halves: Floats = 0.5 * np.hypot(wide, high)
    return halves


def joined(parts: Sequence[LightSamples]) -> LightSamples:
    """The readings of several sources, which share neither lights nor batches.

    Args:
        parts: at least one; all of the same devices.

    Raises:
        ShapeError: when their devices differ.
    """
    first = parts[0]
    light, batch = [], []
    lights = batches = 0
    for part in parts:
        if part.device_names != first.device_names or part.sizes != first.sizes:
            raise ShapeError(
                f"readings of {', '.join(part.device_names)} cannot be joined to those of "
                f"{', '.join(first.device_names)}"
            )
        light.append(part.light + lights)
        batch.append(part.batch + batches)
        lights += int(part.light.max(initial=-1)) + 1
        batches += int(part.batch.max(initial=-1)) + 1
    return LightSamples(
        device_names=first.device_names, sizes=first.sizes,
        device=np.concatenate([part.device for part in parts]),
        pixels=np.concatenate([part.pixels for part in parts]),
        value=np.concatenate([part.value for part in parts]),
        sigma=np.concatenate([part.sigma for part in parts]),
        light=np.concatenate(light), batch=np.concatenate(batch),
        sloped=np.concatenate([part.sloped for part in parts]),
    )  # fmt: skip
