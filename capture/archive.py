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

from capture.arrays import Ints
from capture.errors import ShapeError
from capture.product import replacing

# All that numpy and zipfile raise on damaged bytes; an unknown compression, an encrypted entry and
# a header that asks for more memory than there is are damage too.
_DAMAGE = (
    ValueError, OSError, EOFError, RuntimeError, MemoryError, OverflowError,
    zipfile.BadZipFile, zlib.error, struct.error,
)  # fmt: skip
_LARGEST_BYTES = 16 << 30  # of one array: a few kilobytes of zip can claim any size
_TEXT = "names"  # keys that end so hold text
_NPY_MARK = b"\x93NUMPY"
_EPOCH = (1980, 1, 1, 0, 0, 0)  # zip entries carry a time: a fixed one keeps bytes equal


def read_archive(
    path: Path,
    required: Sequence[str],
    optional: Sequence[str] = (),
    *,
    gaps: Sequence[str] = (),
    largest_bytes: int = _LARGEST_BYTES,
) -> dict[str, NDArray[Any]]:
    """Read the named arrays of an `.npz`; other arrays in it are left alone.

    Keys that end in `names` hold text; all others hold real numbers.

    Args:
        path: the file.
        required: keys that must be there.
        optional: keys that are read when they are there.
        gaps: keys in which NaN says that there is no number; in all others it is damage.
        largest_bytes: an array that claims more is refused before memory is asked for it.

    Raises:
        ShapeError: naming the file and the key that is missing, pickled, damaged or too large.
    """
    path = Path(path)
    try:
        # Opened here and not by numpy, which leaves a damaged file open.
        with path.open("rb") as file:
            if (mark := file.read(6)) == _NPY_MARK:
                raise ShapeError(f"{path}: expected an .npz archive, found a single .npy array")
            if not mark.startswith(b"PK"):
                raise ShapeError(f"{path}: expected an .npz archive, found other first bytes")
            file.seek(0)
            archive: Any = np.load(file, allow_pickle=False)
            with archive:
                _check_sizes(archive, path, [*required, *optional], largest_bytes)
                out = _read_keys(archive, path, required, optional)
    except FileNotFoundError as error:
        raise ShapeError(f"{path}: no such file") from error
    except _DAMAGE as error:
        raise ShapeError(f"{path}: expected an .npz archive of arrays: {error}") from error
    for key, array in out.items():
        if array.dtype.kind != "f":
            continue
        good = ~np.isinf(array) if key in gaps else np.isfinite(array)
        if not good.all():
            bad = int((~good).sum())
            raise ShapeError(f"{path}: {key} holds {bad} numbers that are not finite")
    return out


def _check_sizes(archive: Any, path: Path, keys: Sequence[str], largest_bytes: int) -> None:
    for entry in archive.zip.infolist():
        key = entry.filename.removesuffix(".npy")
        if key in keys and entry.file_size > largest_bytes:
            raise ShapeError(
                f"{path}: {key} claims {entry.file_size} bytes; at most {largest_bytes} are read"
            )


def _read_keys(
    archive: Any, path: Path, required: Sequence[str], optional: Sequence[str]
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
        text = key.endswith(_TEXT)
        if array.dtype.kind not in ("U" if text else "iufb"):
            wanted = "text" if text else "real numbers"
            raise ShapeError(f"{path}: {key} must hold {wanted}, found {array.dtype}")
        out[key] = array
    return out


def whole_numbers(array: NDArray[Any], key: str) -> Ints:
    """Indices as int64, from an array of integers, or of floats that are integers.

    Raises:
        ShapeError: naming the key, when a number is not whole or beyond 2^31.
    """
    if array.size and not (np.abs(array) < 2.0**31).all():
        raise ShapeError(f"{key}: whole numbers below 2^31 are expected, found larger")
    whole = array.astype(np.int64)
    if not np.array_equal(whole, array):
        raise ShapeError(f"{key}: whole numbers are expected, found fractions")
    return whole


def write_archive(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write a compressed `.npz`, whole or not at all; the same arrays give the same bytes."""
    with replacing(path) as partial, zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as archive:
        for key, array in arrays.items():
            entry = zipfile.ZipInfo(f"{key}.npy", _EPOCH)
            entry.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(entry, "w", force_zip64=True) as handle:
                np.lib.format.write_array(handle, np.asanyarray(array), allow_pickle=False)
