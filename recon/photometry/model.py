"""How each device turns light into numbers, and `photometric.json`, which keeps that.

::

    digital value = black + gain * V(pixel) * light
    V = 1 + a1 r^2 + a2 r^4 + a3 r^6      r from the centre, in units of half the image diagonal

::

    {"format": 1, "model": "...", "devices": [
        {"name", "width", "height", "range_dn": 255 or 65535, "black_dn", "gain",
         "gain_sigma": number or null, "centre_px": [column, row], "coefficients": [a1, a2, a3],
         "covariance": 3x3, "residual": number, "samples": count, "coverage": rows of counts}],
     "report": {...}}

Values and light are parts of `range_dn`, the largest number the pixel type holds, which is what
`recon.images.mono` returns; `black_dn` is in the file's own numbers. A `gain_sigma` of null says
that the gain was not measured (it is 1). Values must be linear in light: a raw sensor's, not those
of a gamma-encoded picture.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from capture.arrays import Floats, Floats32, Image, Ints, check_finite, check_shape
from capture.documents import key_problems, read_json
from capture.errors import InputError, LikenessError, ShapeError, raise_all
from capture.names import is_plain_name
from capture.product import replacing

FORMAT = 1
TERMS = 3  # coefficients of V
RANGES = {"uint8": 255, "uint16": 65535}  # the largest number of each pixel type
_TOP = ("format", "model", "devices", "report")
_KEYS = (
    "name", "width", "height", "range_dn", "black_dn", "gain", "gain_sigma", "centre_px",
    "coefficients", "covariance", "residual", "samples", "coverage",
)  # fmt: skip
_LARGEST_PX = 65536
_MODEL = (
    "value = black_dn + range_dn * gain * V * light; V = 1 + a1 r^2 + a2 r^4 + a3 r^6, "
    "r from centre_px in units of half the image diagonal; pixel centres at integers"
)


@dataclass(frozen=True, eq=False, kw_only=True)
class DevicePhotometry:
    """One device's answer to light.

    Attributes:
        name: of the device.
        width: image columns, px.
        height: image rows, px.
        range_dn: 255 or 65535, the largest number its pixel type holds.
        black_dn: what it shows without light, in the numbers of the image.
        gain: relative to the geometric mean of the array; exposure, aperture and all.
        gain_sigma: standard deviation of `gain` over `gain`; NaN when it was not measured.
        centre_px: (2,) centre of V, (column, row), px.
        coefficients: (3,) a1 a2 a3 of V.
        covariance: (3, 3) of the coefficients.
        residual: standard deviation of the logarithm of measured over predicted light.
        samples: readings used.
        coverage: (rows, columns) how many of them in each cell of the image.
    """

    name: str
    width: int
    height: int
    range_dn: int
    black_dn: float
    gain: float
    gain_sigma: float
    centre_px: Floats
    coefficients: Floats
    covariance: Floats
    residual: float
    samples: int
    coverage: Ints

    def __post_init__(self) -> None:
        for key, spec in (("centre_px", "2"), ("coefficients", "3"), ("covariance", "3 3")):
            array = np.array(getattr(self, key), dtype=np.float64)
            check_shape(**{key: (array, spec)})
            check_finite(**{key: array})
            array.flags.writeable = False
            object.__setattr__(self, key, array)
        check_shape(coverage=(self.coverage, "R K"))
        raise_all(self.name, self._problems())

    def falloff(self, pixels: Floats) -> Floats:
        """V (N,) at pixels (N, 2): the share of light that the lens passes there, 1 at the centre.

        References:
            Goldman, Vignette and exposure calibration and compensation, PAMI 32(12), 2010: the
            even polynomial of the sixth degree.
        """
        return 1.0 + self._powers(pixels) @ self.coefficients

    def falloff_sigma(self, pixels: Floats) -> Floats:
        """Standard deviation (N,) of V over V at pixels (N, 2)."""
        powers = self._powers(pixels)
        variance = np.einsum("ni,ij,nj->n", powers, self.covariance, powers)
        relative: Floats = np.sqrt(np.maximum(variance, 0.0)) / (1.0 + powers @ self.coefficients)
        return relative

    def corrected(self, image: Image) -> Floats32:
        """The light that made an image, comparable between the devices of the array.

        Args:
            image: (H, W) or (H, W, 3), of the device's own size and pixel type. Where it is
                clipped, so is the light: the value there only says "at least".

        Returns:
            float32 of the same shape: (value - black) / (gain V), 1 for a full value at the centre
            of a device of gain 1. Noise about black stays, so values may lie a little below 0.

        Raises:
            ShapeError: naming the size or the pixel type found.
        """
        image = np.asarray(image)
        if image.shape[:2] != (self.height, self.width) or image.ndim not in (2, 3):
            raise ShapeError(
                f"{self.name}: expected an image of {self.width} x {self.height} px, "
                f"found shape {image.shape}"
            )
        if RANGES.get(image.dtype.name) != self.range_dn:
            raise ShapeError(
                f"{self.name}: the calibration is of "
                f"{next(n for n, top in RANGES.items() if top == self.range_dn)} images, "
                f"found {image.dtype}"
            )
        scale = 1.0 / (self.range_dn * self.gain * self._map())
        scale = scale if image.ndim == 2 else scale[:, :, None]
        light: Floats32 = (image.astype(np.float32) - np.float32(self.black_dn)) * scale
        return light

    def _map(self) -> Floats32:
        unit = 0.5 * math.hypot(self.width, self.height)
        across = ((np.arange(self.width) - self.centre_px[0]) / unit) ** 2
        down = ((np.arange(self.height) - self.centre_px[1]) / unit) ** 2
        squared = (across[None, :] + down[:, None]).astype(np.float32)
        a1, a2, a3 = self.coefficients.astype(np.float32)
        fall: Floats32 = 1.0 + squared * (a1 + squared * (a2 + squared * a3))
        return fall

    def _powers(self, pixels: Floats) -> Floats:
        check_shape(pixels=(pixels, "N 2"))
        unit = 0.5 * math.hypot(self.width, self.height)
        squared = (((np.asarray(pixels, np.float64) - self.centre_px) / unit) ** 2).sum(axis=1)
        powers: Floats = squared[:, None] ** np.arange(1, TERMS + 1)
        return powers

    def _problems(self) -> list[str]:
        out = []
        if not (1 <= self.width <= _LARGEST_PX and 1 <= self.height <= _LARGEST_PX):
            return [f"size must be 1 to {_LARGEST_PX} px, found {self.width} x {self.height}"]
        if self.range_dn not in RANGES.values():
            out.append(f"range_dn must be 255 or 65535, found {self.range_dn}")
        elif not 0 <= self.black_dn < self.range_dn:
            out.append(f"black_dn must lie in 0..{self.range_dn}, found {self.black_dn}")
        if not (math.isfinite(self.gain) and self.gain > 0):
            out.append(f"gain must be above 0, found {self.gain}")
        if not (math.isnan(self.gain_sigma) or 0 <= self.gain_sigma < math.inf):
            out.append(f"gain_sigma must be 0 or more, found {self.gain_sigma}")
        if not 0 <= self.residual < math.inf:
            out.append(f"residual must be 0 or more, found {self.residual}")
        if not out and not _lowest(self) > 0:
            out.append(
                f"coefficients: V must stay above 0 in the whole image, found {_lowest(self):.3g} "
                f"with {self.coefficients.tolist()}"
            )
        return out


@dataclass(frozen=True, eq=False)
class PhotometricModel:
    """The answers to light of all devices of an array, in a fixed order with unique names."""

    devices: tuple[DevicePhotometry, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "devices", tuple(self.devices))
        names = [device.name for device in self.devices]
        double = sorted({name for name in names if names.count(name) > 1})
        if double:
            raise InputError(f"device names must be unique, found twice: {', '.join(double)}")

    def __iter__(self) -> Iterator[DevicePhotometry]:
        return iter(self.devices)

    def __len__(self) -> int:
        return len(self.devices)

    @property
    def names(self) -> tuple[str, ...]:
        """Device names, in order."""
        return tuple(device.name for device in self.devices)

    def by_name(self, name: str) -> DevicePhotometry:
        """The device called `name`.

        Raises:
            InputError: naming the devices there are.
        """
        for device in self.devices:
            if device.name == name:
                return device
        raise InputError(
            f"no device {name!r} in this photometric calibration; it has {', '.join(self.names)}"
        )

    def corrected(self, name: str, image: Image) -> Floats32:
        """The light that made an image of the device called `name`: see `DevicePhotometry`."""
        return self.by_name(name).corrected(image)


def write_photometry(
    path: Path, model: PhotometricModel, report: Mapping[str, Any] | None = None
) -> None:
    """Write photometric.json, whole or not at all.

    Args:
        path: the file to write or replace.
        model: all devices.
        report: what the calibration says of itself.
    """
    document: dict[str, Any] = {
        "format": FORMAT,
        "model": _MODEL,
        "devices": [
            {
                "name": device.name,
                "width": device.width,
                "height": device.height,
                "range_dn": device.range_dn,
                "black_dn": device.black_dn,
                "gain": device.gain,
                "gain_sigma": None if math.isnan(device.gain_sigma) else device.gain_sigma,
                "centre_px": device.centre_px.tolist(),
                "coefficients": device.coefficients.tolist(),
                "covariance": device.covariance.tolist(),
                "residual": device.residual,
                "samples": device.samples,
                "coverage": device.coverage.tolist(),
            }
            for device in model
        ],
    }
    if report is not None:
        document["report"] = dict(report)
    text = json.dumps(document, indent=1, allow_nan=False)
    with replacing(path) as partial:
        partial.write_text(text + "\n", encoding="utf-8")


def read_photometry(path: Path) -> PhotometricModel:
    """Read photometric.json.

    Raises:
        InputError: naming the file and every key or value that does not fit.
    """
    document = read_json(path, absent="no such file; `likeness photometric` writes one")
    if not isinstance(document, Mapping):
        raise InputError(
            f"{path}: expected an object with 'devices', found {type(document).__name__}"
        )
    raise_all(str(path), key_problems(document, _TOP[:3], _TOP, "top level"))
    if document["format"] != FORMAT:
        raise InputError(f"{path}: format must be {FORMAT}, found {document['format']!r}")
    entries = document["devices"]
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{path}: 'devices' must be a list of at least one device")
    devices: list[DevicePhotometry] = []
    problems: list[str] = []
    for index, entry in enumerate(entries):
        try:
            devices.append(_device(entry, index))
        except LikenessError as error:
            problems.append(str(error))
    raise_all(str(path), problems)
    try:
        return PhotometricModel(tuple(devices))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _device(entry: Any, index: int) -> DevicePhotometry:
    if not isinstance(entry, Mapping):
        raise InputError(f"device {index}: expected an object, found {type(entry).__name__}")
    raise_all(f"device {index}", key_problems(entry, _KEYS, _KEYS, "device"))
    name = entry["name"]
    if not is_plain_name(name):
        raise InputError(
            f"device {index}: name must be letters, digits, '-', '_' or '.', found {name!r}"
        )
    whole = {}
    for key in ("width", "height", "range_dn", "samples"):
        if not isinstance(entry[key], int) or isinstance(entry[key], bool) or entry[key] < 0:
            raise InputError(f"{name}: {key} must be a whole number, found {entry[key]!r}")
        whole[key] = entry[key]
    sigma = entry["gain_sigma"]
    coverage = _numbers(entry, "coverage", 2, name)
    if (coverage < 0).any() or (coverage != np.floor(coverage)).any():
        raise InputError(f"{name}: coverage must hold counts")
    return DevicePhotometry(
        name=name, width=whole["width"], height=whole["height"], range_dn=whole["range_dn"],
        black_dn=float(_numbers(entry, "black_dn", 0, name)),
        gain=float(_numbers(entry, "gain", 0, name)),
        gain_sigma=math.nan if sigma is None else float(_numbers(entry, "gain_sigma", 0, name)),
        centre_px=_numbers(entry, "centre_px", 1, name),
        coefficients=_numbers(entry, "coefficients", 1, name),
        covariance=_numbers(entry, "covariance", 2, name),
        residual=float(_numbers(entry, "residual", 0, name)),
        samples=whole["samples"], coverage=coverage.astype(np.int64),
    )  # fmt: skip


def _numbers(entry: Mapping[str, Any], key: str, axes: int, name: str) -> Floats:
    try:
        found = np.array(entry[key])
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: {key} must hold numbers, with rows of one length") from error
    if found.dtype.kind not in "iuf" or found.ndim != axes or not np.isfinite(found).all():
        shown = repr(entry[key])[:200]
        raise InputError(f"{name}: {key} must be {_KINDS[axes]}, found {shown}")
    return found.astype(np.float64)


_KINDS = ("a finite number", "a list of finite numbers", "rows of finite numbers")


def _lowest(device: DevicePhotometry) -> float:
    """The smallest V in the image, on a grid of 33 x 33 places that holds its corners."""
    x, y = (np.linspace(0.0, size - 1.0, 33) for size in (device.width, device.height))
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return float(device.falloff(grid).min())
