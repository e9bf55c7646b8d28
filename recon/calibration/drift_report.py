"""What a drift check says: by device how far it has moved, and a verdict in words."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

from capture.arrays import Floats
from capture.pose import Pose

Verdict = Literal["still", "moved", "anew"]
DeviceVerdict = Literal["still", "moved", "lens", "unchecked"]
_OFF = 3.0  # times the noise that a residual may keep after any motion
_LOOSE_UM = 2000.0


@dataclass(frozen=True, eq=False, kw_only=True)
class DeviceDrift:
    """How one device stands against the others, compared with its calibration.

    Attributes:
        name: of the device.
        verdict: "still", "moved", "lens" (its focal length has changed, with or without a motion)
            or "unchecked".
        views: board poses at which it saw the board together with another device.
        corners: sightings used.
        motion: now_from_then in the camera's own space, mm.
        shift_um: how far its centre has moved, and `shift_sigma_um` the deviation of that.
        turn_mdeg: by which angle it has turned, and `turn_sigma_mdeg` the deviation of that.
        significance: Mahalanobis distance of the motion from none; noise alone gives about 2.4.
        effect_px: how far the motion displaces its corners in its image, rms.
        focal_change_px: were its focal length free too, and `focal_sigma_px` its deviation.
        sigma_px: noise of its corners, per coordinate.
        before_px: rms residual per coordinate where it was calibrated to stand.
        after_px: the same after the motion.
        remark: what else is to be said, or "".
    """

    name: str
    verdict: DeviceVerdict
    views: int
    corners: int
    motion: Pose
    shift_um: float
    shift_sigma_um: float
    turn_mdeg: float
    turn_sigma_mdeg: float
    significance: float
    effect_px: float
    focal_change_px: float
    focal_sigma_px: float
    sigma_px: float
    before_px: float
    after_px: float
    remark: str = ""

    def words(self) -> str:
        """One line: what has happened to it, and what to do."""
        if self.verdict == "unchecked":
            return f"{self.name} could not be checked: {self.remark}"
        told = (
            f"moved by {_length(self.shift_um)} and turned by {_angle(self.turn_mdeg)} "
            f"(sigma {_length(self.shift_sigma_um)}, {_angle(self.turn_sigma_mdeg)})"
        )
        rest = f"; {self.remark}" if self.remark else ""
        if self.verdict == "lens":
            return (
                f"{self.name}'s focal length has changed by {self.focal_change_px:+.2f} px "
                f"(sigma {self.focal_sigma_px:.2f} px), and it has {told}: "
                f"re-solve it with its lens{rest}"
            )
        if self.verdict == "moved":
            return f"{self.name} has {told}: re-solve it{rest}"
        return f"{self.name} has not moved: {told}, within noise{rest}"


@dataclass(frozen=True, eq=False, kw_only=True)
class DriftReport:
    """Whether an array still stands as it was calibrated.

    Attributes:
        verdict: "still", "moved" (fewer than half of the devices have) or "anew" (half or more
            disagree, so that none can be called the moved one).
        devices: one entry a camera, in their order.
        poses: board poses used.
        sigma_px: typical noise of a corner, per coordinate.
        inflation: by how much motions scatter beyond what noise explains; the deviations told are
            that much wider. Above 2 the calibration itself is worse than the corners.
        growth: by which fraction the still devices stand further apart than calibrated,
            if the board is what its file says.
        growth_sigma: deviation of that.
        board_factor: size of the board over that in its file, where only another size lets the
            devices agree; else 1.
        limits: (significance, px) both of which a motion must pass to count.
        strangers: devices of the take that the calibration does not know.
        corners: (N, 3) shape of the board that fits best, mm.
    """

    verdict: Verdict
    devices: tuple[DeviceDrift, ...]
    poses: int
    sigma_px: float
    inflation: float
    growth: float
    growth_sigma: float
    board_factor: float
    limits: tuple[float, float]
    strangers: tuple[str, ...]
    corners: Floats

    @property
    def moved(self) -> tuple[str, ...]:
        """Names of the devices to solve anew."""
        return tuple(d.name for d in self.devices if d.verdict in ("moved", "lens"))

    @property
    def unchecked(self) -> tuple[str, ...]:
        """Names of the devices that did not see enough to be judged."""
        return tuple(d.name for d in self.devices if d.verdict == "unchecked")

    def headline(self) -> str:
        """The verdict in one line."""
        checked = [d for d in self.devices if d.verdict != "unchecked"]
        if self.verdict == "anew":
            return (
                f"{len(self.moved)} of {len(checked)} devices disagree with the others, half of "
                "them or more: calibrate anew"
            )
        if self.verdict == "moved":
            names = " and ".join(self.moved)
            some = "has" if len(self.moved) == 1 else "have"
            return f"{names} {some} changed, the other {len(checked) - len(self.moved)} have not"
        shift = max((d.shift_um for d in checked), default=float("nan"))
        turn = max((d.turn_mdeg for d in checked), default=float("nan"))
        return (
            f"nothing has moved: largest change {_length(shift)}, {_angle(turn)}, within noise "
            f"({max((d.effect_px for d in checked), default=float('nan')):.3f} px in the image)"
        )

    def words(self) -> list[str]:
        """The verdict, then one line for everything an operator should know."""
        lines = [self.headline()]
        if self.board_factor != 1.0:
            factor = self.board_factor
            lines.append(
                f"the devices agree only with a board {factor:.4f} times as large as its file "
                f"says: is square_mm right (a square of 20 mm would be {20.0 * factor:.2f} mm), or "
                f"do all devices stand {_percent(1 / factor - 1)} apart?"
            )
        told = ("unchecked",) if self.verdict == "anew" else ("moved", "lens", "unchecked")
        lines += [d.words() for d in self.devices if d.verdict in told]
        if self.verdict != "anew":
            lines += [f"{d.name}: {d.remark}" for d in self.devices if self._asks(d)]
        strong = abs(self.growth) > self.limits[0] * self.growth_sigma
        if self.verdict != "anew" and self.board_factor == 1.0 and strong:
            lines.append(
                f"all devices stand {_percent(self.growth)} apart than calibrated "
                f"(sigma {1e6 * self.growth_sigma:.0f} parts in a million): has the temperature "
                "of the stand or of the board changed, and is the size of the board right?"
            )
        if self.inflation > 2.0 and self.verdict != "anew":
            lines.append(
                f"changes are {self.inflation:.1f} times larger than noise explains, for all "
                "devices alike: the calibration, or the shape of the board, is worse than the "
                "corners seen now"
            )
        if self.strangers:
            lines.append(
                f"{', '.join(self.strangers)}: in the take, but not among the calibrated cameras"
            )
        return lines

    @staticmethod
    def _asks(device: DeviceDrift) -> bool:
        return device.verdict == "still" and bool(device.remark)

    def document(self) -> dict[str, Any]:
        """All of it, ready for JSON; a number that could not be determined is null."""
        return {
            "verdict": self.verdict,
            "headline": self.headline(),
            "words": self.words(),
            "moved": list(self.moved),
            "unchecked": list(self.unchecked),
            "poses": self.poses,
            "sigma_px": _number(self.sigma_px),
            "inflation": _number(self.inflation),
            "growth_ppm": _number(1e6 * self.growth),
            "growth_sigma_ppm": _number(1e6 * self.growth_sigma),
            "board_factor": _number(self.board_factor),
            "limits": {"significance": self.limits[0], "effect_px": self.limits[1]},
            "devices": [_device(device) for device in self.devices],
        }


def device_remark(shift_sigma_um: float, after_px: float, sigma_px: float) -> str:
    """What to say of a device besides its motion: badly determined, or not explained by it."""
    if _LOOSE_UM < shift_sigma_um < math.inf:
        return (
            f"its place is known to {_length(shift_sigma_um)} only: hold the board where it sees "
            "it together with others, nearer and further away"
        )
    if after_px > _OFF * sigma_px:
        return (
            f"its residual stays at {after_px:.2f} px after any motion (noise {sigma_px:.2f} px): "
            "is it in step with the others?"
        )
    return ""


def _device(device: DeviceDrift) -> dict[str, Any]:
    told: dict[str, Any] = {
        "name": device.name, "verdict": device.verdict, "words": device.words(),
        "views": device.views, "corners": device.corners,
    }  # fmt: skip
    numbers = (
        "shift_um", "shift_sigma_um", "turn_mdeg", "turn_sigma_mdeg", "significance", "effect_px",
        "focal_change_px", "focal_sigma_px", "sigma_px", "before_px", "after_px",
    )  # fmt: skip
    return told | {name: _number(getattr(device, name)) for name in numbers}


def _number(value: float) -> float | None:
    return float(f"{value:.6g}") if math.isfinite(value) else None


def _length(um: float) -> str:
    return f"{um:.2g} um" if um < 99.5 else f"{um / 1000:.2f} mm" if um < 1e4 else _far(um)


def _far(um: float) -> str:
    return f"{um / 1000:.0f} mm"


def _angle(mdeg: float) -> str:
    return f"{mdeg:.2g} mdeg" if mdeg < 99.5 else f"{mdeg / 1000:.2f} deg"


def _percent(fraction: float) -> str:
    way = "further" if fraction > 0 else "less far"
    size = abs(fraction)
    return f"{100 * size:.1f} % {way}" if size >= 1e-3 else f"{1e6 * size:.0f} ppm {way}"
