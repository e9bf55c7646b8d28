"""The sensor behind each simulated lens: gain, vignetting, defocus, noise, quantisation."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from capture.arrays import Floats32, Image
from capture.errors import SettingsError
from capture.settings import check_ranges

_RANGES = {
    "gain": (0.05, 20.0), "exposure": (0.05, 20.0), "shot_dn": (0.0, 1.0), "read_dn": (0.0, 50.0),
    "vignetting": (0.0, 1.0), "defocus_px": (0.0, 20.0), "white_dn": (1.0, 1000.0),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """How one device turns light into numbers; DN are those of an 8-bit image.

    Attributes:
        gain: of this device, 1 for the nominal one.
        exposure: factor on the light gathered.
        shot_dn: variance of the shot noise per DN of signal.
        read_dn: standard deviation of the read noise, DN.
        vignetting: share of the light lost at the middle of an image's edge.
        defocus_px: standard deviation of the blur, px.
        white_dn: DN of a radiance of 1 at gain and exposure 1.
        bits: 8 (uint8), or 12 or 16 (uint16, scaled to that many bits).
    """

    gain: float = 1.0
    exposure: float = 1.0
    shot_dn: float = 0.012
    read_dn: float = 1.0
    vignetting: float = 0.08
    defocus_px: float = 0.35
    white_dn: float = 250.0
    bits: int = 8

    def __post_init__(self) -> None:
        check_ranges("sensor", self, **_RANGES)
        if self.bits not in (8, 12, 16):
            raise SettingsError(f"bits: must be 8, 12 or 16, found {self.bits}")


def make_sensors(seed: int, names: Sequence[str]) -> dict[str, Sensor]:
    """One sensor a device, each a little different in gain, focus and noise.

    Args:
        seed: equal seeds give equal sensors.
        names: of the devices.
    """
    sensors = {}
    for name in names:
        random = np.random.default_rng([seed, zlib.crc32(name.encode())])
        sensors[name] = Sensor(
            gain=float(np.clip(random.normal(1.0, 0.03), 0.9, 1.1)),
            exposure=float(np.clip(random.normal(1.0, 0.02), 0.94, 1.06)),
            read_dn=float(random.uniform(0.8, 1.3)),
            vignetting=float(random.uniform(0.05, 0.11)),
            defocus_px=float(random.uniform(0.25, 0.5)),
        )
    return sensors


def expose(radiance: Floats32, sensor: Sensor, key: tuple[int, str, int]) -> Image:
    """Turn the light on a sensor into an image, with noise that the key alone decides.

    Args:
        radiance: (H, W) linear light, 1 for white.
        sensor: the device.
        key: seed, device name and time stamp in ns.

    Returns:
        (H, W) uint8, or uint16 for more than 8 bits.
    """
    height, width = radiance.shape
    light = radiance
    if sensor.defocus_px > 0.05:
        light = np.asarray(cv2.GaussianBlur(light, (0, 0), sensor.defocus_px), np.float32)
    across = ((np.arange(width, dtype=np.float32) - 0.5 * (width - 1)) / (0.5 * width)) ** 2
    down = ((np.arange(height, dtype=np.float32) - 0.5 * (height - 1)) / (0.5 * height)) ** 2
    fall = 1.0 - np.float32(sensor.vignetting) * (across[None, :] + down[:, None])
    level = light * (fall * np.float32(sensor.white_dn * sensor.gain * sensor.exposure))
    seed, name, t_ns = key
    random = np.random.default_rng([abs(seed), zlib.crc32(name.encode()), abs(t_ns)])
    noise = random.standard_normal(level.shape, dtype=np.float32)
    spread = np.sqrt(
        np.float32(sensor.read_dn**2) + np.float32(sensor.shot_dn) * np.maximum(level, 0.0)
    )
    level = level + noise * spread
    if sensor.bits == 8:
        eight: Image = np.clip(np.rint(level), 0, 255).astype(np.uint8)
        return eight
    top = 2**sensor.bits - 1
    deep: Image = np.clip(np.rint(level * (top / 255.0)), 0, top).astype(np.uint16)
    return deep
