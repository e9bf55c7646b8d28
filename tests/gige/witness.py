"""A device whose every frame is looked at as it is polled: its pixels prove its number.

A fake camera draws (x + y + number) mod 255 at gain 0 and an exposure of 10 ms.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray

from capture.devices.aravis import AravisDevice, backend
from capture.frame import FrameEvent
from capture.ledger import Oddity, Verdict
from capture.take import Take

EXPOSURE_US = 10_000.0
SIZE = 256
IDS = 65_535  # frame numbers run from 1 to this, and begin again


@cache
def drawn(number: int, size: int = SIZE) -> NDArray[np.uint8]:
    """What a fake camera draws for a frame of this number, modulo 255."""
    steps = np.arange(size)
    return ((steps[:, None] + steps[None, :] + number) % 255).astype(np.uint8)


def proves(image: NDArray[np.generic], number: int) -> bool:
    """Whether every pixel is that of the frame of this number."""
    return bool(np.array_equal(image, drawn(number % 255, image.shape[0])))


@dataclass
class Evidence:
    """What was seen of one device.

    Attributes:
        events: in order of arrival.
        proven: numbers of complete frames whose every pixel fits the number.
        wrong: numbers of complete frames with a pixel that does not.
    """

    events: list[FrameEvent] = field(default_factory=list)
    proven: list[int] = field(default_factory=list)
    wrong: list[int] = field(default_factory=list)


class _Watched(AravisDevice):
    """The device as it is, but for the look at each frame."""

    seen: Evidence

    def poll(self) -> Sequence[FrameEvent]:
        events = super().poll()
        for event in events:
            self.seen.events.append(event)
            if event.complete:
                fits = proves(self.pixels(event), event.frame_id)
                (self.seen.proven if fits else self.seen.wrong).append(event.frame_id)
        return events


def open_watched(address: str, name: str) -> tuple[AravisDevice, Evidence]:
    """Open a device, and what will be seen of it."""
    device = backend.open(address, name)
    seen = Evidence()
    device.__class__ = type("Watched", (_Watched, type(device)), {"seen": seen})
    return device, seen


def check_take(take: Take, seen: Mapping[str, Evidence]) -> dict[Verdict, int]:
    """Compare a ledger, frame by frame, with the pixels on disk and with what came.

    Returns:
        How often each verdict was given.
    """
    ledger = take.ledger()
    for name, evidence in seen.items():
        came = {event.frame_id: event for event in evidence.events}
        entries = [ledger.entry(k, name) for k in range(ledger.triggers)]
        placed = [e for e in entries if e.verdict in (Verdict.OK, Verdict.INCOMPLETE)]
        for entry in placed:
            event = came[entry.frame_id]
            assert (entry.t_dev_ns, entry.t_host_ns) == (event.t_dev_ns, event.t_host_ns)
            assert event.complete == (entry.verdict == Verdict.OK)
            assert take.present(name, entry.trigger_index) == event.complete
            if event.complete:
                assert entry.frame_id in evidence.proven
                assert proves(take.image(name, entry.trigger_index), entry.frame_id)
        # Between two frames of the ledger there is every number that lies between theirs: as one
        # that did not come and is called lost, or as one that came and was quarantined.
        odd = [remark for remark in ledger.remarks if remark.device == name]
        resets = {remark.frame_id for remark in odd if remark.oddity == Oddity.ID_RESET}
        for first, second in itertools.pairwise(placed):
            step = (second.frame_id - first.frame_id) % IDS
            between = {(first.frame_id - 1 + n) % IDS + 1 for n in range(1, step)}
            verdicts = [e.verdict for e in entries[first.trigger_index + 1 : second.trigger_index]]
            assert set(verdicts) <= {Verdict.LOST, Verdict.MISSED_TRIGGER, Verdict.QUARANTINED}
            quarantined = between & came.keys()
            assert quarantined <= {remark.frame_id for remark in odd}, (name, first, second)
            if not quarantined and second.frame_id not in resets:
                assert verdicts.count(Verdict.LOST) == len(between), (name, first, second)
    return ledger.counts()
