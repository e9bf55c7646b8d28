"""Trigger lines by the host's monotonic clock: who tells all devices of an array to expose.

A wire with a generator of its own needs nothing from the host (`HostLine`). Where there is no wire,
the host tells each device in turn (`SoftwareLine`, for stills) or all of them at once by an action
command (`ActionLine`). `RealTimeLine` is the wire of devices that are played.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from capture.devices.capabilities import ActionTriggered, SoftwareTriggered
from capture.devices.gvcp import GVCP_PORT, ActionResult, send_action
from capture.devices.protocol import ActionKeys, Device
from capture.errors import DeviceError, SettingsError

Told = Callable[[str], None]

_log = logging.getLogger(__name__)


def log_warning(sentence: str) -> None:
    """Write a warning to the log."""
    _log.warning("%s", sentence)


class HostLine:
    """The host only watches the clock: a generator on a wire sends the triggers, or the devices run
    freely."""

    @property
    def fires(self) -> bool:
        """False."""
        return False

    def now_ns(self) -> int:
        """CLOCK_MONOTONIC."""
        return time.monotonic_ns()

    def wait(self, t_ns: int) -> None:
        """Sleep until then."""
        while (rest_ns := t_ns - time.monotonic_ns()) > 0:
            time.sleep(rest_ns * 1e-9)

    def fire(self, t_ns: int) -> None:
        """Wait until then, for the trigger that somebody else sends."""
        self.wait(t_ns)


class Listener(Protocol):
    """A device that is played, at the end of a wire."""

    def edge(self, t_ns: int) -> None:
        """An edge at the true time `t_ns`; returns at once."""


class RealTimeLine(HostLine):
    """The wire to which devices that are played are connected.

    Either `fire` sends the edges, each dated by the time that was asked for, as a generator would
    keep it: that a thread wakes up late makes the news late and not the exposure. Or the line has a
    generator of its own, and an edge comes at every whole multiple of its period.
    """

    def __init__(self, generator_ns: int | None = None) -> None:
        """Lay a wire with nothing connected.

        Args:
            generator_ns: period of the line's own generator; None: edges come from `fire`.
        """
        if generator_ns is not None and generator_ns < 1:
            raise DeviceError(f"a generator needs a period above 0, found {generator_ns} ns")
        self.generator_ns = generator_ns
        self._listeners: tuple[Listener, ...] = ()

    @property
    def fires(self) -> bool:
        """Whether the edges come from `fire`."""
        return self.generator_ns is None

    def connect(self, listener: Listener) -> None:
        """Connect a device; once is enough."""
        if listener not in self._listeners:
            self._listeners += (listener,)

    def disconnect(self, listener: Listener) -> None:
        """Take a device off the wire."""
        self._listeners = tuple(one for one in self._listeners if one is not listener)

    def fire(self, t_ns: int) -> None:
        """Wait until then, and send an edge unless the generator does."""
        self.wait(t_ns)
        if self.generator_ns is None:
            for listener in self._listeners:
                listener.edge(t_ns)


class SoftwareLine(HostLine):
    """Tells each device in turn to expose: for stills, as they do not expose at one instant."""

    def __init__(self, devices: Sequence[Device], told: Told = log_warning) -> None:
        """Hold the devices.

        Args:
            devices: that expose when they are told to.
            told: hears of a device that did not take a trigger; the others get theirs.

        Raises:
            DeviceError: listing the devices that cannot be told to expose.
        """
        unable = [d.info.name for d in devices if not isinstance(d, SoftwareTriggered)]
        if unable:
            raise DeviceError(
                f"software triggers: {', '.join(unable)} cannot be told to expose; "
                "use a hardware trigger, or take them out of the array"
            )
        self._devices = [(d.info.name, d) for d in devices if isinstance(d, SoftwareTriggered)]
        self._told = told

    @property
    def fires(self) -> bool:
        """True."""
        return True

    def fire(self, t_ns: int) -> None:
        """Wait until then, and tell each device to expose."""
        self.wait(t_ns)
        for name, device in self._devices:
            try:
                device.fire()
            except DeviceError as error:
                self._told(f"{name} did not take a software trigger: {error}")


@dataclass(frozen=True, kw_only=True)
class ActionSettings:
    """How action commands are sent.

    Attributes:
        keys: which devices act.
        broadcast: addresses that reach all devices at once, one a network; without any, each device
            is sent a packet of its own, one after the other.
        ahead_ms: how long before its time a scheduled command is sent; above 0.
        timeout_ms: how long answers are waited for; well below the period, as the next command
            waits for it.
        port: of the devices.
    """

    keys: ActionKeys = ActionKeys()  # noqa: RUF009 - frozen
    broadcast: tuple[str, ...] = ()
    ahead_ms: float = 20.0
    timeout_ms: float = 4.0
    port: int = GVCP_PORT

    def __post_init__(self) -> None:
        if not (self.ahead_ms > 0 and self.timeout_ms > 0):
            raise SettingsError(
                f"ahead_ms and timeout_ms must be above 0, found {self.ahead_ms}, {self.timeout_ms}"
            )


class ActionLine(HostLine):
    """Tells all devices to expose by an action command: at once, or at a set time of the clock that
    they share.

    Attributes:
        sent: commands so far.
        unanswered: by address of a device, how many of them it did not accept.
    """

    def __init__(
        self,
        devices: Sequence[Device],
        settings: ActionSettings,
        common_ns: Callable[[int], int] | None = None,
        told: Told = log_warning,
    ) -> None:
        """Hold the addresses of the devices.

        Args:
            devices: that answer action commands.
            settings: keys and times.
            common_ns: what the devices' common clock shows at a time of the host's; None: commands
                are carried out on arrival.
            told: hears when a device ceases to accept commands, and when it does so again.

        Raises:
            DeviceError: listing the devices that do not answer action commands.
        """
        unable = [d.info.name for d in devices if not isinstance(d, ActionTriggered)]
        if unable:
            raise DeviceError(
                f"action commands: {', '.join(unable)} cannot be sent any; "
                "use a hardware trigger, or take them out of the array"
            )
        self._names = {
            d.action_address: d.info.name for d in devices if isinstance(d, ActionTriggered)
        }
        self._settings, self._common_ns, self._told = settings, common_ns, told
        self._deaf: frozenset[str] = frozenset()
        self.sent = 0
        self.unanswered: Counter[str] = Counter()

    @property
    def fires(self) -> bool:
        """True."""
        return True

    def fire(self, t_ns: int) -> None:
        """Send a command, on time or ahead of it, and count the answers."""
        settings, at_ns = self._settings, None
        if self._common_ns is None:
            self.wait(t_ns)
        else:
            self.wait(t_ns - round(1e6 * settings.ahead_ms))
            at_ns = self._common_ns(t_ns)
        self.sent += 1
        try:
            result = send_action(
                tuple(self._names),
                settings.keys,
                at_ns=at_ns,
                timeout_s=1e-3 * settings.timeout_ms,
                broadcast=settings.broadcast,
                port=settings.port,
            )
        except DeviceError as error:
            result = ActionResult(self.now_ns(), (), (), dict.fromkeys(self._names, str(error)))
        self._count(result)

    def _count(self, result: ActionResult) -> None:
        deaf = frozenset((*result.silent, *result.refused))
        self.unanswered.update(deaf)
        if deaf - self._deaf:
            self._told(f"trigger {self.sent}: {result}")
        for address in sorted(self._deaf - deaf):
            self._told(f"trigger {self.sent}: {self._names[address]} accepts action commands again")
        self._deaf = deaf
