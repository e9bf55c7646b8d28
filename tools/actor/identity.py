"""Who the actor is: the proportions that the sculpting reads, drawn from a seed."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Identity:
    """Proportions of one head; the defaults are the artist's generic head.

    Attributes:
        seed: for everything random about this head; -1 for the generic one.
        head_width: scale of the cranium's breadth.
        face_length: scale of the height below the eyes.
        cheek_width: outward push of the cheekbones, mm.
        jaw_width: outward push of the jaw angle, mm.
        chin_forward: push of the chin along +Z, mm.
        brow_ridge: depth of the brow ridge, mm.
        eye_spacing: outward shift of each eye, mm.
        eye_opening: height of the open lids at mid eye, mm.
        eye_tilt: rise of the outer corner, mm.
        nose_length: drop of the nose tip, mm.
        nose_height: height of the tip above the face, mm.
        nose_bridge: height of the bridge above the face at half length, mm.
        nose_width: distance of a nose wing from the midline, mm.
        lip_fullness: scale of the red of the lips.
        mouth_half_width: from the midline to a corner, mm.
        brow_height: lift of the drawn eyebrows, mm.
        brow_thickness: half height of the drawn eyebrows, mm.
        skin: albedo of the plain skin.
        blotches: strength of the broad variation of the albedo.
        freckles: strength of the freckles.
        gloss: strength of the highlights.
        lumps: amplitude of the smooth irregularity of the whole head, mm.
    """

    seed: int = -1
    head_width: float = 1.0
    face_length: float = 1.0
    cheek_width: float = 0.0
    jaw_width: float = 0.0
    chin_forward: float = 0.0
    brow_ridge: float = 2.0
    eye_spacing: float = 0.0
    eye_opening: float = 9.2
    eye_tilt: float = 1.5
    nose_length: float = 0.0
    nose_height: float = 22.0
    nose_bridge: float = 12.0
    nose_width: float = 15.5
    lip_fullness: float = 1.0
    mouth_half_width: float = 25.0
    brow_height: float = 0.0
    brow_thickness: float = 4.0
    skin: float = 0.55
    blotches: float = 1.0
    freckles: float = 0.5
    gloss: float = 1.0
    lumps: float = 0.0

    @property
    def generic(self) -> bool:
        """Whether this is the artist's head rather than an actor's."""
        return self.seed < 0


_SPREAD = {
    "head_width": 0.025, "face_length": 0.035, "cheek_width": 1.5, "jaw_width": 2.6,
    "chin_forward": 2.0, "brow_ridge": 1.0, "eye_spacing": 0.8, "eye_opening": 0.6,
    "eye_tilt": 0.9, "nose_length": 1.8, "nose_height": 1.8, "nose_bridge": 1.5,
    "nose_width": 1.2, "lip_fullness": 0.14, "mouth_half_width": 1.2, "brow_height": 1.0,
    "brow_thickness": 0.5, "skin": 0.05, "blotches": 0.25, "freckles": 0.3, "gloss": 0.2,
}  # fmt: skip


def make_identity(seed: int | None) -> Identity:
    """Draw the proportions of one head; None gives the artist's generic head.

    Args:
        seed: any whole number; equal seeds give equal heads.
    """
    if seed is None:
        return Identity()
    random = np.random.default_rng([seed, 17])
    values: dict[str, float] = {}
    for field in fields(Identity):
        spread = _SPREAD.get(field.name)
        if spread is not None:
            step = float(np.clip(random.normal(), -1.8, 1.8))
            values[field.name] = float(field.default) + spread * step  # type: ignore[arg-type]
    values["freckles"] = max(values["freckles"], 0.0)
    return Identity(seed=seed, lumps=1.2, **values)
