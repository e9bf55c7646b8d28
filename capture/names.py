"""Names: which are safe as file names (devices, slates, takes), which a wrong one meant, and how
something is named once in a message."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable

_LONGEST = 64


def is_plain_name(name: object) -> bool:
    """Whether a name is safe as a file name: letters, digits, '-', '_', inner '.', at most 64."""
    return (
        isinstance(name, str)
        and 0 < len(name) <= _LONGEST
        and not name.startswith(".")
        and all(c.isalnum() or c in "-_." for c in name)
    )


def known_hint(name: object, known: Iterable[str]) -> str:
    """What to say to a name that is not known: the nearest known one, or else all of them."""
    names = list(known)
    near = difflib.get_close_matches(str(name), names, n=1)
    return f"did you mean {near[0]!r}?" if near else f"known: {', '.join(names)}"


def named(name: str, words: object) -> str:
    """What is said of something, with its name before it and nowhere else as such a mark."""
    return f"{name}: {unnamed(name, words)}"


def unnamed(name: str, words: object) -> str:
    """What is said of something whose name already stands elsewhere in the message."""
    return re.sub(rf"(?:^|(?<=[\s(])){re.escape(name)}: ", "", str(words))
