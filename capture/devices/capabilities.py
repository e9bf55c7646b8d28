"""What a device may be able to do besides sending frames: it can when it implements the protocol.

`isinstance(device, Latching)` asks. Whoever needs a capability says so in words when a device lacks
it; nobody asks what class a device is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from capture.devices.protocol import ClockSample

FeatureValue = bool | int | float | str


@dataclass(frozen=True)
class FeatureDump:
    """All settings of a device at one moment.

    Attributes:
        values: by feature name; features that could not be read are left out.
        description: the device's own description of its features (GenICam XML); empty without one.
        description_sha256: of that, hex; empty without one.
        unread: by feature name, why it could not be read.
    """

    values: Mapping[str, FeatureValue]
    description: str = ""
    description_sha256: str = ""
    unread: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class PtpReading:
    """What a device says of its clock's synchronization (IEEE 1588).

    Attributes:
        state: in the standard's words, lower case: "slave", "master", "listening", "disabled", ...
        offset_ns: from its master; None when it does not say.
        grandmaster: identity of the clock that all follow; empty when it does not say.
    """

    state: str
    offset_ns: int | None = None
    grandmaster: str = ""

    @property
    def locked(self) -> bool:
        """Whether the device follows a clock, or is the one that others follow."""
        return self.state in ("slave", "master")


@dataclass(frozen=True)
class Health:
    """How a device fares.

    Attributes:
        connected: whether it answers.
        temperature_c: of the device; None when it does not say.
        counters: the transport's own counters, for the log: they are never trusted as frame counts.
        ptp: of its clock; None without PTP.
        free: frames of memory that are free; -1 unknown.
    """

    connected: bool
    temperature_c: float | None = None
    counters: Mapping[str, int] = field(default_factory=dict)
    ptp: PtpReading | None = None
    free: int = -1


@runtime_checkable
class Latching(Protocol):
    """A device whose clock can be read."""

    def latch(self) -> ClockSample:
        """Read the device's clock.

        Raises:
            DeviceError: when it does not answer.
        """


@runtime_checkable
class Featured(Protocol):
    """A device with named settings. All three raise `DeviceError` when it does not answer."""

    def read_feature(self, name: str) -> FeatureValue:
        """The value of a setting; `DeviceError` when there is no such setting."""

    def write_feature(self, name: str, value: FeatureValue) -> None:
        """Set one; `DeviceError` saying what it offers, when it does not take that value."""

    def features(self) -> FeatureDump:
        """All settings."""


@runtime_checkable
class Monitored(Protocol):
    """A device that says how it fares."""

    def health(self) -> Health:
        """How it fares; a device that is gone says so and does not raise."""


@runtime_checkable
class Cautioned(Protocol):
    """A device that knows of itself why it may lose frames, or was changed when it was opened."""

    @property
    def problems(self) -> tuple[str, ...]:
        """Each in words, a remedy behind "; " where there is one; told by the preflight."""


@runtime_checkable
class PtpClocked(Protocol):
    """A device whose clock can follow IEEE 1588."""

    def enable_ptp(self, on: bool) -> None:
        """Switch it on or off; a device that is listening for a master is not reset."""

    def ptp(self) -> PtpReading:
        """The state now."""


@runtime_checkable
class SoftwareTriggered(Protocol):
    """A device that exposes when it is told to."""

    def fire(self) -> None:
        """Expose now."""


@runtime_checkable
class ActionTriggered(Protocol):
    """A device that answers action commands of GigE Vision."""

    @property
    def action_address(self) -> str:
        """Its IP address."""


@runtime_checkable
class Reconnecting(Protocol):
    """A device that can be found again after it was lost, while the others go on."""

    def reconnect(self) -> None:
        """Open it anew, prepare it as before and start it.

        Raises:
            DeviceError: when it is not there.
        """
