"""How the devices of an array fare while it streams: a look at each, once a second.

A call to a device that is gone blocks for seconds. Each device is asked in a thread of its own, so
that one that hangs holds up neither the others nor the frames.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass

from capture.devices.capabilities import (
    Featured,
    FeatureDump,
    Health,
    Latching,
    Monitored,
    PtpReading,
    Reconnecting,
)
from capture.devices.protocol import ClockSample, Device
from capture.devices.watchdog import Watchdog
from capture.errors import DeviceError
from capture.judgement import Colour
from capture.stream import Stream

_AMBER_PERIODS = 4  # of silence
_AMBER_LEAST_S = 0.05
_RED_S = 0.5
_LOOK_EVERY_S = 1.0
_READINGS_A_LOOK = 4
_LOOKS = 3600  # that are remembered
_RECONNECT_S = 15.0


@dataclass(frozen=True)
class DeviceState:
    """How one device fares right now, for the operator.

    Attributes:
        name: of the device.
        colour: green; amber when silent for 4 periods or more than half of its memory is taken;
            red when silent for half a second.
        sentence: why, in plain words; empty when green.
        age_s: since its last frame; None before the first.
        received: frames since the array was started.
        not_ok: triggers since then without a good frame.
        taken: frames of its memory that are in use, of `reserved`; -1 unknown.
        reserved: frames of memory.
    """

    name: str
    colour: Colour
    sentence: str
    age_s: float | None
    received: int
    not_ok: int
    taken: int
    reserved: int


class DeviceWatch:
    """Looks at the devices of a stream, and says how they fare."""

    def __init__(self, stream: Stream) -> None:
        """Watch a stream; nothing is asked before `look`."""
        self._stream = stream
        self._dogs = {name: Watchdog(name) for name in stream.array.names}
        self._looks: dict[str, threading.Event] = {}
        self._health: dict[str, Health] = {}
        self._features: dict[str, FeatureDump] = {}
        self._ptp: deque[tuple[float, dict[str, PtpReading]]] = deque(maxlen=_LOOKS)
        self._due_s = 0.0

    def look(self) -> None:
        """Ask every device how it fares, when it is time; does not wait for the answers."""
        if time.monotonic() < self._due_s:
            return
        self._due_s = time.monotonic() + _LOOK_EVERY_S
        clocks = {name: said.ptp for name, said in self.health().items() if said.ptp is not None}
        self._ptp.append((time.monotonic(), clocks))
        for device in self._stream.array.devices:
            name = device.info.name
            if name not in self._looks or self._looks[name].is_set():
                self._looks[name] = self._dogs[name].post(self._question(device))

    def close(self) -> None:
        """Ask no more."""
        for dog in self._dogs.values():
            dog.close()

    def health(self) -> Mapping[str, Health]:
        """What each device said of itself last; some can say nothing."""
        return dict(self._health)

    def ptp_since(self, seconds: float) -> list[Mapping[str, PtpReading]]:
        """What devices said of their synchronized clocks in the last so many seconds, in order."""
        begin = time.monotonic() - seconds
        return [clocks for when, clocks in tuple(self._ptp) if when >= begin and clocks]

    def features(self) -> Mapping[str, FeatureDump]:
        """All settings of each device, as they were at its first look; some have none."""
        return dict(self._features)

    def reconnect(self, device: Device) -> None:
        """Find a device again that was lost, while the others go on.

        Raises:
            DeviceError: when it is not there, or cannot be found again.
        """
        name = device.info.name
        if not isinstance(device, Reconnecting):
            raise DeviceError(f"{name}: cannot be found again; stop and start the array")
        self._dogs[name].call(device.reconnect, _RECONNECT_S)
        self._features.pop(name, None)
        samples: list[ClockSample] = []
        if isinstance(device, Latching):
            latch = device.latch
            samples = self._dogs[name].call(
                lambda: [latch() for _ in range(self._stream.settings.latches)], _RECONNECT_S
            )
        self._stream.restart(name, samples)

    def states(self) -> tuple[DeviceState, ...]:
        """How each device fares, in the array's order."""
        return tuple(self._state(device) for device in self._stream.array.devices)

    def _question(self, device: Device) -> Callable[[], None]:
        def ask() -> None:
            name = device.info.name
            if isinstance(device, Monitored):
                self._health[name] = device.health()
            if isinstance(device, Featured) and name not in self._features:
                with suppress(DeviceError):
                    self._features[name] = device.features()
            if isinstance(device, Latching):
                with suppress(DeviceError):  # one that is gone is seen by its silence
                    samples = [device.latch() for _ in range(_READINGS_A_LOOK)]
                    self._stream.clock_read(name, samples)

        return ask

    def _state(self, device: Device) -> DeviceState:
        name, stream = device.info.name, self._stream
        count, period_s = stream.counts[name], stream.settings.period_ns / 1e9
        reserved = stream.settings.ring_frames
        health = self._health.get(name)
        taken = reserved - health.free if health is not None and health.free >= 0 else -1
        age_s = None
        if count.heard_ns >= 0:
            # Since it was last looked: a host that stalls is no silence of a device.
            age_s = max(stream.pumped_ns - count.heard_ns, 0) / 1e9
        colour, sentence = _judged(age_s, period_s, taken, reserved)
        reached = count.last_index + 1
        if count.trouble:
            sentence = f"{sentence}: {count.trouble}" if sentence else count.trouble
        if colour == Colour.RED:
            reached = 1 + max(other.last_index for other in stream.counts.values())
        not_ok = max(reached - count.complete, 0)
        return DeviceState(name, colour, sentence, age_s, count.received, not_ok, taken, reserved)


def _judged(age_s: float | None, period_s: float, taken: int, reserved: int) -> tuple[Colour, str]:
    if age_s is None:
        return Colour.RED, "no frame yet"
    if age_s > max(_RED_S, _AMBER_PERIODS * period_s):
        return Colour.RED, f"silent for {age_s:.1f} s"
    if age_s > max(_AMBER_LEAST_S, _AMBER_PERIODS * period_s):
        return Colour.AMBER, f"silent for {1000 * age_s:.0f} ms"
    if taken * 2 > reserved:
        return Colour.AMBER, f"{taken} of {reserved} frames of memory in use: the disk is slow"
    return Colour.GREEN, ""
