"""What the images say: exposure, flicker, focus, and whether a device has moved."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from capture.arrays import Image
from capture.calibration_link.reference import DeviceReference, check_static_scene
from capture.calibration_link.sharpness import face_region, full_scale, sharpness
from capture.judgement import Colour
from capture.preflight.finding import Finding, steps

CLIPPED, CLIPPED_RED = 0.005, 0.05  # shares of the face region
DARK = 0.5
MEAN_LOW, MEAN_HIGH = 0.08, 0.75
DRIFT, DRIFT_RED = 0.05, 0.25
FLICKER = 0.01
SOFT, SOFT_RED = 0.8, 0.5
_WHITE, _BLACK = 254 / 255, 3 / 255
_EDGE = 0.15  # of width: what lies outside is lit as the face is, and nobody moves there
_COARSE = 4  # every fourth pixel is enough for a mean


@dataclass(frozen=True, eq=False)
class Sight:
    """What one device showed over a short while.

    Attributes:
        images: the last two that differ, oldest first; one when there was only one.
        levels: mean of the edges of each image looked at, 0 to 1.
    """

    images: tuple[Image, ...]
    levels: tuple[float, ...]

    @property
    def mean(self) -> float:
        """Mean of the face region of the last image, 0 to 1."""
        region = face_region(self.images[-1])
        return float(region[::_COARSE, ::_COARSE].mean()) / full_scale(region)


def look(
    latest: Callable[[], Mapping[str, Image]],
    count: int = 20,
    pause_s: float = 0.037,
    sleep_s: Callable[[float], None] = time.sleep,
) -> dict[str, Sight]:
    """Look at each device's latest image so many times; of all but the last two a number is kept.

    Args:
        latest: gives the latest image of each device.
        count: how often.
        pause_s: between looks; not a multiple of a usual period, so that flicker shows.
        sleep_s: waits.
    """
    images: dict[str, list[Image]] = {}
    levels: dict[str, list[float]] = {}
    for turn in range(count):
        if turn:
            sleep_s(pause_s)
        for name, image in latest().items():
            kept = images.setdefault(name, [])
            if kept and np.array_equal(kept[-1], image):
                continue
            images[name] = [*kept[-1:], image]
            levels.setdefault(name, []).append(edge_level(image))
    return {name: Sight(tuple(kept), tuple(levels[name])) for name, kept in images.items()}


def edge_level(image: Image) -> float:
    """Mean of the left and right edges of an image, 0 to 1."""
    wide = max(1, round(image.shape[1] * _EDGE))
    step = max(1, min(_COARSE, wide // 4))
    sides = (image[::step, :wide:step], image[::step, -wide::step])
    return float(np.mean([side.mean() for side in sides])) / full_scale(image)


def exposure_findings(
    sights: Mapping[str, Sight], start: Mapping[str, float] | None = None
) -> list[Finding]:
    """Clipping, darkness and mean of each device's face region, and drift since session start.

    Args:
        sights: by device name.
        start: by device name, the mean at session start; None: this is the start.
    """
    found = []
    for name, sight in sights.items():
        region = face_region(sight.images[-1])
        scaled = region / full_scale(region)
        bright = scaled.max(axis=2) if scaled.ndim == 3 else scaled
        clipped, dark = float((bright >= _WHITE).mean()), float((bright <= _BLACK).mean())
        mean = float(scaled.mean())
        told = f"mean {mean:.0%}, {clipped:.1%} clipped, {dark:.0%} dark"
        colour, words, remedy = _exposure(name, clipped, dark, mean)
        then = (start or {}).get(name)
        change = mean / then - 1.0 if then else 0.0
        if colour == Colour.GREEN and abs(change) > DRIFT:
            colour = Colour.RED if abs(change) > DRIFT_RED else Colour.AMBER
            side = "brighter" if change > 0 else "darker"
            words = f"{name} is {abs(change):.0%} {side} than at session start"
            remedy = steps(
                ("See the lights: one that went out, warms up or was turned.",
                 f"See that iris and exposure of {name} are those of the session's start.")
            )  # fmt: skip
        found.append(Finding("exposure", name, colour, f"{words} ({told}).", remedy))
    return found


def flicker_findings(sights: Mapping[str, Sight]) -> list[Finding]:
    """Whether the light goes up and down from image to image."""
    found = []
    for name, sight in sights.items():
        amount = flicker(sight.levels)
        if amount > FLICKER:
            found.append((name, amount))
    if not found:
        return []
    device = found[0][0] if len(found) == 1 else ""
    names = ", ".join(name for name, _ in found[:4]) + (", ..." if len(found) > 4 else "")
    worst = max(amount for _, amount in found)
    words = f"The light flickers by {worst:.1%} rms, seen by {names}."
    remedy = steps(
        ("Switch off room lights and screens that the mains drive.",
         "Set dimmed LED lights to full power, or dim them by current and not by pulses.",
         "Set the rate to a divisor of the lights' frequency: 50 or 100 Hz with 50 Hz mains.")
    )  # fmt: skip
    return [Finding("exposure", device, Colour.AMBER, words, remedy)]


def flicker(levels: Sequence[float]) -> float:
    """Root mean square of a series of levels about its straight line, as a share of its mean."""
    if len(levels) < 6:
        return 0.0
    values = np.array(levels, np.float64)
    places = np.arange(len(values))
    rest = values - np.polyval(np.polyfit(places, values, 1), places)
    mean = float(values.mean())
    return float(np.sqrt(np.mean(rest * rest))) / mean if mean > 0.01 else 0.0


def focus_findings(
    sights: Mapping[str, Sight], reference: Mapping[str, DeviceReference]
) -> list[Finding]:
    """The sharpness of each device's face region against calibration day.

    Args:
        sights: by device name.
        reference: by device name, of calibration day; devices without one are amber.
    """
    found = []
    for name, sight in sights.items():
        now = sharpness(sight.images)
        then = reference[name].sharpness if name in reference else float("nan")
        if not np.isfinite(then):
            words = f"Focus of {name} is not compared: calibration day showed nothing to compare."
            remedy = "With somebody in the chair, make the reference again."
            found.append(Finding("focus", name, Colour.AMBER, words, remedy))
        elif not np.isfinite(now):
            words = f"Focus of {name} is not judged: nothing to see in the middle of its image."
            remedy = "Ask the talent to sit down, and run the preflight again."
            found.append(Finding("focus", name, Colour.AMBER, words, remedy))
        else:
            found.append(_focus(name, now / then))
    return found


def scene_findings(
    sights: Mapping[str, Sight], reference: Mapping[str, DeviceReference]
) -> list[Finding]:
    """Whether the static scene of each device lies where it lay on calibration day."""
    images = {name: sight.images[-1] for name, sight in sights.items()}
    return [
        Finding("scene", one.device, one.colour, one.sentence, one.remedy)
        for one in check_static_scene(reference, images)
    ]


def _exposure(name: str, clipped: float, dark: float, mean: float) -> tuple[Colour, str, str]:
    darker = steps(("Close the iris or shorten the exposure, of all devices alike.",
                    "Turn lamps that shine into the device."))  # fmt: skip
    brighter = steps(("See that the lights are on and the lens cap is off.",
                      "Open the iris or add light; a longer exposure blurs lips."))  # fmt: skip
    if clipped > CLIPPED:
        colour = Colour.RED if clipped > CLIPPED_RED else Colour.AMBER
        return colour, f"{clipped:.1%} of the face region of {name} is clipped", darker
    if mean > MEAN_HIGH:
        return Colour.AMBER, f"{name} is too bright", darker
    if mean < MEAN_LOW / 4:
        return Colour.RED, f"{name} sees next to nothing", brighter
    if mean < MEAN_LOW or dark > DARK:
        return Colour.AMBER, f"{name} is too dark", brighter
    return Colour.GREEN, f"{name} is exposed well", ""


def _focus(name: str, ratio: float) -> Finding:
    if ratio >= SOFT:
        words = f"{name} is as sharp as on calibration day ({ratio:.0%})."
        return Finding("focus", name, Colour.GREEN, words)
    colour = Colour.RED if ratio < SOFT_RED else Colour.AMBER
    words = f"{name} is softer than on calibration day: {ratio:.0%} of the fine detail is left."
    remedy = steps(
        ("See that the talent sits where the calibration was made.",
         f"Look at the lens of {name}: dust, fingerprints, a loose lock of focus or iris.",
         "If focus was turned, set it anew and calibrate again: a lens that was turned is another "
         "lens.")
    )  # fmt: skip
    return Finding("focus", name, colour, words, remedy)
