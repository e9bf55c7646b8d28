"""Expressions of the eyelids: turns of the lids about their ball, so that they slide over it."""

from __future__ import annotations

import numpy as np

from capture.arrays import Bools, Floats, Ints
from tools.actor.field import Field
from tools.actor.lattice import EYE_ROW, Slit
from tools.actor.sculpt import LID_RADIUS, bump, smooth_step

_UPPER_ROWS, _LOWER_ROWS = 6, 6
_MEETING = 0.22  # share of the opening, from below, where shut lids meet
_SIDES = (("Right", -1.0), ("Left", 1.0))


def lid_shapes(field: Field) -> dict[str, Floats]:
    """Deltas (V, 3) by name of the lids: blink, squint, wide, and what follows the gaze.

    At weight 1 of a blink each vertex of the upper edge lies on its partner of the lower edge.
    """
    made: dict[str, Floats] = {}
    for eye, (side, sign) in enumerate(_SIDES):
        lid = _Lid(field, field.lattice.eyes[eye], field.sculpture.balls[eye])
        up, down = 1.0 - _MEETING, -_MEETING
        made[f"eyeBlink{side}"] = lid.turned(-up, -down)
        made[f"eyeSquint{side}"] = lid.turned(-0.12, 0.30) + _under_eye(field, sign)
        made[f"eyeWide{side}"] = lid.turned(0.24, -0.05)
        made[f"eyeLookDown{side}"] = lid.turned(-0.42, -0.10)
        made[f"eyeLookUp{side}"] = lid.turned(0.16, 0.06)
        made[f"eyeLookIn{side}"] = lid.bulged(-6.0 * sign)
        made[f"eyeLookOut{side}"] = lid.bulged(6.0 * sign)
    return made


def _under_eye(field: Field, sign: float) -> Floats:
    x, y = field.x * sign, field.y
    outer = (field.lattice.ring == 0) * smooth_step(2.0, -4.0, y) * smooth_step(20.0, 45.0, field.z)
    bag = outer * bump((x - 33.0) / 14.0, (y + 5.0) / 6.0)
    return field.vector(bag, 0.4 * sign, 1.6, 0.9)


class _Lid:
    """One eye's lids."""

    def __init__(self, field: Field, slit: Slit, ball: Floats) -> None:
        self.field, self.slit, self.ball = field, slit, ball
        self.count = len(slit.upper)
        self.upper_angle = self._elevation(field.points[slit.upper])
        self.lower_angle = self._elevation(field.points[slit.lower])

    def _elevation(self, points: Floats) -> Floats:
        """Angle above the horizontal plane about the axis through the ball along X, radians."""
        local = points - self.ball
        angle: Floats = np.arctan2(local[:, 1], local[:, 2])
        return angle

    def turned(self, upper: float, lower: float) -> Floats:
        """Move the edges by shares of the opening (up is positive) and let the lids follow."""
        field, slit = self.field, self.slit
        opening = self.upper_angle - self.lower_angle
        delta = np.zeros_like(field.points)
        for ids, turn, rows in (
            (slit.upper, upper * opening, -np.arange(1, _UPPER_ROWS + 1)),
            (slit.lower, lower * opening, np.arange(1, _LOWER_ROWS + 1)),
        ):
            moved = self._edge(ids, turn)
            delta[ids] = moved - field.points[ids]
            self._follow(delta, ids, turn, rows)
        self._roll(delta)
        return delta

    def _edge(self, ids: Ints, turn: Floats) -> Floats:
        """Edge vertices turned about the ball; partners that reach one angle reach one point."""
        pairs = self.field.points[self.slit.pairs].mean(axis=1) - self.ball
        local = self.field.points[ids] - self.ball
        angle = self._elevation(self.field.points[ids]) + turn
        radius = np.hypot(local[:, 1], local[:, 2])
        shut = np.maximum(np.sqrt(np.maximum(LID_RADIUS**2 - pairs[:, 0] ** 2, 0.0)),
                          np.hypot(pairs[:, 1], pairs[:, 2]))  # fmt: skip
        goal = self.lower_angle + _MEETING * (self.upper_angle - self.lower_angle)
        reach = np.abs(self._elevation(self.field.points[ids]) - goal)
        share = np.clip(np.abs(turn) / np.maximum(reach, 1e-9), 0.0, 1.0)
        share = np.where(turn * (goal - self._elevation(self.field.points[ids])) > 0, share, 0.0)
        radius = radius + share * (shut - radius)
        across = local[:, 0] + share * (pairs[:, 0] - local[:, 0])
        turned = np.stack([across, radius * np.sin(angle), radius * np.cos(angle)], axis=1)
        moved: Floats = self.ball + turned
        return moved

    def _follow(self, delta: Floats, ids: Ints, turn: Floats, rows: Ints) -> None:
        """Turn the rows of skin beyond an edge, the less the further they lie from it."""
        field = self.field
        fade = float(np.abs(rows).max()) + 1.0
        columns = self.slit.columns[1:-1]
        for row in rows:
            share = float(smooth_step(1.0, 0.0, np.array(abs(row) / fade)))
            line = field.lattice.grid[EYE_ROW + row, columns % field.lattice.grid.shape[1]]
            local = field.points[line] - self.ball
            radius = np.hypot(local[:, 1], local[:, 2])
            lever = np.minimum(1.0, LID_RADIUS / radius) ** 2
            angle = np.arctan2(local[:, 1], local[:, 2]) + share * lever * turn
            least = np.sqrt(np.maximum(LID_RADIUS**2 - local[:, 0] ** 2, 0.0))
            lid = np.exp(-((abs(row) / 5.0) ** 2))
            radius = np.maximum(radius, least * np.minimum(1.0, lid * 1.1))
            moved = np.stack([local[:, 0], radius * np.sin(angle), radius * np.cos(angle)], axis=1)
            delta[line] = moved + self.ball - field.points[line]

    def _roll(self, delta: Floats) -> None:
        """The lids' inner rings go where their edge goes."""
        for ring in self.slit.rings[1:]:
            delta[ring] = delta[self.slit.rings[0]]

    def bulged(self, shift: float) -> Floats:
        """The lids pushed out a little where the cornea passes under them."""
        field = self.field
        near = self._near()
        local = field.points - self.ball
        height = bump((local[:, 0] - shift) / 5.0, local[:, 1] / 8.0)
        height = height - 0.6 * bump(local[:, 0] / 5.0, local[:, 1] / 8.0)
        push: Floats = np.where(near, 0.55 * height, 0.0)
        length = np.maximum(np.linalg.norm(local, axis=1), 1.0)
        delta: Floats = push[:, None] * local / length[:, None]
        delta[self.slit.corners] = 0.0
        self._roll(delta)
        return delta

    def _near(self) -> Bools:
        rows = np.abs(self.field.lattice.row - EYE_ROW) <= _UPPER_ROWS
        columns = self.field.lattice.column
        near: Bools = rows & (columns > self.slit.columns[0]) & (columns < self.slit.columns[-1])
        return near
