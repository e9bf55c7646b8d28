"""What a reader says of damaged input, for tests in which harmless damage may pass."""

from __future__ import annotations

from collections.abc import Callable

from capture.errors import InputError


def refusal(action: Callable[[], object]) -> str:
    """The message of the input error that `action` raises; empty when it raises none."""
    try:
        action()
    except InputError as error:
        return str(error)
    return ""
