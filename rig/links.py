"""Which shapes have to do with each other: mirrored ones by name and place, exclusive ones told."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from capture.arrays import Bools, Ints
from capture.errors import raise_all
from capture.names import known_hint
from rig.naming import mirrored_name, side_of
from rig.template import Template
from rig.weights import WeightLinks

_ONE_SIDED = 0.8  # share of a shape's square displacement on its own half of the face


def find_links(template: Template, kept: Bools, exclusive: Sequence[str]) -> WeightLinks:
    """Mirrored shapes of a template as symmetric pairs, and the pairs told as exclusive ones.

    Two shapes whose names mirror each other are symmetric if each acts on one half of the face:
    `eyeBlinkLeft` and `eyeBlinkRight` do, `jawLeft` and `jawRight` move the whole jaw and do not.

    Args:
        template: the artist's rig; x runs across the face.
        kept: (B,) the shapes that are solved; the links count those alone, and pairs with
            another shape fall away.
        exclusive: pairs such as "jawLeft:jawRight".

    Raises:
        InputError: listing the names that the template does not have.
    """
    names = list(template.names)
    symmetric = [
        (index, names.index(mirrored_name(name)))
        for index, name in enumerate(names)
        if side_of(name) == "left" and mirrored_name(name) in names
        if _one_sided(template, index) and _one_sided(template, names.index(mirrored_name(name)))
    ]
    told = [tuple(part.strip() for part in pair.split(":")) for pair in exclusive]
    unknown = [name for pair in told for name in pair if name not in names]
    raise_all(
        "rig.exclusive",
        [f"{name}: the template has no such shape; {known_hint(name, names)}" for name in unknown],
    )
    excluded = [(names.index(first), names.index(other)) for first, other in told]
    return WeightLinks(symmetric=_pairs(symmetric, kept), exclusive=_pairs(excluded, kept))


def _one_sided(template: Template, shape: int) -> bool:
    square = (template.deltas[shape] ** 2).sum(axis=1)
    x = template.neutral[:, 0]
    middle = 0.5 * (x.min() + x.max())
    left = float(square[x > middle].sum())
    return max(left, float(square.sum()) - left) >= _ONE_SIDED * float(square.sum())


def _pairs(pairs: Sequence[tuple[int, int]], kept: Bools) -> Ints:
    number = np.cumsum(kept) - 1
    solved = [(number[a], number[b]) for a, b in pairs if kept[a] and kept[b]]
    return np.array(solved, dtype=np.int64).reshape(-1, 2)
