"""manifest-sha256.txt: the SHA-256 of every file of a take that never changes.

`sha256sum --check manifest-sha256.txt` in the take's folder reads it too, and so do BagIt tools.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path, PurePosixPath

from capture.errors import TakeError
from capture.product import hash_file, replacing

CHECKSUMS = "manifest-sha256.txt"
_FIXED = ("frames/*.mcap", "features/**/*", "ledger.csv", "opening.json", "take.json")
_LINE = re.compile(r"([0-9a-f]{64}) [ *](.+)")


def fixed_files(folder: Path) -> tuple[str, ...]:
    """The files of a take that never change, by their path inside it, sorted."""
    found = {path for pattern in _FIXED for path in folder.glob(pattern) if path.is_file()}
    return tuple(sorted(path.relative_to(folder).as_posix() for path in found))


def write_checksums(folder: Path, known: Mapping[str, str]) -> None:
    """Write manifest-sha256.txt of the files that never change.

    Args:
        folder: the take.
        known: by path inside the take, hashes that need not be computed again.
    """
    lines = [
        f"{known.get(name) or hash_file(folder / name)}  {name}\n" for name in fixed_files(folder)
    ]
    with replacing(folder / CHECKSUMS) as partial:
        partial.write_text("".join(lines), encoding="utf-8")


def read_checksums(folder: Path) -> dict[str, str]:
    """The hashes of manifest-sha256.txt, by path inside the take; none when it has no such file.

    Raises:
        TakeError: naming the file and the line that does not fit, or leads out of the take.
    """
    path = folder / CHECKSUMS
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        return {}
    except (OSError, UnicodeDecodeError) as error:
        raise TakeError(f"{path}: not readable: {error}") from error
    out = {}
    for number, line in enumerate(lines, start=1):
        matched = _LINE.fullmatch(line)
        if matched is None:
            raise TakeError(f"{path}:{number}: expected a SHA-256, two blanks and a path")
        name = PurePosixPath(matched[2])
        if name.is_absolute() or ".." in name.parts:
            raise TakeError(f"{path}:{number}: {matched[2]} lies outside the take")
        out[name.as_posix()] = matched[1]
    return out
