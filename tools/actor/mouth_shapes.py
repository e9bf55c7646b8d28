"""Expressions of jaw and mouth: a hinged jaw, and moves of the lips' edge spread over the skin."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from capture.arrays import Floats
from capture.pose import Pose
from tools.actor.field import Field
from tools.actor.sculpt import bump, smooth_step

_HINGE = np.array([0.0, -8.0, -2.0])
_JAW_OPEN_RADIANS = 0.285
_CORNER_SHARE = 0.42  # how far the corners of the mouth follow the jaw
_MEETING = 0.6  # where lips meet over an open jaw, from the upper lip's place


def move_jaw(name: str, points: Floats) -> Floats:
    """Where points (N, 3) on the jaw bone go at weight 1 of a jaw shape, head space mm."""
    away = points - _HINGE
    moved: Floats
    if name == "jawOpen":
        turn = Pose.from_rotation_vector(np.array([_JAW_OPEN_RADIANS, 0.0, 0.0]), np.zeros(3))
        moved = turn.apply(away) + _HINGE + np.array([0.0, -1.5, 3.0])
        return moved
    if name == "jawForward":
        moved = points + np.array([0.0, -0.8, 7.0])
        return moved
    sign = 1.0 if name == "jawLeft" else -1.0
    turn = Pose.from_rotation_vector(np.array([0.0, sign * 0.085, 0.0]), np.zeros(3))
    moved = turn.apply(away) + _HINGE + np.array([sign * 1.0, -1.0, 0.5])
    return moved


def jaw_shapes(field: Field) -> dict[str, Floats]:
    """Deltas (V, 3) by name of the jaw: rigid moves of the bone, spread by smooth weights."""
    weight = _jaw_weights(field)
    names = ("jawOpen", "jawForward", "jawLeft", "jawRight")
    return {name: weight[:, None] * (move_jaw(name, field.points) - field.points) for name in names}


def _jaw_weights(field: Field) -> Floats:
    """(V,) how far the skin follows the jaw bone: 1 on the chin, 0 above the mouth and behind."""
    x, y, z, slit = field.x, field.y, field.z, field.lattice.mouth
    chin = (field.wide < 32) & (y < -82) & (z > 50) & (field.lattice.row < 91)
    still = (y > -26) | (z < -20) | (field.lattice.row > 99) | ((y > -44) & (field.wide < 15))
    wanted = np.zeros((len(x), 1))
    wanted[chin] = 1.0
    held = chin | still
    place = np.abs(x[slit.upper]) / field.who.mouth_half_width
    bend = np.clip(place, 0.0, 1.0) ** 3.5
    wanted[slit.upper, 0] = _CORNER_SHARE * bend
    wanted[slit.lower, 0] = 1.0 - (1.0 - _CORNER_SHARE) * bend
    wanted[slit.corners, 0] = _CORNER_SHARE
    held[slit.rings[0]] = True
    weight = field.interpolator(held).spread(wanted)[:, 0]
    _fill_rings(field, weight[:, None])
    deep = slit.rings[1:]
    sides = np.sign(field.lattice.side[deep])
    share = np.linspace(0.0, 0.5, len(deep))[:, None]
    weight[deep] += share * (np.where(sides > 0, 0.0, np.where(sides < 0, 0.9, 0.5)) - weight[deep])
    limited: Floats = np.clip(weight, 0.0, 1.02)
    return limited


def _fill_rings(field: Field, values: Floats) -> None:
    """Give each ring of the mouth what its edge has, in place."""
    slit = field.lattice.mouth
    for ring in slit.rings[1:]:
        values[ring] = values[slit.rings[0]]


def mouth_shapes(field: Field, jaw_open: Floats) -> dict[str, Floats]:
    """Deltas (V, 3) by name of the lips.

    Args:
        field: the neutral.
        jaw_open: (V, 3) the delta that `mouthClose` undoes at the lips.
    """
    lips = _Lips(field)
    made: dict[str, Floats] = {}
    for name, move in _ONE_SIDED.items():
        made |= field.both_sides(name, lips.spread(move) + _extra(field, name))
    for name, move in _WHOLE.items():
        made[name] = lips.spread(move) + _extra(field, name)
    left = lips.spread(_mouth_left)
    made["mouthLeft"] = left
    made["mouthRight"] = left[field.mirror] * [-1.0, 1.0, 1.0]
    made["mouthClose"] = lips.close(jaw_open)
    return made


class _Lips:
    """Spreads moves of the lips' edge over the lower face."""

    def __init__(self, field: Field) -> None:
        self.field = field
        slit = field.lattice.mouth
        around = (field.y < -28) & (field.y > -108) & (field.z > 25) & (field.wide < 62)
        nose = (field.y > -37) & (field.wide < 13)
        held = ~around | nose
        held[slit.rings[0]] = True
        self.interpolator = field.interpolator(held)
        edge = slit.rings[0]
        self.place = np.clip(field.x[edge] / field.who.mouth_half_width, -1.0, 1.0)
        self.side = np.sign(field.lattice.side[edge]).astype(np.float64)

    def spread(self, move: Callable[[Floats, Floats], Floats]) -> Floats:
        """(V, 3) from what a move gives the edge: of place -1..1 across and side (+1 upper)."""
        field = self.field
        wanted = np.zeros_like(field.points)
        wanted[field.lattice.mouth.rings[0]] = move(self.place, self.side)
        return self._fill(self.interpolator.spread(wanted))

    def close(self, jaw_open: Floats) -> Floats:
        """(V, 3) that brings the lips together again over a jaw opened by `jaw_open` (V, 3)."""
        slit = self.field.lattice.mouth
        gap = jaw_open[slit.lower] - jaw_open[slit.upper]
        wanted = np.zeros_like(jaw_open)
        wanted[slit.upper] = _MEETING * gap
        wanted[slit.lower] = -(1.0 - _MEETING) * gap
        return self._fill(self.interpolator.spread(wanted))

    def _fill(self, delta: Floats) -> Floats:
        _fill_rings(self.field, delta)
        rings = self.field.lattice.mouth.rings
        fade = np.clip(1.25 - 0.2 * np.arange(len(rings)), 0.0, 1.0)
        for share, ring in zip(fade[1:], rings[1:], strict=True):
            delta[ring] *= share
        return delta


