"""Meshes made beside the matching: each in a process of its own.

The Poisson solver keeps the interpreter to itself while it runs, so that a thread would stop the
matching of the next frame. The processes are plain children that read points from their standard
input and write meshes to their standard output: what starts them need not be importable, as
multiprocessing would ask, and nothing is unpickled.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, fields
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Lock
from types import TracebackType
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from capture.errors import SolveError, WorkError
from recon.fusion import Points
from recon.surface import Scan, SurfaceSettings, poisson_scan

_SERVE = "from recon.mesh_process import serve; serve()"


class Meshed(NamedTuple):
    """A mesh and the seconds of wall clock it took."""

    scan: Scan
    seconds: float


class Mesher:
    """Makes meshes of points, some at once; leaving it stops what is still running.

    Args:
        settings: of the surface.
        processes: meshes made beside the caller; with 0 the caller makes them himself.
    """

    def __init__(self, settings: SurfaceSettings, processes: int) -> None:
        self._settings = settings
        self._threads = ThreadPoolExecutor(processes) if processes else None
        self._children: list[_Child] = []
        self._left = False
        self._door = Lock()  # no process is started once it is left
        self._idle: SimpleQueue[_Child] = SimpleQueue()

    def __enter__(self) -> Mesher:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        if self._threads is None:
            return
        self._threads.shutdown(wait=False, cancel_futures=True)
        with self._door:
            self._left = True
            for child in self._children:
                child.stop()
        self._threads.shutdown(wait=True)

    def submit(self, points: Points) -> Future[Meshed]:
        """Have points meshed; the future raises SolveError when there is no surface."""
        if self._threads is not None:
            return self._threads.submit(self._asked, points)
        done: Future[Meshed] = Future()
        start = time.perf_counter()
        try:
            scan = poisson_scan(points, self._settings)
            done.set_result(Meshed(scan, time.perf_counter() - start))
        except SolveError as error:
            done.set_exception(error)
        return done

    def _asked(self, points: Points) -> Meshed:
        start = time.perf_counter()
        try:
            child = self._idle.get_nowait()
        except Empty:
            child = self._started()
        scan = child.mesh(points)
        self._idle.put(child)
        return Meshed(scan, time.perf_counter() - start)

    def _started(self) -> _Child:
        with self._door:
            if self._left:
                raise SolveError("interrupted before the mesh was made")
            self._children.append(_Child(self._settings))
            return self._children[-1]


def serve() -> None:
    """Answer requests on standard input until it ends: what a child process runs."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever a library prints must not stand between the answers
    requests = sys.stdin.buffer
    settings = SurfaceSettings(**json.loads(requests.readline()))
    while line := requests.readline():
        notes, arrays = _received(line, requests)
        held: dict[str, Any] = dict(zip(notes["names"], arrays, strict=True))
        held |= {key: tuple(v) if isinstance(v, list) else v for key, v in notes["plain"].items()}
        points = Points(**held)
        try:
            scan = poisson_scan(points, settings)
        except SolveError as error:
            _send(answers, {"error": str(error)}, [])
        else:
            _send(answers, {}, [scan.vertices, scan.triangles, scan.normals, scan.confidence])


class _Child:
    """One process, asked again and again."""

    def __init__(self, settings: SurfaceSettings) -> None:
        house = str(Path(__file__).resolve().parents[1])
        paths = [house, *filter(None, [os.environ.get("PYTHONPATH")])]
        self._process = subprocess.Popen(
            [sys.executable, "-c", _SERVE],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
            start_new_session=True,  # Ctrl-C is answered by the parent alone
        )
        if self._process.stdin is None or self._process.stdout is None:
            raise WorkError("the process that makes meshes has no pipes")
        self._requests, self._answers = self._process.stdin, self._process.stdout
        self._requests.write(json.dumps(asdict(settings)).encode() + b"\n")

    def mesh(self, points: Points) -> Scan:
        """Ask for a mesh and wait for it."""
        held = {field.name: getattr(points, field.name) for field in fields(points)}
        arrays = {name: value for name, value in held.items() if isinstance(value, np.ndarray)}
        plain = {name: value for name, value in held.items() if name not in arrays}
        try:
            _send(self._requests, {"names": list(arrays), "plain": plain}, list(arrays.values()))
            line = self._answers.readline()
            answer, found = _received(line, self._answers) if line else ({}, [])
        except (BrokenPipeError, ValueError):
            found, answer = [], {}
        if "error" in answer:
            raise SolveError(answer["error"])
        if len(found) != 4:
            raise SolveError(
                "the process that makes the mesh ended before it was done (status "
                f"{self._process.poll()}); it may have had too little memory: "
                "set frames_at_once = 1"
            )
        vertices, triangles, normals, confidence = found
        return Scan(vertices, triangles, normals, confidence)

    def stop(self) -> None:
        """End it, whatever it is doing."""
        self._process.kill()
        self._process.wait()
        for pipe in (self._requests, self._answers):
            try:
                pipe.close()
            except BrokenPipeError:
                continue  # what was not sent is not wanted any more


def _send(stream: IO[bytes], notes: dict[str, Any], arrays: list[NDArray[Any]]) -> None:
    kinds = [[array.dtype.str, list(array.shape)] for array in arrays]
    stream.write(json.dumps({"notes": notes, "arrays": kinds}).encode() + b"\n")
    for array in arrays:
        stream.write(np.ascontiguousarray(array).tobytes())
    stream.flush()


def _received(line: bytes, stream: IO[bytes]) -> tuple[dict[str, Any], list[NDArray[Any]]]:
    head = json.loads(line)
    arrays = []
    for kind, shape in head["arrays"]:
        size = int(np.prod(shape)) * np.dtype(kind).itemsize
        arrays.append(np.frombuffer(stream.read(size), kind).reshape(shape))
    return head["notes"], arrays
