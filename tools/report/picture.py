"""Pictures inside the page: encoding, display levels, colour maps that survive print."""

from __future__ import annotations

import base64

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.arrays import Floats, Image
from capture.errors import WorkError
from tools.report.svg import escape

_JPEG_QUALITY = 84
# dark blue through green to yellow, after Matplotlib's viridis, at nine places
_SEQUENTIAL = (
    (68, 1, 84), (71, 44, 122), (59, 81, 139), (44, 113, 142), (33, 144, 141),
    (39, 173, 129), (92, 200, 99), (170, 220, 50), (253, 231, 37),
)  # fmt: skip
# skin grey for none, through orange to dark red: for displacements and errors
_WARM = ((205, 200, 196), (246, 210, 150), (244, 160, 90), (214, 90, 60), (140, 20, 40))

Pixels = NDArray[np.uint8]


def jpeg_tag(image: Pixels, words: str) -> str:
    """An `<img>` that carries the (H, W, 3) RGB image in itself."""
    good, data = cv2.imencode(
        ".jpg", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    )
    if not good:
        raise WorkError(f"{words}: JPEG encoding failed")
    height, width = image.shape[:2]
    code = base64.b64encode(data.tobytes()).decode("ascii")
    return (
        f'<img src="data:image/jpeg;base64,{code}" width="{width}" height="{height}" '
        f'alt="{escape(words)}" loading="lazy">'
    )


def displayable(image: Image) -> Pixels:
    """A plate (H, W) or (H, W, 3) of any depth as 8-bit RGB (H, W, 3), its brightest at white."""
    colour = image if image.ndim == 3 else np.repeat(image[:, :, None], 3, axis=2)
    top = float(np.percentile(colour, 99.7))
    if image.dtype == np.uint8 and top > 120:
        plain: Pixels = np.ascontiguousarray(colour, dtype=np.uint8)
        return plain
    scaled = np.clip(colour.astype(np.float32) * (240.0 / max(top, 1e-6)), 0.0, 255.0)
    shown: Pixels = scaled.astype(np.uint8)
    return shown


def sequential(values: Floats, low: float, high: float) -> Floats:
    """RGB (..., 3) in 0..1 of values on a dark-to-light scale; NaN is grey."""
    return _mapped(values, low, high, _SEQUENTIAL)


def warm(values: Floats, low: float, high: float) -> Floats:
    """RGB (..., 3) in 0..1 of values from skin grey to dark red; NaN is grey."""
    return _mapped(values, low, high, _WARM)


def stops(name: str, count: int = 40) -> list[str]:
    """The colours of a scale, "sequential" or "warm", as CSS words from low to high."""
    anchors = _SEQUENTIAL if name == "sequential" else _WARM
    rows = _mapped(np.linspace(0.0, 1.0, count), 0.0, 1.0, anchors)
    return ["#{:02x}{:02x}{:02x}".format(*(round(255 * c) for c in row)) for row in rows.tolist()]


def _mapped(
    values: Floats, low: float, high: float, anchors: tuple[tuple[int, int, int], ...]
) -> Floats:
    span = (high - low) or 1.0
    place = np.clip((np.asarray(values, dtype=np.float64) - low) / span, 0.0, 1.0)
    table = np.array(anchors, dtype=np.float64) / 255.0
    at = np.linspace(0.0, 1.0, len(table))
    good = np.isfinite(place)
    out = np.stack(
        [np.interp(np.where(good, place, 0.0), at, table[:, k]) for k in range(3)], axis=-1
    )
    out[~good] = 0.6
    return out
