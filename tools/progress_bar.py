"""Progress on stderr: a bar with rate and time left on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from typing import TextIO

from tqdm import tqdm

_QUIET_S = 5.0  # between plain lines of one piece of work


class ProgressBar:
    """A `capture.progress.Progress` that a person can watch.

    Args:
        stream: where to write; stderr unless told otherwise.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = stream if stream is not None else sys.stderr
        self._fancy = self._stream.isatty()
        self._bar: tqdm[None] | None = None
        self._what = ""
        self._started = time.monotonic()  # of the work that is shown
        self._heard = self._started
        self._spoken = 0.0

    def __call__(self, done: int, total: int, what: str) -> None:
        """Show that `done` of `total` steps of `what` are finished."""
        if what != self._what:
            self.close()
            self._what, self._started = what, self._heard  # it began when the last one ended
        self._heard = time.monotonic()
        if self._fancy:
            self._draw(done, total)
        else:
            self._say(done, total)

    def close(self) -> None:
        """Finish the line that is being drawn."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None
        self._what = ""

    def _draw(self, done: int, total: int) -> None:
        if self._bar is None:
            self._bar = tqdm(total=total, desc=self._what, file=self._stream, leave=True)
        self._bar.total = total
        self._bar.n = done
        self._bar.refresh()

    def _say(self, done: int, total: int) -> None:
        now = time.monotonic()
        if done < total and now - self._spoken < _QUIET_S:
            return
        self._spoken = now
        spent = now - self._started
        left = f", {spent / done * (total - done):.0f} s left" if 0 < done < total else ""
        print(f"{self._what}: {done}/{total} ({spent:.1f} s{left})", file=self._stream, flush=True)
