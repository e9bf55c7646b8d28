"""The test's end of a device: starts its process, asks things of it, ends it."""

from __future__ import annotations

import json
import os
import selectors
import socket
import subprocess
import sys
import threading
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any

from tests.gige.camera.setup import Setup
from tests.gige.camera.trigger import Deed
from tests.gige.camera.wire import GVCP_PORT

_ROOT = Path(__file__).resolve().parents[3]
_PATIENCE_S = 20.0


@dataclass(frozen=True)
class DeviceState:
    """What a device says of itself, as far as its registers do not.

    Attributes:
        acquiring: whether it answers triggers.
        controlled: whether an application holds it.
        triggers: since it was switched on, answered or not.
        frames: exposed since then.
        asked: packets it was asked for again.
        resent: of those, sent.
        waiting_actions: action commands that wait for their time.
        extended: whether frame numbers have 64 bits.
        clock_ns: what its clock showed.
        now_ns: true time of that.
        ptp: state of its clock.
        off: whether it is rebooting.
    """

    acquiring: bool
    controlled: bool
    triggers: int
    frames: int
    asked: int
    resent: int
    waiting_actions: int
    extended: bool
    clock_ns: int
    now_ns: int
    ptp: int
    off: bool


class RunningDevice:
    """A device in a process of its own; used in a `with` block."""

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.gige.camera", setup.to_json()],
            cwd=_ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        self._typed = b""
        self._lock = threading.Lock()
        self.stream_port = int(str(self._answer()))

    def __enter__(self) -> RunningDevice:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    @property
    def address(self) -> str:
        """Its IP address."""
        return self.setup.address

    def ask(self, do: str, **values: object) -> Any:
        """Send a request, see `requests`; the answer."""
        with self._lock:
            self._write({"do": do, **values})
            return self._answer()

    def tell(self, do: str, **values: object) -> None:
        """Send a request that has no answer."""
        with self._lock:
            self._write({"do": do, "quiet": True, **values})

    def set(self, **values: object) -> None:
        """Change how it behaves: dead, busy, resend, ptp_state, ..."""
        self.ask("set", **values)

    def plan(
        self, defect: str, after: int = 0, count: int = 1, packets: tuple[int, ...] = ()
    ) -> int:
        """Plan a defect `after` so many more triggers or frames; the number of the first."""
        return int(self.ask("plan", defect=defect, after=after, count=count, packets=packets))

    def renew(self, **changes: Any) -> None:
        """Switch it off and on, as another device at the same address."""
        self.setup = replace(Setup(address=self.address), **changes)
        self.ask("renew", setup=self.setup.to_json())

    def deeds(self) -> list[Deed]:
        """What became of every trigger: the truth that a ledger is held against."""
        return [Deed(*values) for values in self.ask("deeds")]

    def state(self) -> DeviceState:
        """What it says of itself."""
        return DeviceState(**self.ask("state"))

    def kill(self) -> None:
        """End its process as a power cut would."""
        self._process.kill()
        self.close()

    def close(self) -> None:
        """End it; a closed device may be closed again."""
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(5)

    def _write(self, request: Mapping[str, object]) -> None:
        out = self._process.stdin
        assert out is not None
        out.write(json.dumps(request).encode() + b"\n")
        out.flush()

    def _answer(self) -> object:
        out = self._process.stdout
        assert out is not None
        with selectors.DefaultSelector() as wait:
            wait.register(out, selectors.EVENT_READ)
            while b"\n" not in self._typed:
                if not wait.select(_PATIENCE_S):
                    raise TimeoutError(f"device {self.setup.serial} did not answer the test")
                more = os.read(out.fileno(), 1 << 20)
                if not more:
                    raise RuntimeError(f"device {self.setup.serial} ended: {self._process.poll()}")
                self._typed += more
        line, self._typed = self._typed.split(b"\n", 1)
        reply = json.loads(line)
        if "error" in reply:
            raise ValueError(reply["error"])
        return reply["ok"]


def free_addresses(count: int) -> tuple[str, ...]:
    """Loopback addresses at which no device is running."""
    found: list[str] = []
    start = 2 + os.getpid() % 200
    for number in range(2, 60_000):
        address = f"127.{start}.{number >> 8}.{number & 0xFF}"
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as trial:
            try:
                trial.bind((address, GVCP_PORT))
            except OSError:
                continue
        found.append(address)
        if len(found) == count:
            break
    return tuple(found)
