"""What a test may ask of a running device: faults, edges, clock, reboot, and what it really did."""

from __future__ import annotations

import dataclasses
import socket
import time
from collections.abc import Callable, Mapping

from tests.gige.camera.clock import PTP_STATES
from tests.gige.camera.commands import Peer
from tests.gige.camera.faults import Defect, Resend
from tests.gige.camera.setup import Setup
from tests.gige.camera.trigger import Deed
from tests.gige.camera.unit import Unit
from tests.gige.camera.wire import CHUNKS, IMAGE_AND_CHUNKS

Request = Mapping[str, object]


class Desk:
    """Holds the device, through its reboots, and answers requests."""

    def __init__(self, setup: Setup, out: socket.socket) -> None:
        self._setup, self._out = setup, out
        self.unit = Unit(setup, out)
        self._past: list[Deed] = []  # of earlier lives
        self._off_until_ns = 0
        self._answers: dict[str, Callable[..., object]] = {
            "set": self._set,
            "plan": self._plan,
            "train": self._train,
            "edge": self._edge,
            "step_clock": self._step_clock,
            "reboot": self._reboot,
            "renew": self._renew,
            "deeds": self._deeds,
            "state": self._state,
        }

    def tick(self, now_ns: int) -> None:
        """Do what is due."""
        if self._off_until_ns and now_ns >= self._off_until_ns:
            self._off_until_ns = 0
            self.unit = Unit(self._setup, self._out)
        if not self._off_until_ns:
            self.unit.agenda.run(now_ns)
            self.unit.commands.watch(now_ns)
            if self.unit.reset_asked:
                self._reboot(0.3)

    def packet(self, packet: bytes, peer: Peer) -> bytes | None:
        """The answer to a packet from the network."""
        if self._off_until_ns:
            return None
        return self.unit.commands.answer(packet, peer, time.monotonic_ns())

    def request(self, request: Request) -> dict[str, object]:
        """The answer to a request of the test."""
        rest = dict(request)
        name = str(rest.pop("do"))
        rest.pop("quiet", None)
        try:
            return {"ok": self._answers[name](**rest)}
        except (KeyError, TypeError, ValueError) as error:
            return {"error": f"{name}: {type(error).__name__}: {error}"}

    def _set(self, **values: object) -> None:
        unit, now_ns = self.unit, time.monotonic_ns()
        for name, value in values.items():
            if name in ("dead", "busy", "mute_actions"):
                setattr(unit.faults, name, value)
            elif name == "resend":
                unit.faults.resend = Resend(str(value))
            elif name == "chunk_type":
                unit.stream.chunk_type = {"old": CHUNKS, "new": IMAGE_AND_CHUNKS}[str(value)]
            elif name == "path_mtu":
                unit.stream.path_mtu = int(str(value))
            elif name in ("first_id", "next_id", "readout_us"):
                setattr(unit.trigger, name, value)
            elif name == "temperature_c":
                unit.settings.put("DeviceTemperature", float(str(value)))
            elif name == "ptp_state":
                unit.clock.force(None if value is None else PTP_STATES[str(value)], now_ns)
            elif name in ("offset_ns", "grandmaster"):
                setattr(unit.clock, name, value)
            elif name == "drift_ppm":
                unit.clock.set_drift(float(str(value)), now_ns)
            else:
                raise KeyError(name)

    def _plan(
        self, defect: str, after: int = 0, count: int = 1, packets: tuple[int, ...] = ()
    ) -> int:
        trigger, kind = self.unit.trigger, Defect(defect)
        first = after + (trigger.triggers if kind is Defect.IGNORE else trigger.frames)
        self.unit.faults.plan(kind, first, count, packets)
        return first

    def _train(self, source: str, first_ns: int, period_ns: int, count: int) -> None:
        self.unit.trigger.train(source, first_ns, period_ns, count)

    def _edge(self, source: str) -> bool:
        return self.unit.trigger.edge(source, time.monotonic_ns())

    def _step_clock(self, by_ns: int) -> None:
        self.unit.clock.step(by_ns, time.monotonic_ns())

    def _reboot(self, off_s: float) -> None:
        self._past += self.unit.trigger.deeds
        self._off_until_ns = time.monotonic_ns() + round(off_s * 1e9)
        self.unit.trigger.deeds = []
        self.unit.trigger.stop()
        self.unit.agenda.clear()
        self.unit.reset_asked = False

    def _renew(self, setup: str) -> None:
        self._setup, self._past, self._off_until_ns = Setup.from_json(setup), [], 0
        self.unit = Unit(self._setup, self._out)

    def _deeds(self) -> list[list[object]]:
        deeds = self._past + self.unit.trigger.deeds
        return [list(dataclasses.astuple(deed)) for deed in deeds]

    def _state(self) -> dict[str, object]:
        unit, now_ns = self.unit, time.monotonic_ns()
        return {
            "acquiring": unit.trigger.acquiring,
            "controlled": unit.commands.holder is not None,
            "triggers": unit.trigger.triggers,
            "frames": unit.trigger.frames,
            "asked": unit.stream.asked,
            "resent": unit.stream.resent,
            "waiting_actions": unit.waiting_actions,
            "extended": unit.stream.extended,
            "clock_ns": unit.clock.read(now_ns),
            "now_ns": now_ns,
            "ptp": unit.clock.state(now_ns),
            "off": bool(self._off_until_ns),
        }
