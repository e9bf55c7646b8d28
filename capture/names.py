"""Names that become file names: devices, slates, takes."""

from __future__ import annotations

_LONGEST = 64


def is_plain_name(name: object) -> bool:
    """Whether a name is safe as a file name: letters, digits, '-', '_', inner '.', at most 64."""
    return (
        isinstance(name, str)
        and 0 < len(name) <= _LONGEST
        and not name.startswith(".")
        and all(c.isalnum() or c in "-_." for c in name)
    )
