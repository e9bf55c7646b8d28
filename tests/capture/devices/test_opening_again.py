"""Devices that are opened and closed all day: no file or thread stays behind."""

from __future__ import annotations

import gc
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from capture.devices.protocol import TriggerKind
from tests.capture.devices.bench import PLAYED_HZ, Bench, recorded_take
from tests.capture.v4l2_driver import PlayedDriver, started

TIMES = 20


def left() -> tuple[int, int]:
    """Files and threads of this process."""
    gc.collect()
    return len(list(Path("/proc/self/fd").iterdir())), threading.active_count()


def open_and_close(once: Callable[[], None]) -> None:
    """Do it often; from the second time on nothing more stays behind."""
    for _ in range(2):
        once()
    files, threads = left()
    for _ in range(TIMES):
        once()
    after = left()
    assert after[0] <= files
    assert after[1] <= threads


@pytest.mark.parametrize("backend", ["sim", "replay"])
def test_a_played_device_leaves_nothing(backend: str, tmp_path: Path) -> None:
    address = "64x48?latency_ms=1" if backend == "sim" else ""
    if backend == "replay":
        address = f"{recorded_take(tmp_path / 'session', frames=10)}#cam01?loop=1"

    def once() -> None:
        with Bench(backend, address, PLAYED_HZ, TriggerKind.FREE_RUN) as bench:
            bench.ready(frames=8)
            bench.release(bench.collect(1))

    open_and_close(once)


def test_a_device_of_the_kernels_leaves_nothing() -> None:
    def once() -> None:
        device = started(PlayedDriver())
        device.health()
        device.close()

    open_and_close(once)
