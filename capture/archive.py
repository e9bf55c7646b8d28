"""Arrays on disk: `.npz` read without unpickling, written whole and byte for byte the same."""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.errors import ShapeError
from capture.product import replacing

# All that numpy and zipfile raise on damaged bytes; an unknown compression, an encrypted entry and
# a header that asks for more memory than there is are damage too.
_DAMAGE = (
    ValueError, OSError, EOFError, RuntimeError, MemoryError, OverflowError,
    zipfile.BadZipFile, zlib.error, struct.error,
)  # fmt: skip
_EPOCH = (1980, 1, 1, 0, 0, 0)  # zip entries carry a time: a fixed one keeps bytes equal


def read_archive(
    path: Path, required: Sequence[str], optional: Sequence[str] = ()
) -> dict[str, NDArray[Any]]:
    """Read the named arrays of an `.npz`; other arrays in it are left alone.

    Args:
        path: the file.
        required: keys that must be there.
        optional: keys that are read when they are there.

    Raises:
        ShapeError: naming the file and the key that is missing, pickled or damaged.
    """
    path = Path(path)
    try:
        # Opened here and not by numpy, which leaves a damaged file open.
        with path.open("rb") as file:
            archive = np.load(file, allow_pickle=False)
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise ShapeError(f"{path}: expected an .npz archive, found a single .npy array")
            with archive:
                out = _read_keys(archive, path, required, optional)
    except FileNotFoundError as error:
        raise ShapeError(f"{path}: no such file") from error
    except _DAMAGE as error:
        raise ShapeError(f"{path}: expected an .npz archive of arrays: {error}") from error
    for key, array in out.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            bad = int((~np.isfinite(array)).sum())
            raise ShapeError(f"{path}: {key} holds {bad} numbers that are not finite")
    return out


def _read_keys(
    archive: np.lib.npyio.NpzFile, path: Path, required: Sequence[str], optional: Sequence[str]
) -> dict[str, NDArray[Any]]:
    missing = [key for key in required if key not in archive.files]
    if missing:
        raise ShapeError(
            f"{path}: missing {', '.join(missing)}; "
            f"it holds {', '.join(archive.files) or 'nothing'}"
        )
    out: dict[str, NDArray[Any]] = {}
    for key in [*required, *(key for key in optional if key in archive.files)]:
        try:
            array = archive[key]
        except _DAMAGE as error:
            raise ShapeError(f"{path}: {key} cannot be read: {error}") from error
        if not isinstance(array, np.ndarray):
            raise ShapeError(f"{path}: {key} cannot be read: it is not an array")
        out[key] = array
    return out


def write_archive(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write a compressed `.npz`, whole or not at all; the same arrays give the same bytes."""
    with replacing(path) as partial, zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as archive:
        for key, array in arrays.items():
            entry = zipfile.ZipInfo(f"{key}.npy", _EPOCH)
            entry.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(entry, "w", force_zip64=True) as handle:
                np.lib.format.write_array(handle, np.asanyarray(array), allow_pickle=False)
