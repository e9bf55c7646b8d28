"""Synthetic pictures of a stage: displaced by known amounts, blurred, lit, noisy, with an actor."""

from __future__ import annotations

import numpy as np

from capture.arrays import Floats, Image

_MARGIN = 64


class Stage:
    """Walls and furniture, displaced exactly through the phases of their spectrum."""

    def __init__(self, seed: int, size: int = 512) -> None:
        rng = np.random.default_rng((seed, 0x57A6E))
        self.size = size
        whole = size + 2 * _MARGIN
        self._fy = np.fft.fftfreq(whole)[:, None]
        self._fx = np.fft.rfftfreq(whole)[None]
        radius = np.hypot(self._fy, self._fx)
        texture = np.fft.rfft2(rng.normal(size=(whole, whole))) / np.maximum(radius, 2 / whole)
        texture /= np.fft.irfft2(texture, (whole, whole)).std()
        boxes = np.zeros((whole, whole))
        for _ in range(25):
            top, left = rng.integers(0, whole - 40, 2)
            high, wide = rng.integers(20, 150, 2)
            boxes[top : top + high, left : left + wide] += rng.normal()
        spectrum = 0.5 * texture + np.fft.rfft2(boxes / boxes.std())
        self._spectrum = spectrum * np.exp(-2 * np.pi**2 * 0.8**2 * radius**2)

    def view(self, right: float = 0.0, down: float = 0.0) -> Floats:
        """The stage displaced by so many pixels."""
        turned = np.exp(-2j * np.pi * (self._fy * down + self._fx * right))
        whole = self.size + 2 * _MARGIN
        view = np.fft.irfft2(self._spectrum * turned, (whole, whole))
        return view[_MARGIN : _MARGIN + self.size, _MARGIN : _MARGIN + self.size]


def shot(view: Floats, rng: np.random.Generator, gain: float = 1.0, noise: float = 2.0) -> Image:
    """A picture as a sensor gives it: gain, noise that grows with light, 8 bits."""
    light = np.maximum(gain * (110.0 + 35.0 * view), 0.0)
    sigma = noise * np.sqrt(light / 110.0 + 0.05)
    return np.clip(np.round(light + rng.normal(size=view.shape) * sigma), 0, 255).astype(np.uint8)


def with_actor(image: Image, rng: np.random.Generator, aside: float = 0.0) -> Image:
    """The picture with somebody sitting in the middle, `aside` of the width to the right."""
    height, width = image.shape
    y, x = np.mgrid[:height, :width]
    down = np.minimum(y / height - 0.5, 0.0) / 0.3
    inside = ((x / width - 0.5 - aside) / 0.22) ** 2 + down**2 <= 1.0
    skin = rng.normal(120, 25, (height // 8 + 1, width // 8 + 1)).repeat(8, 0).repeat(8, 1)
    out = image.copy()
    out[inside] = skin[:height, :width][inside].clip(0, 255).astype(np.uint8)
    return out


class Face:
    """Skin, lashes and brows, as sharp as one likes."""

    def __init__(self, seed: int, size: int = 256) -> None:
        rng = np.random.default_rng((seed, 0xFACE))
        self.size = size
        self._fy, self._fx = np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None]
        radius = np.hypot(self._fy, self._fx)
        skin = np.fft.rfft2(rng.normal(size=(size, size))) / np.maximum(radius, 1 / size) ** 1.2
        skin[0, 0] = 0
        face = np.fft.irfft2(skin, (size, size))
        face /= face.std()
        y, x = np.mgrid[:size, :size]
        for _ in range(80):
            a, b = rng.uniform(40, size - 40, 2)
            angle, length = rng.uniform(0, np.pi), rng.uniform(6, 25)
            along = (x - a) * np.cos(angle) + (y - b) * np.sin(angle)
            across = (y - b) * np.cos(angle) - (x - a) * np.sin(angle)
            face -= (np.abs(along) < length) & (np.abs(across) < 1.2)
        self._spectrum = np.fft.rfft2(face)

    def seen(
        self, rng: np.random.Generator, blur_px: float = 0.0, gain: float = 1.0, noise: float = 1.5
    ) -> Image:
        """One picture through a lens of 0.7 px, `blur_px` out of focus, moved by a fifth pixel."""
        square = self._fy**2 + self._fx**2
        lens = np.exp(-2 * np.pi**2 * square * (blur_px**2 + 0.49))
        right, down = rng.uniform(-0.2, 0.2, 2)
        turned = np.exp(-2j * np.pi * (self._fy * down + self._fx * right))
        view = np.fft.irfft2(self._spectrum * lens * turned, (self.size, self.size))
        return shot(view / 2.0, rng, gain, noise)
