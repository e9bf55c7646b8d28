"""What a device is: three small parts - when it exposes, how it is armed, where its frames are.

A simulated device and a real one have the same parts; nothing above this module knows which it has.
What else a device can do is told by what it implements: see `capture.devices.capabilities`.

References:
    The split is that of ophyd-async's detectors (trigger, arm and data logic).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol, Self

from capture.arrays import Image
from capture.errors import SettingsError
from capture.frame import FrameEvent
from capture.frame_header import ImageLayout


class TriggerKind(StrEnum):
    """What starts an exposure."""

    HARDWARE = "hardware"  # an edge on a wire that all devices share
    SOFTWARE = "software"  # a command to one device: for stills only
    ACTION = "action"  # a command to all devices at a set time, their clocks being synchronized
    FREE_RUN = "free_run"


class ClockKind(StrEnum):
    """Whose clock dates a device's frames."""

    OWN = "own"  # the device's: it starts anywhere and drifts
    HOST = "host"  # the host's monotonic clock, as drivers of V4L2 use


@dataclass(frozen=True, kw_only=True)
class ActionKeys:
    """Which devices an action command is meant for; each is a word of 32 bits.

    Attributes:
        device_key: must equal the device's own.
        group_key: must equal that of the device's action.
        group_mask: the device acts when this and its own mask share a bit.
    """

    device_key: int = 1
    group_key: int = 1
    group_mask: int = 0xFFFFFFFF

    def __post_init__(self) -> None:
        for name in ("device_key", "group_key", "group_mask"):
            if not 0 <= getattr(self, name) < 1 << 32:
                raise SettingsError(f"{name} must fit 32 bits, found {getattr(self, name)}")


@dataclass(frozen=True, kw_only=True)
class TriggerSpec:
    """How a take is triggered.

    Attributes:
        kind: what starts an exposure.
        period_ns: from trigger to trigger.
        exposure_us: how long each exposure lasts.
        source: the input of a hardware trigger, such as "Line0"; empty for the device's own choice.
        action: which devices act, for action commands.
    """

    kind: TriggerKind
    period_ns: int
    exposure_us: float
    source: str = ""
    action: ActionKeys = ActionKeys()

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
        id_bits: width of its frame numbers.
        triggers: what can start its exposures.
        first_id: the number that follows the highest: 1 with GigE Vision, 0 with V4L2.
        clock: whose clock dates its frames.
        transport: "gige", "usb3", "v4l2", "simulated" or "replay"; a third party's own word.
        address: by which its backend opens it.
        link_mbps: what its link carries, Mbit/s; None when that is not known.
    """

    name: str
    serial: str
    model: str
    layout: ImageLayout
    id_bits: int
    triggers: tuple[TriggerKind, ...]
    first_id: int = 1
    clock: ClockKind = ClockKind.OWN
    transport: str = "simulated"
    address: str = ""
    link_mbps: float | None = None


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


class FrameLogic(Protocol):
    """Where a device's frames are. `pixels` and `release` may be called from any thread."""

    def reserve(self, frames: int) -> None:
        """Set memory aside for so many frames that are not yet released; called before `start`.

        When all of it is taken, the device loses frames; it never overwrites one.

        Raises:
            DeviceError: when there is not so much memory.
        """

    def poll(self) -> Sequence[FrameEvent]:
        """The frames that have arrived since the last call, in their order of arrival.

        Never waits. A device that is gone delivers nothing; it does not raise.
        """

    def pixels(self, event: FrameEvent) -> Image:
        """The image of a frame that has not been released.

        Where the device fills memory of ours this is a view of it: good until `release`.
        """

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
    def frames(self) -> FrameLogic:
        """Where its frames are."""

    def close(self) -> None:
        """Stop, and give the device back; a closed device may be closed again."""


class WholeDevice:
    """A device that is its own trigger, acquire and frames: one object with the methods of all."""

    @property
    def trigger(self) -> Self:
        """When it exposes."""
        return self

    @property
    def acquire(self) -> Self:
        """How it is armed."""
        return self

    @property
    def frames(self) -> Self:
        """Where its frames are."""
        return self


class TriggerLine(Protocol):
    """What triggers all devices of an array, and the host's clock that it goes by."""

    @property
    def fires(self) -> bool:
        """Whether `fire` sends the triggers; False when a generator or the devices do."""

    def now_ns(self) -> int:
        """The host's clock."""

    def wait(self, t_ns: int) -> None:
        """Return when the host's clock shows `t_ns`."""

    def fire(self, t_ns: int) -> None:
        """Send a trigger when the host's clock shows `t_ns`."""
