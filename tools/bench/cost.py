"""What a piece of work costs: wall clock, processor, and the memory it adds to its process."""

from __future__ import annotations

import ctypes
import gc
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

_Value = TypeVar("_Value")


def measured(work: Callable[[], _Value]) -> tuple[_Value, dict[str, float]]:
    """Do the work once; say what it took.

    Returns:
        What it gave, and `wall_s`, `cpu_s` (all threads), `peak_mib` of the process meanwhile and
        `own_mib`, the part of that peak that was not held before. Memory is Linux's count.
    """
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)  # what was freed goes back: nobody works in it unseen
    before = _memory_mib("VmRSS")
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # the peak starts here
    wall, processor = time.perf_counter(), time.process_time()
    value = work()
    cost: dict[str, float] = {
        "wall_s": round(time.perf_counter() - wall, 2),
        "cpu_s": round(time.process_time() - processor, 2),
        "peak_mib": _memory_mib("VmHWM"),
        "own_mib": _memory_mib("VmHWM") - before,
    }
    return value, cost


def _memory_mib(key: str) -> int:
    """Of this process, from Linux: getrusage would count what the parent held when it forked."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(key)) // 1024
