"""Array aliases, and the run-time check of shapes at every public door."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from capture.errors import ShapeError

Floats: TypeAlias = NDArray[np.float64]
Floats32: TypeAlias = NDArray[np.float32]
Ints: TypeAlias = NDArray[np.int64]
Ints32: TypeAlias = NDArray[np.int32]
Bools: TypeAlias = NDArray[np.bool_]
Image: TypeAlias = NDArray[Any]


def check_shape(**arrays: tuple[NDArray[Any], str]) -> dict[str, int]:
    """Check arrays against shapes written in letters and numbers; equal letters must agree.

    `check_shape(points=(points, "N 3"), weights=(weights, "N"))` binds N from `points` and wants
    the same N of `weights`. A word is a number (that size), a letter (bound on first use), `*`
    (any size) or a leading `...` (any leading dimensions).

    Args:
        arrays: by name, the array and its expected shape.

    Returns:
        The size each letter was bound to.

    Raises:
        ShapeError: naming the array, the shape found and the shape expected.

    References:
        The idea is that of kornia's KORNIA_CHECK_SHAPE, with letters bound across arguments.
    """
    bound: dict[str, int] = {}
    owner: dict[str, str] = {}
    for name, (array, spec) in arrays.items():
        words = spec.split()
        shape = tuple(np.shape(array))
        if words and words[0] == "...":
            words = words[1:]
            tail = shape[len(shape) - len(words) :] if len(shape) >= len(words) else None
        else:
            tail = shape if len(shape) == len(words) else None
        if tail is None:
            raise ShapeError(f"{name}: expected shape ({spec}), found {shape}")
        for word, size in zip(words, tail, strict=True):
            if word == "*":
                continue
            if word.isdigit():
                if size != int(word):
                    raise ShapeError(f"{name}: expected shape ({spec}), found {shape}")
            elif word not in bound:
                bound[word], owner[word] = size, name
            elif bound[word] != size:
                raise ShapeError(
                    f"{name}: expected shape ({spec}) with {word} = {bound[word]} "
                    f"as in {owner[word]}, found {shape}"
                )
    return bound


def check_finite(**arrays: NDArray[Any]) -> None:
    """Refuse arrays that hold NaN or infinity.

    Raises:
        ShapeError: naming the array, how many entries are not finite, and the first of them.
    """
    for name, array in arrays.items():
        bad = ~np.isfinite(array)
        if bad.any():
            first = tuple(int(i) for i in np.argwhere(bad)[0])
            raise ShapeError(
                f"{name}: expected finite numbers, found {int(bad.sum())} that are not, "
                f"the first at index {first}"
            )
