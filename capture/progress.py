"""How a stage tells what it has done, without knowing who listens."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """Called by a stage after each step of its work."""

    def __call__(self, done: int, total: int, what: str) -> None:
        """Tell that `done` of `total` steps of the work called `what` are finished."""


def silent(done: int, total: int, what: str) -> None:
    """A listener that says nothing: the default of every stage."""
