"""`Frame`, `FrameSet`, and the clocks that date them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from capture.arrays import Image
from capture.errors import TakeError
from capture.mcap import FrameHeader


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
