"""Sentences that several parts of the session say."""

from __future__ import annotations

from collections.abc import Sequence

_NAMED = 3


def no_room() -> str:
    """Why nothing is recorded when the disk is full."""
    return (
        "The disk has no room for one more take: free some, or move finished takes elsewhere "
        "once they are archived."
    )


def listed(items: Sequence[str]) -> str:
    """The first few, and how many more there are."""
    rest = len(items) - _NAMED
    return ", ".join(items[:_NAMED]) + (f" and {rest} more" if rest > 0 else "")
