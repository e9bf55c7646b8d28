"""What a take must show of the board before it is worth solving, and what stands against it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from capture.errors import TakeError, raise_all
from recon.board.diagnosis import merged_words
from recon.board.mirrored import mirrored_devices
from recon.board.observations import BoardObservations
from recon.board.shape import BoardShape


def check_views(
    observations: BoardObservations,
    least_poses: int,
    least_views: int,
    tally: Mapping[str, Mapping[str, int]] | None = None,
    words: Mapping[str, str] | None = None,
) -> None:
    """Refuse a take in which a device, or all of them, saw too little of the board.

    Args:
        observations: usable corner sightings.
        least_poses: board poses the take must have.
        least_views: frames in which every device must have used the board.
        tally: by device, frames used and refused by reason, for the message.
        words: by device, what its images show, for the message.

    Raises:
        TakeError: naming every such device with its counts, and in one line those of which the
            same is said.
    """
    poses = len(np.unique(observations.pose))
    views = (observations.view_counts() > 0).sum(axis=1)
    problems = []
    said: dict[str, str] = {}
    for name, count in zip(observations.device_names, views.tolist(), strict=True):
        if count >= least_views:
            continue
        if words and words.get(name):
            said[name] = words[name]
        else:
            reasons = (tally or {}).get(name, {})
            told = ", ".join(f"{number} {reason}" for reason, number in reasons.items() if number)
            corners = int((observations.device == observations.device_names.index(name)).sum())
            problems.append(
                f"{name}: used the board in {count} frames with {corners} corners"
                + (f" ({told})" if told else "")
                + f"; at least {least_views} are needed: hold the board before this device"
            )
    lines = merged_words(said, len(views))
    if poses < least_poses and len(said) < len(views):
        frames = [sum(counts.values()) for counts in (tally or {}).values()]
        problems.insert(
            0,
            f"the board was used at {poses} poses"
            + (f" in {max(frames)} frames" if frames else "")
            + f"; at least {least_poses} are needed, 15 to 40 are good",
        )
    problems += lines
    raise_all("devices saw too little of the board", problems, TakeError)


def check_upright(observations: BoardObservations, shape: BoardShape) -> None:
    """Refuse a take in which devices show the board's corners in mirrored order.

    Raises:
        TakeError: naming them.
    """
    found = mirrored_devices(observations, shape)
    problems = [
        f"{name}: its images are mirrored: the board's corners run the wrong way round; switch off "
        "the mirror in its driver, or flip its files"
        for name in found
    ]
    raise_all("devices with mirrored images", problems, TakeError)
