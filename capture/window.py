"""Frames that are in use by several, and windows: some triggers of a stream in a row."""

from __future__ import annotations

import threading
from collections.abc import Callable

from capture.devices.protocol import Device
from capture.frame import FrameEvent
from capture.frame_header import FrameHeader
from capture.recorder import Recording


class HeldFrame:
    """A frame whose memory is in use; given back to its device when the last user is done."""

    def __init__(self, device: Device, event: FrameEvent, trigger_index: int) -> None:
        """Hold a frame for one user."""
        self.device, self.event, self.trigger_index = device, event, trigger_index
        self._users = 1
        self._lock = threading.Lock()

    def share(self) -> HeldFrame:
        """The same frame for one more user."""
        with self._lock:
            self._users += 1
        return self

    def done(self) -> None:
        """One user needs it no more."""
        with self._lock:
            self._users -= 1
            last = self._users == 0
        if last:
            self.device.frames.release(self.event)

    def header(self, first: int) -> FrameHeader:
        """What is written with it in a take that begins at trigger `first`."""
        return FrameHeader(
            trigger_index=self.trigger_index - first,
            frame_id=self.event.frame_id,
            t_dev_ns=self.event.t_dev_ns,
            t_host_ns=self.event.t_host_ns,
            exposure_us=self.event.exposure_us,
            status=0 if self.event.complete else 1,
        )


Deliver = Callable[[HeldFrame], None]


class Window:
    """Some triggers of a stream in a row, and who wants their frames.

    Attributes:
        first: the first trigger, counted in the stream.
        count: how many; `Stream.shorten` may make it fewer.
        closed: set when it is over.
        sent_ns: when its last trigger was first seen to be sent; None: not yet.
    """

    def __init__(self, first: int, count: int, deliver: Deliver) -> None:
        """Describe a window; `Stream.open` opens it."""
        self.first, self.count, self.deliver = first, count, deliver
        self.closed = threading.Event()
        self.sent_ns: int | None = None
        self._lock = threading.Lock()
        self._make: Callable[[], Recording] | None = None
        self._recording: Recording | None = None

    @property
    def last(self) -> int:
        """Its last trigger."""
        return self.first + self.count - 1

    @property
    def recording(self) -> Recording | None:
        """What it was; None until it is closed, or when no trigger was ever made out.

        Made when it is first asked for, by whoever asks: a minute of sixteen devices makes seventy
        thousand verdicts, and frames do not wait for that.
        """
        with self._lock:
            if self._make is not None:
                self._recording, self._make = self._make(), None
            return self._recording

    def close(self, make: Callable[[], Recording] | None) -> None:
        """Say that it is over; `make` makes the recording."""
        with self._lock:
            self._make = make
        self.closed.set()
