"""Compiled kernels over independent items, shared out to threads in fixed ranges.

Kernels are compiled with `nogil` and write to disjoint parts of their outputs, so the result does
not depend on the threads. Compiling such a kernel takes a fraction of what numba's own parallel
loops take, which matters to a first run.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import Any

_WORTH_THREADS = 256  # items; fewer are done at once by the caller


def run_ranges(kernel: Callable[..., None], count: int, *arguments: Any) -> None:
    """Call `kernel(begin, end, *arguments)` over 0..count, in parallel where that pays.

    Args:
        kernel: compiled with nogil; writes only what belongs to its range.
        count: items.
        arguments: passed on.
    """
    workers = min(_cores(), 16)
    if workers < 2 or count < _WORTH_THREADS:
        kernel(0, count, *arguments)
        return
    edges = [count * part // workers for part in range(workers + 1)]
    jobs = [_pool(workers).submit(kernel, begin, end, *arguments) for begin, end in pairwise(edges)]
    for job in jobs:
        job.result()


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def _pool(workers: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(workers, thread_name_prefix="rig")
