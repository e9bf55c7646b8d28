"""`Frame`, `FrameSet`, and the clocks that date them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from capture.arrays import Image
from capture.errors import SettingsError, TakeError
from capture.frame_header import FrameHeader


@dataclass(frozen=True, kw_only=True)
class Clock:
    """A clock that is off: how a device's time follows from the true time.

    Attributes:
        offset_ns: what it shows at true time 0.
        drift_ppm: how much too fast it runs, millionths; -1000 to 1000.
        jitter_ns: standard deviation of a single reading.
        seed: of the jitter; the same true time always reads the same.
    """

    offset_ns: int = 0
    drift_ppm: float = 0.0
    jitter_ns: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not abs(self.drift_ppm) <= 1000:
            raise SettingsError(f"drift_ppm must lie in -1000..1000, found {self.drift_ppm}")
        if not self.jitter_ns >= 0:
            raise SettingsError(f"jitter_ns must be 0 or more, found {self.jitter_ns}")

    def read(self, t_ns: int) -> int:
        """What the clock shows at the true time `t_ns`."""
        jitter = 0.0
        if self.jitter_ns:
            generator = np.random.default_rng((self.seed, t_ns & 0xFFFF_FFFF_FFFF_FFFF))
            jitter = self.jitter_ns * float(generator.standard_normal())
        return self.offset_ns + t_ns + round(t_ns * self.drift_ppm * 1e-6 + jitter)


@dataclass(frozen=True, slots=True)
class FrameEvent:
    """The news that a frame has arrived. Pixels never travel with it.

    Attributes:
        device: the device's name.
        frame_id: the number the device gave it.
        t_dev_ns: start of exposure by the device's clock.
        t_host_ns: arrival by the host's clock.
        slot: by which the device finds the pixels.
        exposure_us: exposure time; -1 unknown.
        complete: False when parts of the image did not arrive.
        note: what else the ledger should say of it: that packets were resent, for one.
    """

    device: str
    frame_id: int
    t_dev_ns: int
    t_host_ns: int
    slot: int
    exposure_us: float = -1.0
    complete: bool = True
    note: str = ""


@dataclass(frozen=True, eq=False)
class Frame:
    """One image of one device at one trigger.

    Attributes:
        device: the device's name.
        header: trigger index, times, exposure, as they stand on disk.
        image: (H, W) mono or (H, W, 3) RGB, uint8 or uint16.
    """

    device: str
    header: FrameHeader
    image: Image


@dataclass(frozen=True, eq=False)
class FrameSet:
    """What all devices saw at one trigger.

    Attributes:
        trigger_index: the trigger.
        frames: by device name, in the take's order; a device without a frame is not there.
        missing: the devices without a frame.
    """

    trigger_index: int
    frames: Mapping[str, Frame]
    missing: tuple[str, ...] = ()

    @property
    def complete(self) -> bool:
        """Whether every device has a frame."""
        return not self.missing

    def image(self, device: str) -> Image:
        """The image of one device.

        Raises:
            TakeError: when that device has no frame at this trigger.
        """
        if device not in self.frames:
            raise TakeError(
                f"frame set {self.trigger_index}: no frame of {device!r}; "
                f"it has {', '.join(self.frames)}"
            )
        return self.frames[device].image
