"""A worker thread for the control calls of one device, and a deadline for each.

A call to a device that is gone blocks for seconds; on a thread of its own it holds up nobody else.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from types import TracebackType
from typing import Any, TypeVar

from capture.errors import DeviceError

Result = TypeVar("Result")


class Watchdog:
    """Runs the calls of one device one after the other; any thread may ask.

    A call that outlives its deadline goes on in the worker, its answer is thrown away, and until it
    returns every further call fails at once.
    """

    def __init__(self, name: str) -> None:
        """Begin to wait for calls.

        Args:
            name: of the device, for messages.
        """
        self.name = name
        self._jobs: deque[_Job] = deque()
        self._change = threading.Condition()
        self._overdue: _Job | None = None
        self._closed = False
        # A daemon: a driver that never returns must not keep the program from ending.
        self._worker = threading.Thread(target=self._run, name=f"control {name}", daemon=True)
        self._worker.start()

    @property
    def stuck(self) -> bool:
        """Whether a call has outlived its deadline and has not returned."""
        return self._overdue is not None

    def call(self, work: Callable[[], Result], timeout_s: float) -> Result:
        """Do `work` in the worker and give its result; what it raises is raised here.

        Args:
            work: one call, or a few that belong together.
            timeout_s: how long it may take, waiting for earlier calls included.

        Raises:
            DeviceError: when the device does not answer in time, or an earlier call still hangs.
        """
        if threading.current_thread() is self._worker:
            return work()
        job = _Job(work)
        self._add(job)
        job.done.wait(timeout_s)
        with self._change:
            if not job.done.is_set():
                if job in self._jobs:
                    self._jobs.remove(job)
                    raise DeviceError(
                        f"{self.name}: was busy with other calls for {timeout_s:.1f} s"
                    )
                self._overdue = job
                raise DeviceError(f"{self.name}: did not answer for {timeout_s:.1f} s")
        if job.error is not None:
            try:
                raise job.error
            finally:
                job.error = None  # or it would hold itself, and with it what the work held
        return job.result  # type: ignore[no-any-return]

    def post(self, work: Callable[[], object]) -> threading.Event:
        """Do `work` in the worker after all calls so far, without waiting, even while one hangs.

        Returns:
            Set when it is done. What it raises is dropped: it is for taking leave of a device.
        """
        job = _Job(work)
        self._add(job, patient=True)
        return job.done

    def close(self) -> None:
        """End the worker after the calls so far; without waiting. May be called again."""
        with self._change:
            self._closed = True
            self._change.notify_all()

    def _add(self, job: _Job, *, patient: bool = False) -> None:
        with self._change:
            if self._closed:
                raise DeviceError(f"{self.name}: is closed")
            if self._overdue is not None and not patient:
                since = time.monotonic() - self._overdue.began_s
                raise DeviceError(f"{self.name}: has not answered for {since:.1f} s")
            self._jobs.append(job)
            self._change.notify_all()

    def _run(self) -> None:
        while True:
            with self._change:
                while not self._jobs and not self._closed:
                    self._change.wait()
                if not self._jobs:
                    return
                job = self._jobs.popleft()
                job.began_s = time.monotonic()
            job.run()
            with self._change:
                job.done.set()
                if self._overdue is job:
                    self._overdue = None
            del job  # the last hold on what the work held, which may be a device


class _Job:
    """One call, and what became of it. As a context it keeps an error for the thread that asked."""

    def __init__(self, work: Callable[[], Any]) -> None:
        self._work: Callable[[], Any] | None = work
        self.began_s = time.monotonic()
        self.done = threading.Event()
        self.result: Any = None
        self.error: BaseException | None = None

    def run(self) -> None:
        """Do the work."""
        work, self._work = self._work, None
        with self:
            self.result = work() if work is not None else None

    def __enter__(self) -> None:
        return None

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> bool:
        self.error = error
        return True
