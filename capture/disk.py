"""How long the disk lasts: a forecast in takes, not in bytes."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path

from capture.errors import WorkError

_AMBER_SHARE = 1.2  # room for this many times what is still to come, or amber


@dataclass(frozen=True, kw_only=True)
class DiskUse:
    """What the disk has taken so far, and what it will be asked to take.

    Attributes:
        free_bytes: what is free now.
        frame_set_bytes: of the frames of all devices at one trigger, from their layouts; used until
            takes have been observed.
        next_triggers: triggers of the next take.
        coming_triggers: of all takes still to come without retakes, the next included; one number
            each.
        observed: of each take so far, its triggers and its bytes on disk.
        retakes: how many of these were retakes.
        pending_bytes: what takes that are being written now will still need.
        reserve_bytes: what must stay free in any case.
    """

    free_bytes: int
    frame_set_bytes: int
    next_triggers: int
    coming_triggers: Sequence[int] = ()
    observed: Sequence[tuple[int, int]] = ()
    retakes: int = 0
    pending_bytes: int = 0
    reserve_bytes: int = 1 << 30


@dataclass(frozen=True, kw_only=True)
class DiskForecast:
    """How long the disk lasts.

    Attributes:
        free_bytes: what is free.
        take_bytes: what the next take needs.
        takes_left: takes like the next one that fit; below 1 nothing may be armed.
        prompts_left: prompts that fit with as many retakes as so far.
        prompts_coming: prompts still to come.
        colour: "green", "amber" when what is to come does not surely fit, "red" below one take.
        sentence: for the operator.
    """

    free_bytes: int
    take_bytes: int
    takes_left: int
    prompts_left: int
    prompts_coming: int
    colour: str
    sentence: str


def forecast(use: DiskUse) -> DiskForecast:
    """Reckon how many takes fit.

    The size of a take is its triggers times the bytes a trigger has cost so far, or costs by the
    devices' layouts before the first take.
    """
    fit, retake_rate = use.free_bytes - use.pending_bytes - use.reserve_bytes, _retake_rate(use)
    trigger_bytes = _trigger_bytes(use)
    take_bytes = max(1, math.ceil(trigger_bytes * use.next_triggers))
    takes_left = max(0, fit // take_bytes)
    needs = [trigger_bytes * triggers * (1 + retake_rate) for triggers in use.coming_triggers]
    prompts_left = sum(total <= fit for total in accumulate(needs))
    colour = "red" if takes_left < 1 else "amber" if _AMBER_SHARE * sum(needs) > fit else "green"
    return DiskForecast(
        free_bytes=use.free_bytes,
        take_bytes=take_bytes,
        takes_left=takes_left,
        prompts_left=prompts_left,
        prompts_coming=len(needs),
        colour=colour,
        sentence=_sentence(use, (take_bytes, takes_left, prompts_left), colour, sum(needs)),
    )


def bytes_in_words(count: float) -> str:
    """A size for people: "10.1 GB"; units of a thousand, as disks are sold."""
    for unit in ("B", "kB", "MB", "GB"):
        if abs(count) < 999.5:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} TB" if abs(count) < 999.5 else f"{count:.0f} TB"


def free_bytes(folder: Path) -> int:
    """What is free on the disk of a folder for a program that is not root.

    Raises:
        WorkError: naming the folder, when that cannot be told.
    """
    try:
        return shutil.disk_usage(folder).free
    except OSError as error:
        raise WorkError(f"{folder}: free space not known: {error.strerror or error}") from error


def folder_bytes(folder: Path) -> int:
    """The sum of the sizes of all files in a folder; 0 when it is not there."""
    total = 0
    for at, _, names in os.walk(folder):
        for name in names:
            try:
                total += (Path(at) / name).lstat().st_size
            except OSError:  # renamed or removed meanwhile
                continue
    return total


def _trigger_bytes(use: DiskUse) -> float:
    triggers = sum(count for count, _ in use.observed)
    total = sum(size for _, size in use.observed)
    return total / triggers if triggers and total else float(use.frame_set_bytes)


def _retake_rate(use: DiskUse) -> float:
    """Retakes for each first take so far."""
    firsts = len(use.observed) - use.retakes
    return use.retakes / firsts if firsts > 0 else 0.0


def _sentence(use: DiskUse, numbers: tuple[int, int, int], colour: str, needed_bytes: float) -> str:
    take_bytes, takes_left, prompts_left = numbers
    free, take = bytes_in_words(use.free_bytes), bytes_in_words(take_bytes)
    if colour == "red":
        reserve = bytes_in_words(use.reserve_bytes + use.pending_bytes)
        return (
            f"{free} free: not enough for one take of {take} beside {reserve} that must stay free. "
            "Free some before you arm."
        )
    takes = f"{free} free: room for {takes_left} take{'s' if takes_left > 1 else ''}"
    coming = len(use.coming_triggers)
    if not coming:
        return f"{takes}."
    rate = _retake_rate(use)
    with_retakes = f", with {rate:.2g} retakes each as so far," if rate else ""
    if colour == "green":
        need = f"need{'s' if coming == 1 else ''}"
        return f"{takes}; the {coming} to come{with_retakes} {need} {bytes_in_words(needed_bytes)}."
    if prompts_left < coming:
        return f"{takes}; of the {coming} to come{with_retakes} only {prompts_left} fit. Free some."
    return f"{takes}; the {coming} to come{with_retakes} barely fit. Free some."
