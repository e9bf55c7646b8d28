"""Fake cameras of Aravis, each in a network namespace of its own: all of them want the same port.

Everything carries our prefix, and what a killed run left behind is removed by the next one.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import TracebackType

_PREFIX = "lkg"
_BRIDGE = f"{_PREFIX}br"
_NETWORK = "10.88.37"
_MTU = 9000
_CHILD = Path(__file__).with_name("fake_child.py")
_WAIT_S = 120.0  # for another run on this machine


class NoNetworkError(Exception):
    """Why fake cameras cannot be had here."""


def reason_against() -> str:
    """Why fake cameras cannot be had here; empty when they can."""
    if os.geteuid() != 0:
        return "network namespaces need root"
    if shutil.which("ip") is None:
        return "there is no `ip`; run tools/setup_gige.sh"
    try:
        _ip("netns", "list")
    except NoNetworkError as error:
        return f"no network namespaces here: {error}"
    done = subprocess.run(
        [sys.executable, "-c", "import gi; gi.require_version('Aravis', '0.8')"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode:
        return f"no Aravis here; run tools/setup_gige.sh: {done.stderr.strip().splitlines()[-1]}"
    return ""


class Fake:
    """One fake camera.

    Attributes:
        serial: its serial number.
        address: its IP address.
    """

    def __init__(self, number: int) -> None:
        self.serial = f"LK{number:02d}"
        self.address = f"{_NETWORK}.{10 + number}"
        self._space = f"{_PREFIX}{number:02d}"
        self._inner = f"{_PREFIX}c{number:02d}"
        self._outer = f"{_PREFIX}h{number:02d}"
        self._child: subprocess.Popen[str] | None = None

    def connect(self) -> None:
        """Make its namespace, and a cable from there to the bridge."""
        _ip("netns", "add", self._space)
        _ip("link", "add", self._outer, "mtu", str(_MTU), "type", "veth",
            "peer", "name", self._inner, "mtu", str(_MTU), "netns", self._space)  # fmt: skip
        _ip("link", "set", self._outer, "master", _BRIDGE, "up")
        _ip("-n", self._space, "addr", "add", f"{self.address}/24", "broadcast",
            f"{_NETWORK}.255", "dev", self._inner)  # fmt: skip
        _ip("-n", self._space, "link", "set", self._inner, "up")
        _ip("-n", self._space, "link", "set", "lo", "up")

    def start(self) -> None:
        """Switch it on; `await_running` waits until it answers."""
        self._child = subprocess.Popen(
            ["ip", "netns", "exec", self._space, sys.executable, str(_CHILD), self._inner,
             self.serial],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip

    def await_running(self) -> None:
        """Wait until it answers."""
        found = self._child.stdout.readline().strip() if self._child and self._child.stdout else ""
        if found != "running":
            raise NoNetworkError(f"the fake camera {self.serial} does not run: {found!r}")

    def ask(self, order: str) -> None:
        """Give an order, such as ``loss 0.01``, and wait until it is done."""
        if self._child is None or self._child.stdin is None or self._child.stdout is None:
            raise NoNetworkError(f"the fake camera {self.serial} is switched off")
        self._child.stdin.write(order + "\n")
        self._child.stdin.flush()
        if self._child.stdout.readline().strip() != "done":
            raise NoNetworkError(f"the fake camera {self.serial} did not do {order!r}")

    def kill(self) -> None:
        """Pull its plug (SIGKILL): it says nothing to anybody."""
        if self._child is not None:
            self._child.kill()  # `ip netns exec` becomes the child, it does not fork
            self._child.wait()
            for pipe in (self._child.stdin, self._child.stdout):
                if pipe is not None:
                    pipe.close()
            self._child = None


class FakeNetwork:
    """Some fake cameras on one bridge. Used in a `with` block.

    Attributes:
        fakes: in the order of their serial numbers.
    """

    def __init__(self, count: int) -> None:
        self.fakes = [Fake(number) for number in range(1, count + 1)]
        path = Path(tempfile.gettempdir(), "likeness-gige.lock")
        self._lock = os.open(path, os.O_CREAT | os.O_RDWR, 0o600)

    def __enter__(self) -> FakeNetwork:
        self._await_turn()
        try:
            _remove_all()
            _ip("link", "add", _BRIDGE, "type", "bridge")
            _ip("addr", "add", f"{_NETWORK}.1/24", "broadcast", f"{_NETWORK}.255", "dev", _BRIDGE)
            _ip("link", "set", _BRIDGE, "mtu", str(_MTU), "up")
            for fake in self.fakes:
                fake.connect()
                fake.start()
            for fake in self.fakes:
                fake.await_running()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Switch everything off and remove it."""
        for fake in self.fakes:
            fake.kill()
        _remove_all()
        os.close(self._lock)

    def _await_turn(self) -> None:
        deadline = time.monotonic() + _WAIT_S
        while True:
            try:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
            except BlockingIOError as error:
                if time.monotonic() > deadline:
                    raise NoNetworkError("another run holds the fake cameras") from error
                time.sleep(0.5)


def _remove_all() -> None:
    """Remove all that carries our prefix, also what a killed run left behind."""
    spaces = [line.split()[0] for line in _ip("netns", "list").splitlines()]
    spaces = [name for name in spaces if name[:3] == _PREFIX and name[3:].isdigit()]
    for space in spaces:
        for pid in _ip("netns", "pids", space).split():
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(pid), signal.SIGKILL)
    # Cables first: those of a namespace that is removed go only some time after it.
    for line in _ip("-br", "link").splitlines():
        name = line.split()[0].split("@")[0]
        if name == _BRIDGE or (name.startswith(f"{_PREFIX}h") and name[4:].isdigit()):
            with contextlib.suppress(NoNetworkError):
                _ip("link", "del", name)
    for space in spaces:
        _ip("netns", "del", space)


def _ip(*words: str) -> str:
    done = subprocess.run(["ip", *words], capture_output=True, text=True, check=False)
    if done.returncode:
        raise NoNetworkError(f"ip {' '.join(words)}: {done.stderr.strip()}")
    return done.stdout
