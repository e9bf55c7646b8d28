"""The one OpenGL context of a process: headless through EGL, on a GPU or on the CPU."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import moderngl

from capture.errors import WorkError

_OPTIONS: dict[str, Any] = {
    "standalone": True,
    "backend": "egl",
    "libgl": "libGL.so.1",
    "libegl": "libEGL.so.1",
}
_contexts: dict[int, Any] = {}  # by process id: a context does not survive a fork
_locks: dict[int, threading.Lock] = {}  # nor does a lock that another thread held


def gl_context() -> Any:
    """The process's standalone OpenGL context, made on first use and then kept.

    Two contexts in one thread clash (moderngl issue 652), so whatever draws asks here. Work that
    may be asked for by several threads takes `current_context` instead.

    Raises:
        WorkError: naming the system packages to install when EGL or OpenGL is missing.
    """
    process = os.getpid()
    if process not in _contexts:
        try:
            context = moderngl.create_context(**_OPTIONS)
        except Exception as error:  # glcontext raises bare Exception
            raise WorkError(
                f"no headless OpenGL through EGL ({error}); install it with: "
                "apt-get install libegl1 libgl1 libgl1-mesa-dri"
            ) from error
        context.gc_mode = "context_gc"  # objects die in `context.gc()`, never in another thread
        _contexts[process] = context
    return _contexts[process]


@contextmanager
def current_context() -> Iterator[Any]:
    """Hold the process's context, current in this thread and in no other, while within.

    Threads take turns; what they dropped since is freed first. It does not nest.

    Raises:
        WorkError: as `gl_context`.
    """
    with _locks.setdefault(os.getpid(), threading.Lock()), gl_context() as context:
        context.gc()
        yield context
