"""Threads that carry frames to disk, in lanes: the frames of one device stay in their order.

A lane is two threads: one computes the CRC of the pixels, one writes. Both spend their time in code
that lets other threads run. What waits in a lane is held in its device's memory, so that a slow
disk shows as memory in use, and, when that is full, as frames lost by the device: never as a frame
that nobody knows of.
"""

from __future__ import annotations

import logging
import os
import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType

from capture.arrays import Image
from capture.errors import LikenessError
from capture.frame_header import pixel_crc
from capture.window import HeldFrame

Write = Callable[[HeldFrame, Image, int], None]
Failed = Callable[[HeldFrame, str], None]

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class LaneJob:
    """One frame on its way to disk.

    Attributes:
        frame: is given back afterwards, whatever happens.
        write: given the frame, its pixels and their CRC.
        failed: told why, when the frame could not be fetched or written.
    """

    frame: HeldFrame
    write: Write
    failed: Failed

    def fail(self, why: str) -> None:
        """Tell that the frame could not be fetched or written."""
        self.failed(self.frame, why)


class WriteLanes:
    """Some lanes; every device keeps to one of them."""

    def __init__(self, lanes: int | None = None) -> None:
        """Start the threads.

        Args:
            lanes: how many; None: one for every two cores, at most 4.
        """
        count = lanes if lanes is not None else max(1, min(4, (os.cpu_count() or 2) // 2))
        self._lanes = [_Lane() for _ in range(count)]

    def put(self, place: int, job: LaneJob) -> None:
        """Send a frame on its way.

        Args:
            place: of its device in the array.
            job: what is to be done.
        """
        self._lanes[place % len(self._lanes)].put(job)

    def close(self) -> None:
        """Finish all that waits, and end the threads."""
        for lane in self._lanes:
            lane.close()


class _Lane:
    def __init__(self) -> None:
        self._fresh: queue.SimpleQueue[LaneJob | None] = queue.SimpleQueue()
        self._ready: queue.SimpleQueue[tuple[LaneJob, Image, int] | None] = queue.SimpleQueue()
        self._threads = [
            threading.Thread(target=work, name=name, daemon=True)
            for work, name in ((self._check, "likeness-crc"), (self._write, "likeness-write"))
        ]
        for thread in self._threads:
            thread.start()

    def put(self, job: LaneJob) -> None:
        self._fresh.put(job)

    def close(self) -> None:
        self._fresh.put(None)
        for thread in self._threads:
            thread.join()

    def _check(self) -> None:
        while (job := self._fresh.get()) is not None:
            with _Attempt(job.fail):
                pixels = job.frame.device.frames.pixels(job.frame.event)
                self._ready.put((job, pixels, pixel_crc(pixels)))
                continue
            self._give_back(job)
        self._ready.put(None)

    def _write(self) -> None:
        while (ready := self._ready.get()) is not None:
            job, pixels, crc = ready
            del ready
            with _Attempt(job.fail):
                job.write(job.frame, pixels, crc)
            self._give_back(job)

    def _give_back(self, job: LaneJob) -> None:
        name = job.frame.event.device
        with _Attempt(lambda why: _log.warning("%s: memory is not given back: %s", name, why)):
            job.frame.done()


class _Attempt:
    """What goes wrong with a frame ends that frame, and not the lane: others wait for it."""

    def __init__(self, told: Callable[[str], None]) -> None:
        self._told = told

    def __enter__(self) -> None:
        return None

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> bool:
        if error is not None:
            # A third party's device may raise anything: its kind is told as well.
            self._told(str(error) if isinstance(error, LikenessError) else repr(error))
        return isinstance(error, Exception)
