"""Devices with a known answer to light, and what they read of a matt or glossy board."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from capture.arrays import Floats, Image
from capture.camera import CameraArray
from recon.board.body import BoardBody
from recon.board.charuco import Board
from recon.photometry.board_spots import BoardSpots, white_spots
from recon.photometry.light_samples import LightSamples
from tools.bench.board_scene import A4_BOARD, BoardScene, make_state

BIG_BOARD = Board(
    squares_x=7, squares_y=5, square_mm=34.0, marker_mm=24.0, dictionary="DICT_5X5_100"
)
"""Few and large squares: their white is wide enough in small images."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TrueLight:
    """The truth: log gains (C,) of mean 0, coefficients (C, 3), centres (C, 2) px, black (C,)."""

    log_gains: Floats
    coefficients: Floats
    centres: Floats
    black: Floats
    sizes: tuple[tuple[int, int], ...]

    def falloff(self, device: int, pixels: Floats) -> Floats:
        """V (N,) at pixels (N, 2)."""
        unit = 0.5 * np.hypot(*self.sizes[device])
        squared = (((pixels - self.centres[device]) / unit) ** 2).sum(axis=1)
        fall: Floats = 1.0 + (squared[:, None] ** [1, 2, 3]) @ self.coefficients[device]
        return fall

    def shown(self, device: int, radiance: Image, top: float, noise: float, seed: int) -> Image:
        """What a device makes of light (H, W), 1 for its full range: (H, W) float, not rounded."""
        width, height = self.sizes[device]
        x, y = np.meshgrid(np.arange(width), np.arange(height))
        fall = self.falloff(device, np.stack([x, y], -1).reshape(-1, 2).astype(float))
        level = np.exp(self.log_gains[device]) * fall.reshape(height, width) * radiance
        random = np.random.default_rng([seed, device])
        seen: Image = top * (self.black[device] + level) + random.normal(0.0, noise, level.shape)
        return seen


def true_light(
    sizes: tuple[tuple[int, int], ...], seed: int = 0, *, off_centre_px: float = 0.0
) -> TrueLight:
    """Devices that lose 10 to 45 % in the corners, with gains 10 % apart."""
    random = np.random.default_rng([seed, 11])
    count = len(sizes)
    gains = random.normal(0.0, 0.1, count)
    fall = np.column_stack([
        random.uniform(-0.3, -0.1, count), random.uniform(-0.12, 0.04, count),
        random.uniform(-0.03, 0.02, count),
    ])  # fmt: skip
    middle = (np.array(sizes, dtype=float) - 1.0) / 2.0
    return TrueLight(
        log_gains=gains - gains.mean(), coefficients=fall,
        centres=middle + off_centre_px * random.uniform(-1, 1, (count, 2)),
        black=random.uniform(0.005, 0.02, count), sizes=sizes,
    )  # fmt: skip


@cache
def spots() -> BoardSpots:
    """The white places of the board."""
    return white_spots(BoardBody.of(A4_BOARD))


def board_readings(
    scene: BoardScene,
    truth: TrueLight,
    cameras: CameraArray,
    *,
    noise: float = 0.004,
    gloss: float = 0.0,
    every: int = 3,
) -> LightSamples:
    """Readings of the white of a waved board under uneven light.

    Args:
        scene: geometry of the board's poses.
        truth: of the devices.
        cameras: of the devices.
        noise: standard deviation of the log of a reading.
        gloss: share of the readings that shine, by up to 60 %.
        every: of the white places each so-manieth is read.
    """
    random = np.random.default_rng([scene.seed, 12])
    chosen = spots().places[::every]
    rows = []
    for number, pose in enumerate(make_state(scene).array_from_board):
        points = pose.apply(chosen)
        light = np.exp(random.normal(-0.7, 0.3) + points @ random.normal(0, 0.003, 3))
        for device, camera in enumerate(cameras):
            towards = camera.centre - points.mean(axis=0)
            if -pose.rotation[:, 2] @ towards < 0.5 * np.linalg.norm(towards):
                continue
            pixels = camera.project(points)
            inside = np.flatnonzero(camera.contains(pixels))
            value = light * np.exp(truth.log_gains[device]) * truth.falloff(device, pixels)
            value *= np.exp(random.normal(0.0, noise, len(value)))
            shiny = random.random(len(value)) < gloss
            value *= np.where(shiny, 1.0 + random.uniform(0.05, 0.6, len(value)), 1.0)
            batch = number * len(cameras) + device
            rows += [
                (device, *pixels[k], value[k], number * len(chosen) + k, batch) for k in inside
            ]
    table = np.array(rows)
    return LightSamples(
        device_names=cameras.names, sizes=truth.sizes, device=table[:, 0].astype(np.int64),
        pixels=table[:, 1:3], value=table[:, 3], sigma=np.full(len(table), 0.004),
        light=table[:, 4].astype(np.int64), batch=table[:, 5].astype(np.int64),
        sloped=np.zeros(len(table), dtype=np.bool_),
    )  # fmt: skip
