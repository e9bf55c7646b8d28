"""What a device is: three small parts - when it exposes, how it is armed, where its frames are.

A simulated device and a real one have the same parts; nothing above this module knows which it has.

References:
    The split is that of ophyd-async's detectors (trigger, arm and data logic).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

from capture.arrays import Image
from capture.errors import DeviceError, SettingsError, TakeError, raise_all
from capture.frame import FrameEvent
from capture.frame_header import ImageLayout
from capture.names import is_plain_name


class TriggerKind(StrEnum):
    """What starts an exposure."""

    HARDWARE = "hardware"  # an edge on a wire that all devices share
    SOFTWARE = "software"  # a command to one device: for stills only
    ACTION = "action"  # a command to all devices at a set time, their clocks being synchronized
    FREE_RUN = "free_run"


@dataclass(frozen=True, kw_only=True)
class TriggerSpec:
    """How a take is triggered.

    Attributes:
        kind: what starts an exposure.
        period_ns: from trigger to trigger.
        exposure_us: how long each exposure lasts.
    """

    kind: TriggerKind
    period_ns: int
    exposure_us: float

    def __post_init__(self) -> None:
        if self.period_ns < 1:
            raise SettingsError(f"period_ns must be above 0, found {self.period_ns}")
        if not 0 < self.exposure_us < self.period_ns / 1000:
            raise SettingsError(
                f"exposure_us must lie between 0 and the period of {self.period_ns / 1000:.0f} us, "
                f"found {self.exposure_us}"
            )


@dataclass(frozen=True, kw_only=True)
class DeviceInfo:
    """What a device says of itself.

    Attributes:
        name: unique in the array, safe as a file name.
        serial: by which it is known again.
        model: maker and model.
        layout: size and pixel type of its frames.
        id_bits: width of its frame numbers; they count from 1 and wrap to 1, as GigE Vision's.
        triggers: what can start its exposures.
    """

    name: str
    serial: str
    model: str
    layout: ImageLayout
    id_bits: int
    triggers: tuple[TriggerKind, ...]


@dataclass(frozen=True)
class ClockSample:
    """One reading of a device's clock, between two readings of the host's.

    Attributes:
        t_dev_ns: the device's clock.
        before_ns: the host's clock when it asked.
        after_ns: the host's clock when the answer came.
    """

    t_dev_ns: int
    before_ns: int
    after_ns: int


class TriggerLogic(Protocol):
    """When a device exposes."""

    def prepare(self, spec: TriggerSpec) -> None:
        """Set the device up for a kind of trigger.

        Raises:
            DeviceError: when it cannot do that.
        """


class AcquireLogic(Protocol):
    """How a device is armed."""

    def start(self) -> None:
        """Begin to answer triggers."""

    def stop(self) -> None:
        """Cease to answer triggers. What has been exposed can still be fetched."""

    def latch(self) -> ClockSample:
        """Read the device's clock."""


class DataLogic(Protocol):
    """Where a device's frames are."""

    def poll(self) -> Sequence[FrameEvent]:
        """The frames that have arrived since the last call, in their order of arrival."""

    def pixels(self, event: FrameEvent) -> Image:
        """The image of a frame that has not been released."""

    def release(self, event: FrameEvent) -> None:
        """Give the frame's memory back to the device. Every event polled must be released."""


class Device(Protocol):
    """One device of an array."""

    @property
    def info(self) -> DeviceInfo:
        """What the device says of itself."""

    @property
    def trigger(self) -> TriggerLogic:
        """When it exposes."""

    @property
    def acquire(self) -> AcquireLogic:
        """How it is armed."""

    @property
    def data(self) -> DataLogic:
        """Where its frames are."""


class TriggerLine(Protocol):
    """The wire that triggers all devices of an array, and the host's clock that it goes by."""

    def now_ns(self) -> int:
        """The host's clock."""

    def wait(self, t_ns: int) -> None:
        """Return when the host's clock shows `t_ns`."""

    def fire(self, t_ns: int) -> None:
        """Send an edge when the host's clock shows `t_ns`."""


@dataclass(frozen=True, eq=False)
class DeviceArray:
    """The devices that are recorded together, and the line that triggers them.

    Attributes:
        devices: in a fixed order, with unique names.
        line: triggers them all.
    """

    devices: tuple[Device, ...]
    line: TriggerLine

    def __post_init__(self) -> None:
        names = self.names
        problems = [
            f"{name!r} is not safe as a file name" for name in names if not is_plain_name(name)
        ]
        problems += [
            f"{name!r} is there twice" for name in sorted(set(names)) if names.count(name) > 1
        ]
        if not names:
            problems.append("there must be at least one device")
        raise_all("device array", problems, TakeError)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the devices, in order."""
        return tuple(device.info.name for device in self.devices)

    def prepare(self, spec: TriggerSpec) -> None:
        """Set every device up; all are tried.

        Raises:
            DeviceError: listing every device that could not, and why.
        """
        problems = []
        for device in self.devices:
            try:
                device.trigger.prepare(spec)
            except DeviceError as error:
                problems.append(f"  - {device.info.name}: {error}")
        if problems:
            raise DeviceError(
                "\n".join([f"{len(problems)} of {len(self.devices)} devices not ready:", *problems])
            )