def _stack(x: Floats, y: Floats, z: Floats) -> Floats:
    return np.stack(np.broadcast_arrays(x, y, z), axis=1).astype(np.float64)


def _corner(place: Floats, power: float) -> Floats:
    """1 at the left corner, falling to 0 at the middle and beyond."""
    return np.clip(place, 0.0, 1.0) ** power


def _smile(place: Floats, side: Floats) -> Floats:
    pull = _corner(place, 1.7)
    lift = _corner(place, 2.2)
    return _stack(
        5.5 * pull, 7.5 * lift + 0.6 * side * (1 - pull) * (place > 0), -4.5 * _corner(place, 1.3)
    )


def _frown(place: Floats, side: Floats) -> Floats:
    return _stack(
        1.0 * _corner(place, 2.0), -7.0 * _corner(place, 2.2), -1.5 * _corner(place, 2.0) + 0 * side
    )


def _dimple(place: Floats, side: Floats) -> Floats:
    pull = _corner(place, 2.0)
    return _stack(3.0 * pull, 1.0 * pull, -5.0 * pull + 0 * side)


def _stretch(place: Floats, side: Floats) -> Floats:
    pull = _corner(place, 1.3)
    return _stack(8.0 * pull, -2.5 * _corner(place, 2.0), -5.5 * pull + 0 * side)


def _press(place: Floats, side: Floats) -> Floats:
    half = smooth_step(-0.25, 0.35, place)
    return _stack(1.2 * _corner(place, 2.0), 0.4 * half + 0 * side, -2.6 * half)


