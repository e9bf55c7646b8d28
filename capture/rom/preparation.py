"""Starting, checking and stopping the array, in a thread beside the front end's."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

from capture.errors import LikenessError, WorkError
from capture.judgement import Colour
from capture.preflight.finding import Finding, ordered, worst
from capture.progress import Progress
from capture.rom.contract import StreamingArray


@dataclass(frozen=True)
class Prepared:
    """How starting and checking ended.

    Attributes:
        findings: the worst first.
        streaming: whether the devices deliver frames.
    """

    findings: tuple[Finding, ...]
    streaming: bool

    @property
    def colour(self) -> Colour:
        """The worst of the findings."""
        return worst(self.findings)

    @property
    def sentence(self) -> str:
        """The worst finding."""
        if self.colour == Colour.GREEN:
            return "All devices are ready."
        return self.findings[0].sentence


class Preparation:
    """One thread for what takes a while; its jobs are done one after the other."""

    def __init__(
        self, array: StreamingArray, preflight: Callable[[Progress], Sequence[Finding]]
    ) -> None:
        """Hold an array; nothing is started yet.

        Args:
            array: to start and stop.
            preflight: checks it while it streams; told to end early by what its progress raises.
        """
        self._array, self._preflight = array, preflight
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="likeness-preparation")
        self._check: Future[Prepared] | None = None
        self._stops: list[Future[None]] = []
        self._searches: list[tuple[str, Future[None]]] = []
        self._unwanted = threading.Event()  # the check that runs; each has its own
        self.streaming = False
        self.at = ""
        self.findings: tuple[Finding, ...] = ()

    def start(self) -> None:
        """Start the array, unless it streams already, and check it."""
        self.findings, self.at = (), ""
        self._unwanted = threading.Event()
        self._check = self._worker.submit(self._start_and_check, self._unwanted)

    def stop(self) -> None:
        """Stop the array; a check that is not finished is ended and forgotten."""
        self._check = None
        self._unwanted.set()
        self._stops.append(self._worker.submit(self._stop))

    def close(self) -> str:
        """Stop the array and wait for that; says why it did not stop well, or ""."""
        self.stop()
        self._worker.shutdown(wait=True)
        return " ".join(self.problems())

    def finished(self) -> Prepared | None:
        """How the check ended, told once; None while it runs."""
        if self._check is None or not self._check.done():
            return None
        prepared = self._check.result()
        self._check, self.findings = None, prepared.findings
        return prepared

    def problems(self) -> tuple[str, ...]:
        """Why the array did not stop well, told once."""
        done = [job for job in self._stops if job.done()]
        self._stops = [job for job in self._stops if job not in done]
        return tuple(str(error) for job in done if (error := _refused(job)) is not None)

    def reconnect(self, device: str) -> None:
        """Find a lost device again."""
        self._searches.append((device, self._worker.submit(self._array.reconnect, device)))

    def searched(self) -> tuple[tuple[str, str], ...]:
        """Devices that were looked for, and why one was not found or ""; told once."""
        done = [(device, job) for device, job in self._searches if job.done()]
        self._searches = [one for one in self._searches if one not in done]
        return tuple((device, str(_refused(job) or "")) for device, job in done)

    def _start_and_check(self, unwanted: threading.Event) -> Prepared:
        def heard(done: int, total: int, what: str) -> None:
            if unwanted.is_set():
                raise WorkError("the check was ended")
            self.at = f"{what.removeprefix('preflight: ')} ({done} of {total})"

        try:
            if self.streaming and self._array.trouble:
                self._stop()
            if not self.streaming:
                self._array.start()
                self.streaming = True
        except LikenessError as error:
            return Prepared((_refusal(error, "Put that right and arm again."),), streaming=False)
        try:
            found = ordered(self._preflight(heard))
        except LikenessError as error:
            return Prepared((_refusal(error, "Check again."),), streaming=True)
        return Prepared(found, streaming=True)

    def _stop(self) -> None:
        if self.streaming:
            self.streaming = False
            self._array.stop()


def _refusal(error: LikenessError, remedy: str) -> Finding:
    return Finding("start", "", Colour.RED, str(error), remedy)


def _refused(job: Future[None]) -> LikenessError | None:
    """What a job raised; what is no error of ours is raised again."""
    try:
        job.result()
    except LikenessError as error:
        return error
    return None
