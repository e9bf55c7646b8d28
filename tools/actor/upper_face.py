"""Expressions of brows, cheeks and nose: smooth local pushes of the neutral."""

from __future__ import annotations

import numpy as np

from capture.arrays import Floats
from tools.actor.field import Field
from tools.actor.sculpt import EYE_LEVEL, bump, smooth_step


def upper_face_shapes(field: Field) -> dict[str, Floats]:
    """Deltas (V, 3) by name of brows, cheeks and nose."""
    made = field.both_sides("browDown", _brow_down(field))
    made |= field.both_sides("browOuterUp", _brow_outer_up(field))
    made |= field.both_sides("cheekSquint", _cheek_squint(field))
    made |= field.both_sides("noseSneer", _nose_sneer(field))
    made["browInnerUp"] = _brow_inner_up(field)
    made["cheekPuff"] = _cheek_puff(field)
    return made


def _above_lids(field: Field) -> Floats:
    """1 on the brow and the forehead, 0 on the lids, the back and inside."""
    outer = (field.lattice.ring == 0) * smooth_step(0.0, 30.0, field.z)
    top = smooth_step(88.0, 55.0, field.y)
    rise: Floats = smooth_step(EYE_LEVEL + 6.0, EYE_LEVEL + 15.0, field.y) * outer * top
    return rise


def _brow_down(field: Field) -> Floats:
    mask = _above_lids(field) * field.left
    whole = mask * bump((field.x - 26.0) / 21.0, (field.y - 26.0) / 13.0)
    inner = mask * bump((field.x - 11.0) / 9.0, (field.y - 24.0) / 11.0)
    root = (
        field.left
        * bump((field.x - 5.0) / 6.0, (field.y - 16.0) / 7.0)
        * smooth_step(60, 80, field.z)
    )
    delta = field.vector(whole, -1.6, -5.6, 0.6) + field.vector(inner, -1.6, -1.6, 1.6)
    return delta + field.vector(root, 0.0, -0.8, 0.9)


def _brow_outer_up(field: Field) -> Floats:
    mask = _above_lids(field) * field.left
    arch = mask * bump((field.x - 42.0) / 16.0, (field.y - 29.0) / 15.0)
    return field.vector(arch, 0.6, 7.5, -1.2)


def _brow_inner_up(field: Field) -> Floats:
    mask = _above_lids(field)
    rise = mask * bump((field.wide - 12.0) / 14.0, (field.y - 28.0) / 15.0)
    side = np.tanh(field.x / 6.0)
    delta = field.vector(rise, 0.0, 7.5, 0.2)
    delta[:, 0] -= 1.4 * rise * side
    return delta


def _cheek_squint(field: Field) -> Floats:
    low = smooth_step(EYE_LEVEL - 4.5, EYE_LEVEL - 12.0, field.y) * smooth_step(0.0, 30.0, field.z)
    mask = field.left * low * (field.lattice.ring == 0)
    apple = mask * bump((field.x - 37.0) / 17.0, (field.y + 15.0) / 14.0)
    return field.vector(apple, 0.8, 4.5, 2.6)


def _nose_sneer(field: Field) -> Floats:
    front = smooth_step(50.0, 70.0, field.z) * (field.lattice.ring == 0) * field.left
    wing = front * bump((field.x - 14.0) / 8.0, (field.y + 26.0) / 9.0)
    flank = front * bump((field.x - 10.0) / 7.0, (field.y + 6.0) / 9.0)
    lip = front * bump((field.x - 15.0) / 11.0, (field.y + 43.0) / 7.0)
    lip *= smooth_step(-57.0, -48.0, field.y)
    delta = field.vector(wing, 1.2, 4.2, 0.8) + field.vector(flank, -0.5, 2.6, 1.4)
    return delta + field.vector(lip, 0.3, 2.6, 0.6)


def _cheek_puff(field: Field) -> Floats:
    outer = (field.lattice.ring == 0) * smooth_step(5.0, 35.0, field.z)
    cheek = outer * bump((field.wide - 45.0) / 17.0, (field.y + 47.0) / 20.0)
    lip = outer * bump(field.x / 22.0, (field.y + 45.0) / 8.0) * smooth_step(-57.0, -50.0, field.y)
    puffed: Floats = field.normals * (9.0 * cheek + 2.2 * lip)[:, None]
    return puffed
