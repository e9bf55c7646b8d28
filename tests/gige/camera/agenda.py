"""What a device is to do later, by true time."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable


class Agenda:
    """Things to do, in order of time; `clear` forgets all of them."""

    def __init__(self) -> None:
        self._heap: list[tuple[int, int, Callable[[], None]]] = []
        self._count = itertools.count()

    def at(self, t_ns: int, act: Callable[[], None]) -> None:
        """Do something at a true time, or at once when that is past."""
        heapq.heappush(self._heap, (t_ns, next(self._count), act))

    def next_ns(self) -> int | None:
        """When the next thing is due."""
        return self._heap[0][0] if self._heap else None

    def run(self, now_ns: int) -> None:
        """Do what is due."""
        while self._heap and self._heap[0][0] <= now_ns:
            heapq.heappop(self._heap)[2]()

    def clear(self) -> None:
        """Forget everything."""
        self._heap.clear()
