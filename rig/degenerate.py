"""Shapes that no solver can tell apart or use: still, doubled, made of others, or not shapes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from capture.arrays import Bools, Floats, Ints, check_finite, check_shape

STILL_MM = 1e-3  # a shape that moves no vertex further has no effect to solve for
TOLERANCE = 1e-3  # of a shape's own root mean square: what may be left unexplained
_LEAST_PART = 1e-3  # of a dependent shape's size: parts that add less are not named
_MESH_LIKE = 0.9  # cosine with the neutral's own form above which a shape holds a whole mesh
_MESH_SCALE = (0.2, 5.0)  # such a shape's size against the neutral's
_RIGID = 0.02  # of its size: what a shape that only moves the whole head may deform
_NEUTRALS = ("neutral", "basis", "base", "rest", "default")


@dataclass(frozen=True)
class Duplicate:
    """Two shapes that move alike: `shape = scale x of`, within the tolerance.

    Attributes:
        shape: the later one.
        of: the earlier one.
        scale: 1 the same, -1 its opposite.
    """

    shape: str
    of: str
    scale: float


@dataclass(frozen=True)
class Dependence:
    """A shape that others make: `shape = sum of factor x name`, within the tolerance.

    Attributes:
        shape: its name.
        parts: names and their factors, the largest contribution first.
        rest: what they leave unexplained, as a share of the shape's root mean square.
    """

    shape: str
    parts: tuple[tuple[str, float], ...]
    rest: float

    def __str__(self) -> str:
        terms = [
            f"{'-' if factor < 0 else '+'} {abs(factor):.3g} {name}" for name, factor in self.parts
        ]
        return f"{self.shape} = {' '.join(terms).removeprefix('+ ')}"


@dataclass(frozen=True)
class Degeneracy:
    """What is wrong with a set of shapes as a basis.

    Attributes:
        zero: shapes that move no vertex by more than `STILL_MM`.
        not_shapes: shapes that hold a whole mesh or a motion of the whole head, with the reason.
        duplicates: pairs that move alike.
        dependent: shapes that several others make; duplicates are not told again.
        condition: largest over smallest singular value of the shapes that are neither zero nor
            no shapes, each scaled to size 1; 1e8 stands for anything beyond the precision.
    """

    zero: tuple[str, ...]
    not_shapes: dict[str, str]
    duplicates: tuple[Duplicate, ...]
    dependent: tuple[Dependence, ...]
    condition: float

    def as_report(self) -> dict[str, Any]:
        """The same as plain lists and texts, for JSON."""
        dependent = [
            {
                "shape": d.shape,
                "equals": str(d),
                "parts": dict(d.parts),
                "rest": d.rest,
            }
            for d in self.dependent
        ]
        return {
            "zero": list(self.zero),
            "not_shapes": dict(self.not_shapes),
            "duplicates": [asdict(d) for d in self.duplicates],
            "dependent": dependent,
            "condition": self.condition,
        }


def find_degenerate(
    deltas: Floats, names: Sequence[str], neutral: Floats, tolerance: float = TOLERANCE
) -> Degeneracy:
    """Find shapes that are still, doubled, dependent on others, or no shapes at all.

    One product of all shapes with each other answers everything; a pivoted Cholesky factorisation
    of it, shapes scaled to size 1, separates a basis from the shapes that depend on it.

    Args:
        deltas: (B, V, 3) mm.
        names: B names.
        neutral: (V, 3) mm.
        tolerance: what may be left unexplained, as a share of a shape's root mean square. Above
            1e-6: float32 files hold no more.
    """
    check_shape(deltas=(deltas, "B V 3"), names=(np.asarray(names), "B"), neutral=(neutral, "V 3"))
    check_finite(deltas=deltas, neutral=neutral)
    extents = np.sqrt(np.einsum("bva,bva->bv", deltas, deltas).max(axis=1, initial=0.0))
    zero = tuple(name for name, mm in zip(names, extents, strict=True) if mm <= STILL_MM)
    not_shapes = {
        name: "the neutral imported as a shape (it moves nothing)"
        for name in zero
        if name.casefold() in _NEUTRALS
    }
    moving: list[int] = []
    for k in np.flatnonzero(extents > STILL_MM).tolist():
        reason = _not_a_shape(deltas[k], neutral, float(extents[k]), tolerance)
        if reason:
            not_shapes[names[k]] = reason
        else:
            moving.append(k)
    flat = deltas[moving].reshape(len(moving), 3 * deltas.shape[1])
    sizes = np.sqrt(np.einsum("bn,bn->b", flat, flat))
    cosines = (flat @ flat.T) / np.outer(sizes, sizes)
    called = [names[k] for k in moving]
    duplicates, single = _duplicates(cosines, sizes, called, tolerance)
    kept = np.flatnonzero(single).tolist()
    dependent = _dependent(
        cosines[np.ix_(kept, kept)], sizes[kept], [called[k] for k in kept], tolerance
    )
    return Degeneracy(zero, not_shapes, duplicates, dependent, _condition(cosines))


def _duplicates(
    cosines: Floats, sizes: Floats, names: Sequence[str], tolerance: float
) -> tuple[tuple[Duplicate, ...], Bools]:
    """Pairs whose difference, best scaled, is within tolerance; and which shapes come first."""
    alike = 1.0 - cosines**2 <= max(tolerance, 1e-7) ** 2  # squared sine of the angle
    single = np.ones(len(names), dtype=bool)
    found = []
    for later in range(len(names)):
        earlier = np.flatnonzero(alike[later, :later] & single[:later])
        if len(earlier):
            first = int(earlier[0])
            single[later] = False
            scale = float(cosines[later, first] * sizes[later] / sizes[first])
            found.append(Duplicate(names[later], names[first], scale))
    return tuple(found), single


def _dependent(
    cosines: Floats, sizes: Floats, names: Sequence[str], tolerance: float
) -> tuple[Dependence, ...]:
    """Shapes within the span of a basis chosen greedily, and what of the basis makes them."""
    basis, rest = _pivots(cosines, max(tolerance, 1e-7))
    outside = np.setdiff1d(np.arange(len(names)), basis)
    if not len(outside):
        return ()
    factors = np.linalg.solve(cosines[np.ix_(basis, basis)], cosines[np.ix_(basis, outside)])
    found = []
    for column, shape in enumerate(outside):
        parts = factors[:, column]
        order = [i for i in np.argsort(-np.abs(parts)) if abs(parts[i]) >= _LEAST_PART]
        named = tuple(
            (names[basis[i]], float(parts[i] * sizes[shape] / sizes[basis[i]])) for i in order
        )
        found.append(Dependence(names[shape], named, float(np.sqrt(rest[shape]))))
    return tuple(found)


def _pivots(gram: Floats, tolerance: float) -> tuple[Ints, Floats]:
    """Pivoted Cholesky: the columns of a basis, and what it leaves of each column, squared."""
    left = np.diag(gram).copy()
    rows = np.zeros((0, len(gram)))
    basis: list[int] = []
    while len(basis) < len(gram):
        pivot = int(np.argmax(left))
        if left[pivot] <= tolerance**2:
            break
        row = (gram[pivot] - rows[:, pivot] @ rows) / np.sqrt(left[pivot])
        rows = np.vstack([rows, row])
        left = np.maximum(left - row**2, 0.0)
        left[pivot] = 0.0
        basis.append(pivot)
    return np.array(basis, dtype=np.int64), left


def _not_a_shape(delta: Floats, neutral: Floats, extent_mm: float, tolerance: float) -> str:
    """Why a delta is a mesh or a motion of the head instead of a shape; "" when it is a shape."""
    form = neutral - neutral.mean(axis=0)
    bent = delta - delta.mean(axis=0)
    form_size, bent_size = float(np.linalg.norm(form)), float(np.linalg.norm(bent))
    if bent_size <= _RIGID * float(np.linalg.norm(delta)):
        return f"moves every vertex alike, by {extent_mm:.3g} mm: a motion of the head"
    if form_size == 0.0:
        return ""
    cosine = float((form * bent).sum()) / (form_size * bent_size)
    low, high = _MESH_SCALE
    if abs(cosine) >= _MESH_LIKE and low <= bent_size / form_size <= high:
        what = "a mesh where a displacement belongs: subtract the neutral"
        if cosine > 0 and np.linalg.norm(bent - form) <= tolerance * form_size:
            what = "the neutral imported as a shape"
        elif cosine < 0:
            what = "minus the neutral: a shape that was zero when the neutral was subtracted"
        return f"{what} (it moves vertices by up to {extent_mm:.3g} mm)"
    return ""


def _condition(cosines: Floats) -> float:
    if not len(cosines):
        return 1.0
    values = np.linalg.eigvalsh(cosines)
    return float(min(np.sqrt(values[-1] / max(float(values[0]), 1e-300)), 1e8))
