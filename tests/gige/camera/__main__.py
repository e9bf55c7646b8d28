"""The process of a device: ``python -m tests.gige.camera SETUP``, SETUP being `Setup` as JSON.

It reads requests from standard input, one JSON object a line, and answers each on standard output
with ``{"ok": ...}`` or ``{"error": "..."}``; one that is marked quiet has no answer while all is
well. It ends when its input does.
"""

from __future__ import annotations

import contextlib
import json
import os
import selectors
import socket
import sys
import time

from tests.gige.camera.requests import Desk
from tests.gige.camera.setup import Setup
from tests.gige.camera.wire import GVCP_PORT

_BROADCAST = "255.255.255.255"
_IDLE_S = 0.2


def _socket(address: str, port: int) -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, int(address == _BROADCAST))
    made.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4 << 20)
    made.bind((address, port))
    made.setblocking(False)
    return made


def _say(line: object) -> None:
    sys.stdout.write(json.dumps(line) + "\n")
    sys.stdout.flush()


def _read_all(port: socket.socket) -> list[tuple[bytes, tuple[str, int]]]:
    got = []
    while True:
        try:
            got.append(port.recvfrom(4096))
        except BlockingIOError:
            return got


def main() -> None:
    """Be a device until the input ends."""
    setup = Setup.from_json(sys.argv[1])
    with contextlib.suppress(PermissionError):
        os.nice(-15)  # a device of metal does not wait for the host's processor
    control, out = _socket(setup.address, GVCP_PORT), _socket(setup.address, 0)
    calls = _socket(_BROADCAST, GVCP_PORT)  # shared by all devices of this machine
    desk = Desk(setup, out)
    wait = selectors.DefaultSelector()
    for port in (control, calls):
        wait.register(port, selectors.EVENT_READ)
    wait.register(0, selectors.EVENT_READ)
    _say({"ok": out.getsockname()[1]})
    typed = b""
    while True:
        due = desk.unit.agenda.next_ns()
        pause = _IDLE_S if due is None else min(max(0, due - time.monotonic_ns()) / 1e9, _IDLE_S)
        ready = {key.fileobj for key, _ in wait.select(pause)}
        desk.tick(time.monotonic_ns())
        for port in (control, calls):
            for packet, peer in _read_all(port) if port in ready else ():
                # A call to all devices on another interface is not for one on this.
                if port is calls and not peer[0].startswith("127."):
                    continue
                reply = desk.packet(packet, peer)
                if reply is not None:
                    control.sendto(reply, peer)
        if 0 in ready:
            more = os.read(0, 65536)
            if not more:
                return
            *lines, typed = (typed + more).split(b"\n")
            for request in map(json.loads, lines):
                said = desk.request(request)
                if "error" in said or not request.get("quiet"):
                    _say(said)


if __name__ == "__main__":
    main()
