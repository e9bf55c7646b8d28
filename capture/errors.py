"""The error tree. Every error that a user can meet is one of these.

::

    LikenessError
    |-- InputError            what the user gave does not fit: exit status 2
    |   |-- ShapeError        an array whose shape, type or values do not fit
    |   |-- SettingsError     a setting, or a table of settings, that does not fit
    |   |-- CameraError       a camera model or a cameras.json that does not fit
    |   |-- TakeError         a take, a session or a visiting take that does not fit
    |   `-- ExtraError        a feature whose optional packages are not installed
    `-- WorkError             the input is good and the work failed: exit status 1
        |-- DeviceError       a device did not do what was asked of it
        `-- SolveError        a numerical solve that did not reach an answer

A message says what was asked, of what, what was found, and what would be right or what to run.
Vendor exceptions are translated in the one module that imports the vendor.
"""

from __future__ import annotations

from collections.abc import Sequence


class LikenessError(Exception):
    """Root of every error that likeness raises on purpose."""

    exit_status = 1


class InputError(LikenessError):
    """What the user gave does not fit."""

    exit_status = 2


class ShapeError(InputError):
    """An array whose shape, type or values do not fit."""


class SettingsError(InputError):
    """A setting, or a table of settings, that does not fit."""


class CameraError(InputError):
    """A camera model, or a cameras.json, that does not fit."""


class TakeError(InputError):
    """A take, a session or a visiting take that does not fit."""


class ExtraError(InputError):
    """A feature whose optional packages are not installed."""

    def __init__(self, feature: str, package: str, extra: str) -> None:
        super().__init__(
            f"{feature} needs {package}, which is not installed; "
            f"install it with: pip install 'likeness[{extra}]'"
        )


class WorkError(LikenessError):
    """The input is good and the work failed."""


class DeviceError(WorkError):
    """A device did not do what was asked of it."""


class SolveError(WorkError):
    """A numerical solve that did not reach an answer."""


def raise_all(title: str, problems: Sequence[str], kind: type[InputError] = InputError) -> None:
    """Raise one error that lists every problem, or do nothing when there is none.

    Args:
        title: what was attempted, for the first line.
        problems: one line each, already naming the member that failed.
        kind: the class of error to raise.

    Raises:
        InputError: (as `kind`) when `problems` is not empty.
    """
    if not problems:
        return
    if len(problems) == 1:
        raise kind(f"{title}: {problems[0]}")
    lines = "\n".join(f"  - {problem}" for problem in problems)
    raise kind(f"{title}: {len(problems)} problems\n{lines}")
