"""The flash check: one flash must light the same trigger index in every device.

Time stamps can all be wrong together: a delay that nobody set, a wrong line, a device a trigger
late. Light cannot.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from capture.arrays import Floats
from capture.judgement import Colour
from capture.preflight.finding import Finding, steps
from capture.take import Take

_LIT = 0.25  # of the rise: the first frame above is the one that saw the flash
_PARTLY = 0.04  # of the rise: a frame between the two was lit for a part of its exposure
_CLEAR = 8.0  # times the usual change from frame to frame
_LEAST = 0.01  # of full scale
_STEP = 8  # every eighth pixel of every eighth row is enough for a mean


@dataclass(frozen=True)
class FlashSeen:
    """When a device saw the flash.

    Attributes:
        index: the first trigger index that it lit; -1 when it was not seen.
        rise: by how much, of full scale.
        partly: whether the flash began within an exposure, so that the index is not sure.
    """

    index: int
    rise: float
    partly: bool = False


def flash_levels(take: Take) -> dict[str, Floats]:
    """By device, the mean level of each frame of a take, 0 to 1; NaN where there is none."""
    out = {}
    for device in take.device_names:
        series = np.full(len(take.frames), np.nan)
        for place, frame in enumerate(take.frames):
            if take.present(device, frame):
                image = take.image(device, frame)[::_STEP, ::_STEP]
                series[place] = image.mean() / float(np.iinfo(image.dtype).max)
        out[device] = series
    return out


def flash_of(levels: Sequence[float] | Floats) -> FlashSeen:
    """Find the flash in one device's levels: the largest rise, if it stands out.

    Args:
        levels: mean level of each frame, by trigger index; NaN where there is none.
    """
    series = np.asarray(levels, np.float64)
    known = np.flatnonzero(np.isfinite(series))
    if len(known) < 4:
        return FlashSeen(-1, 0.0)
    values = series[known]
    steps_up = np.diff(values)
    usual = float(np.median(np.abs(steps_up)))
    top = int(np.argmax(steps_up))
    if steps_up[top] <= max(_LEAST, _CLEAR * usual):
        return FlashSeen(-1, float(max(steps_up[top], 0.0)))
    # The frame before the steepest rise may have caught the beginning of the flash, the one after
    # it the rest of the rise.
    dark = float(np.median(values[max(0, top - 6) : max(top, 1)]))
    peak = float(values[top + 1 : top + 3].max())
    rise = peak - dark
    share = (values - dark) / rise
    first = top if top > 0 and share[top] > _LIT else top + 1
    edge = first - 1 if first > 0 else first
    noise = _CLEAR * usual / rise
    partly = _PARTLY + noise < share[edge] <= _LIT or share[first] < 1.0 - _LIT - noise
    return FlashSeen(int(known[first]), rise, bool(partly))


def flash_findings(levels: Mapping[str, Sequence[float] | Floats]) -> list[Finding]:
    """Whether every device saw the flash at the same trigger index.

    Args:
        levels: by device name, mean level of each frame by trigger index; NaN where there is none.
    """
    seen = {name: flash_of(series) for name, series in levels.items()}
    lit = {name: flash for name, flash in seen.items() if flash.index >= 0}
    if len(lit) < 2 or 2 * len(lit) < len(seen):
        words = f"{len(lit)} of {len(seen)} devices saw a flash: nothing to compare."
        remedy = "Record a take of a second or so, and flash once in the middle of it."
        return [Finding("flash", "", Colour.AMBER, words, remedy)]
    usual, votes = Counter(flash.index for flash in lit.values()).most_common(1)[0]
    if any(flash.partly for flash in lit.values()) and votes < len(lit):
        words = (
            "The flash began within an exposure, so that devices may see it a frame apart: "
            "this flash proves nothing."
        )
        remedy = "Flash again; every other time or so it falls between exposures."
        far = {name for name, flash in lit.items() if abs(flash.index - usual) > 1}
        if not far:
            return [Finding("flash", "", Colour.AMBER, words, remedy)]
    found = [_odd(name, flash, usual) for name, flash in seen.items() if flash.index != usual]
    if found:
        return found
    words = f"All {len(lit)} devices saw the flash in frame {usual}."
    return [Finding("flash", "", Colour.GREEN, words)]


def _odd(name: str, flash: FlashSeen, usual: int) -> Finding:
    if flash.index < 0:
        words = f"{name} did not see the flash that the others saw in frame {usual}."
        remedy = steps(
            ("Flash where every device sees it, or its light on the wall.",
             f"If {name} should have seen it, see that its exposure falls at the trigger's time.")
        )  # fmt: skip
        return Finding("flash", name, Colour.AMBER, words, remedy)
    late = flash.index - usual
    count = "one frame" if abs(late) == 1 else f"{abs(late)} frames"
    # Late: what was exposed at one trigger stands under a later one, so that the flash does too.
    words = (
        f"{name} saw the flash in frame {flash.index}, the others in frame {usual}: its frames are "
        f"filed {count} {'late' if late > 0 else 'early'}."
    )
    remedy = steps(
        (f"See that {name} has no trigger delay, divider or activation edge of its own.",
         f"See that {name} is on the common trigger line.",
         f"Stop and start the array, then flash again; do not record with {name} before it agrees.")
    )  # fmt: skip
    return Finding("flash", name, Colour.RED, words, remedy)
