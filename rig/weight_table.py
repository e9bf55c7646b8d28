"""`WeightTable`: named weights through time, known beforehand or solved, and its file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.archive import read_archive, write_archive
from capture.arrays import Floats, Ints, check_finite, check_shape
from capture.errors import InputError, ShapeError, raise_all
from rig.template import duplicate_names, text_names


@dataclass(frozen=True, eq=False, kw_only=True)
class WeightTable:
    """Weights of named shapes, one row a frame.

    Attributes:
        weights: (F, B) float64; nominal range 0..1.
        names: B names.
        t_ns: (F,) int64 time stamps, ns, or None.
    """

    weights: Floats
    names: tuple[str, ...]
    t_ns: Ints | None = None

    def __post_init__(self) -> None:
        check_shape(weights=(self.weights, "F B"), names=(np.asarray(self.names), "B"))
        check_finite(weights=self.weights)
        if self.t_ns is not None:
            check_shape(weights=(self.weights, "F *"), t_ns=(self.t_ns, "F"))
        raise_all("weights", duplicate_names(self.names), ShapeError)

    def columns(self, names: Sequence[str]) -> Floats:
        """The weights (F, B) in the order of `names`; a name it lacks is 0 throughout.

        Raises:
            InputError: listing the names here that `names` does not hold.
        """
        unknown = [name for name in self.names if name not in names]
        if unknown:
            raise InputError(
                f"weights: {len(unknown)} names are not shapes of the template: "
                f"{', '.join(unknown[:8])}; the template's begin {', '.join(list(names)[:4])}"
            )
        out = np.zeros((len(self.weights), len(names)))
        for column, name in enumerate(self.names):
            out[:, list(names).index(name)] = self.weights[:, column]
        return out


def read_weights(path: Path) -> WeightTable:
    """Read weights.npz: weights (F, B), names (B), optional t_ns (F); nothing unpickled.

    Raises:
        InputError: naming the file, and the key or shape that does not fit.
    """
    arrays = read_archive(path, ("weights", "names"), optional=("t_ns",))
    try:
        return WeightTable(
            weights=arrays["weights"].astype(np.float64),
            names=text_names(arrays["names"]),
            t_ns=arrays["t_ns"].astype(np.int64) if "t_ns" in arrays else None,
        )
    except InputError as error:
        raise ShapeError(f"{path}: {error}") from error


def write_weights(path: Path, table: WeightTable) -> None:
    """Write weights.npz, whole or not at all."""
    arrays: dict[str, NDArray[Any]] = {
        "weights": table.weights,
        "names": np.array(table.names, dtype=np.str_),
    }
    if table.t_ns is not None:
        arrays["t_ns"] = table.t_ns
    write_archive(path, arrays)
