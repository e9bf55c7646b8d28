"""The levels a calibration is judged by, and the form of a finding."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from capture.errors import SettingsError, raise_all
from capture.settings import check_ranges

BAD = "bad"
WARN = "warn"


@dataclass(frozen=True, kw_only=True)
class GateSettings:
    """The levels of the verdict: within "good" nothing is said, beyond "usable" it is bad.

    Attributes:
        good_um: error that the calibration alone leaves over the face volume, where a pixel covers
            `pixel_mm` on the face. Scan noise of a good array is 50 to 100 um; a tenth of it does
            not show. Four times that, `usable_um`, still disappears in the noise of one scan,
            though not in the mean of many.
        usable_um: see `good_um`.
        pixel_mm: 2048 px cameras of 4000 px focal length at 900 mm cover 0.225 mm a pixel. Levels
            grow and shrink with it, since scan noise does: cameras of 640 px are not judged by the
            figures of finer ones.
        finest_um: but nothing finer than this is asked: lenses move more with their warmth.
        coarsest_um: and above this no calibration of a face is usable, however coarse its pixels; a
            quarter of it is the most that is good.
        good_views: poses a device should see. A view tells 8 lens and 6 place numbers little by
            itself; from 15 on, one view more or less moves a solve by less than its noise.
        usable_views: below it a few odd corners bend a lens.
        good_focal: relative standard deviation of a focal length: 2 px of 4000, twice what a
            take of 40 poses leaves in its worst device.
        usable_focal: four times that; a depth of 100 mm is then wrong by 0.2 mm if nothing else
            held it.
        good_ratio: held-out over training residual; noise alone gives 1.01 to 1.05.
        usable_ratio: half as much again is a solve that describes its own poses, not the array.
        good_split_px: 95th percentile of the projections of the face volume by two solves from half
            the poses each; a corner's own noise, so that neither half is worse than one sighting.
        usable_split_px: four times that.
        good_noise_px: standard deviation of a corner, per coordinate. Sharp, still boards give
            0.02 to 0.1 px, real lenses up to 0.2 px.
        usable_noise_px: the board moved, is blurred, or the lens model does not fit.
        good_rejected: share of corners dropped; glints and hidden corners cost 1 to 3 %.
        usable_rejected: with a fifth dropped, "the rest" may be the wrong part.
        odd_one: a residual so many times the usual one stands out; among good devices the largest
            is 1.2 times the median.
        very_odd: a device that far off spoils every scan it takes part in.
        systematic: mean residuals of the cells of an image, over the noise of a corner: up to it
            the lens model fits.
        least_tilt_deg: a board never tilted further leaves focal length and distance undecided.
        usable_shown: share of the face volume a board must have been in.
        good_scale: relative deviation of the scale bar; callipers reach 0.02 mm in 200 mm.
        usable_scale: 0.2 mm on a head of 200 mm is more than all other errors together.
        bow_mm: a board bent further will not keep its shape while it is waved.
        stretch: squares wider than high by this are a printer's fault, or a wrong board file.
        astray_mm: corners further beside their places (rms, stretch taken out) than any print puts
            them are those of another board.
        slight_px: dropped corners off by less than this (median) were found badly, not misplaced.
        most_reasons: in the list, so that it is read.
        most_poses: asked for; when more are needed, something else is wrong.
    """

    good_um: float = 5.0
    usable_um: float = 20.0
    pixel_mm: float = 0.225
    finest_um: float = 2.0
    coarsest_um: float = 100.0
    good_views: int = 15
    usable_views: int = 8
    good_focal: float = 5e-4
    usable_focal: float = 2e-3
    good_ratio: float = 1.15
    usable_ratio: float = 1.5
    good_split_px: float = 0.1
    usable_split_px: float = 0.4
    good_noise_px: float = 0.2
    usable_noise_px: float = 0.5
    good_rejected: float = 0.05
    usable_rejected: float = 0.2
    odd_one: float = 2.0
    very_odd: float = 4.0
    systematic: float = 0.5
    least_tilt_deg: float = 25.0
    usable_shown: float = 0.3
    good_scale: float = 5e-4
    usable_scale: float = 2e-3
    bow_mm: float = 1.0
    stretch: float = 1e-3
    astray_mm: float = 0.15
    slight_px: float = 1.5
    most_reasons: int = 12
    most_poses: int = 60

    def __post_init__(self) -> None:
        check_ranges(
            "gate", self, good_um=(0.01, 1e6), pixel_mm=(1e-4, 1e3), finest_um=(0.0, 1e6),
            good_views=(1, 10000), good_focal=(1e-7, 1.0), good_ratio=(1.0, 100.0),
            good_split_px=(1e-3, 100.0), good_noise_px=(1e-3, 100.0), good_rejected=(0.0, 1.0),
            odd_one=(1.0, 1e3), systematic=(0.0, 100.0), good_scale=(1e-6, 1.0),
            most_reasons=(1, 1000), most_poses=(1, 10000),
        )  # fmt: skip
        problems = [
            f"usable_{key}: must not be stricter than good_{key} = {good}, found {usable}"
            for key, good, usable in (
                ("um", self.good_um, self.usable_um),
                ("views", -self.good_views, -self.usable_views),
                ("focal", self.good_focal, self.usable_focal),
                ("ratio", self.good_ratio, self.usable_ratio),
                ("split_px", self.good_split_px, self.usable_split_px),
                ("noise_px", self.good_noise_px, self.usable_noise_px),
                ("rejected", self.good_rejected, self.usable_rejected),
                ("scale", self.good_scale, self.usable_scale),
            )
            if usable < good
        ]
        raise_all("gate settings", problems, SettingsError)

    def volume_levels_um(self, pixel_mm: float) -> tuple[float, float]:
        """What is good and what is usable where a pixel covers so much of the face, um.

        Args:
            pixel_mm: NaN gives the levels of the cameras that `pixel_mm` describes.
        """
        size = pixel_mm / self.pixel_mm if math.isfinite(pixel_mm) else 1.0
        usable = min(max(self.usable_um * size, self.finest_um), self.coarsest_um)
        share = self.good_um / self.usable_um
        good = min(max(self.good_um * size, self.finest_um), share * self.coarsest_um)
        return good, max(usable, good)

    @property
    def device_split_px(self) -> tuple[float, float]:
        """What is good and usable of one device's part in the comparison of two halves, px.

        The comparison is one draw of noise; of many devices the largest is about twice the usual.
        """
        return 2.0 * self.good_split_px, 2.0 * self.usable_split_px

    def level(self, value: float, good: float, usable: float) -> str | None:
        """None, `WARN` or `BAD` of a value of which less is better; NaN is not judged."""
        if not value > good:
            return None
        return BAD if value > usable else WARN

    def noise_excess(self, noise_px: float) -> float:
        """How many times noisier than good the corners are; 1 where they are good or unknown."""
        return max(1.0, noise_px / self.good_noise_px) if math.isfinite(noise_px) else 1.0

    def poses_needed(self, seen: float, value: float, good: float) -> int:
        """How many more poses bring a deviation down to what is good: it falls as 1/sqrt(n).

        Twice as many as there are, or `good_views` more, is the most that is asked at a time: a
        deviation far from good is known too roughly to tell more.

        Args:
            seen: poses that gave the deviation.
            value: of the deviation now.
            good: what it should be; both in the same unit.
        """
        if not value > good:
            return 0
        most = min(max(math.ceil(seen), self.good_views), self.most_poses)
        more = seen * ((value / good) ** 2 - 1.0)
        return most if not more < most else max(1, math.ceil(more - 1e-9))


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One thing that keeps a calibration from being good.

    Attributes:
        level: `WARN` or `BAD`.
        rank: of findings of one level the lower stands first: faults 0, then what the whole array
            lacks 1, devices 2, places 3, remarks 4.
        words: for the operator.
        device: whose it is; None for several or for the whole array.
        more_poses: that would mend it; None when poses are not what is missing.
    """

    level: str
    rank: int
    words: str
    device: str | None = None
    more_poses: int | None = None


def number_at(report: Mapping[str, Any], *keys: str) -> float:
    """The number under keys, one inside the other; NaN when it is missing or null."""
    value: Any = report
    for key in keys:
        value = value.get(key) if isinstance(value, Mapping) else None
    plain = isinstance(value, (int, float)) and not isinstance(value, bool)
    return float(value) if plain else math.nan


def part_of(report: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """The object under a key; empty when it is missing or null."""
    value = report.get(key)
    return value if isinstance(value, Mapping) else {}


def rows_of(report: Mapping[str, Any], key: str) -> Sequence[Any]:
    """The list under a key; empty when it is missing or null."""
    value = report.get(key)
    return value if isinstance(value, Sequence) and not isinstance(value, str) else ()


def worse(levels: Sequence[str | None]) -> str | None:
    """The worst of several levels."""
    return BAD if BAD in levels else (WARN if WARN in levels else None)


def plural(count: int, word: str) -> str:
    """A count and its word: "1 pose", "3 poses"."""
    return f"{count} {word}{'' if count == 1 else 's'}"