def _upper_up(place: Floats, side: Floats) -> Floats:
    lift = (side > 0) * bump((place - 0.38) / 0.5) * (1.0 - np.abs(place) ** 4)
    return _stack(0.4 * lift, 6.5 * lift, 0.9 * lift)


def _lower_down(place: Floats, side: Floats) -> Floats:
    drop = (side < 0) * bump((place - 0.38) / 0.5) * (1.0 - np.abs(place) ** 4)
    return _stack(0.6 * drop, -6.5 * drop, -0.6 * drop)


def _pucker(place: Floats, side: Floats) -> Floats:
    return _stack(-10.5 * place, 0.8 * side * (1 - place**2) * 0, 7.0 - 2.0 * place**2)


def _funnel(place: Floats, side: Floats) -> Floats:
    open_up = np.sqrt(np.clip(1.0 - place**2, 0.0, 1.0))
    return _stack(-7.0 * place, 5.2 * side * open_up, 6.5 - 3.0 * place**2)


def _roll_upper(place: Floats, side: Floats) -> Floats:
    turn = (side > 0) * (1.0 - np.abs(place) ** 3)
    return _stack(0 * turn, -0.4 * turn, -4.6 * turn)


def _roll_lower(place: Floats, side: Floats) -> Floats:
    turn = (side < 0) * (1.0 - np.abs(place) ** 3)
    return _stack(0 * turn, 0.4 * turn, -4.8 * turn)


def _shrug_upper(place: Floats, side: Floats) -> Floats:
    lift = (side > 0) * (1.0 - np.abs(place) ** 3)
    return _stack(0 * lift, 3.4 * lift, 1.8 * lift)


def _shrug_lower(place: Floats, side: Floats) -> Floats:
    lift = (1.0 - np.abs(place) ** 3) * np.where(side > 0, 0.97, 1.0)
    return _stack(0 * lift, 4.2 * lift, np.where(side < 0, 2.4, 1.2) * lift)


def _mouth_left(place: Floats, side: Floats) -> Floats:
    return _stack(7.5 - 1.5 * np.abs(place), 0.8 * place + 0 * side, -1.0 - 2.0 * place)


_ONE_SIDED: dict[str, Callable[[Floats, Floats], Floats]] = {
    "mouthSmile": _smile, "mouthFrown": _frown, "mouthDimple": _dimple, "mouthStretch": _stretch,
    "mouthPress": _press, "mouthUpperUp": _upper_up, "mouthLowerDown": _lower_down,
}  # fmt: skip
_WHOLE: dict[str, Callable[[Floats, Floats], Floats]] = {
    "mouthPucker": _pucker, "mouthFunnel": _funnel, "mouthRollUpper": _roll_upper,
    "mouthRollLower": _roll_lower, "mouthShrugUpper": _shrug_upper, "mouthShrugLower": _shrug_lower,
}  # fmt: skip


def _extra(field: Field, name: str) -> Floats:
    """What a shape does to the skin away from the lips: cheeks that gather, a chin that rises."""
    outer = (field.lattice.ring == 0) * smooth_step(10.0, 35.0, field.z)
    if name == "mouthSmile":
        cheek = outer * field.left * bump((field.x - 38.0) / 14.0, (field.y + 24.0) / 13.0)
        cheek *= smooth_step(2.0, -8.0, field.y)
        return field.vector(cheek, 1.6, 3.6, 2.2)
    if name == "mouthUpperUp":
        fold = outer * field.left * bump((field.x - 21.0) / 8.0, (field.y + 36.0) / 9.0)
        return field.vector(fold, 0.4, 2.2, 1.0)
    if name == "mouthShrugLower":
        chin = outer * bump(field.x / 17.0, (field.y + 86.0) / 11.0)
        return field.vector(chin, 0.0, 3.4, 1.2)
    return np.zeros_like(field.points)
