"""Some of the devices of a take, as if it had no others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from capture.arrays import Image
from capture.errors import SettingsError
from capture.names import known_hint
from capture.take import Take


@dataclass(frozen=True, eq=False)
class TakeDevices:
    """A take seen through some of its devices.

    Attributes:
        take: the whole take.
        device_names: the devices that count, in the take's order.
    """

    take: Take
    device_names: tuple[str, ...]

    @classmethod
    def without(cls, take: Take, left_out: Sequence[str]) -> TakeDevices:
        """All devices but these.

        Raises:
            SettingsError: naming a device that the take does not have, or when none is left.
        """
        for name in left_out:
            if name not in take.device_names:
                raise SettingsError(
                    f"leave_out: the take has no device {name!r}; "
                    f"{known_hint(name, take.device_names)}"
                )
        left = tuple(name for name in take.device_names if name not in left_out)
        if not left:
            raise SettingsError("leave_out: names every device of the take; leave some in")
        return cls(take, left)

    @property
    def frames(self) -> tuple[int, ...]:
        """Frame numbers."""
        return self.take.frames

    def size(self, device: str) -> tuple[int, int]:
        """(width, height) of a device's images, px."""
        return self.take.size(device)

    def present(self, device: str, frame: int) -> bool:
        """Whether that frame was not lost."""
        return self.take.present(device, frame)

    def image(self, device: str, frame: int) -> Image:
        """The image."""
        return self.take.image(device, frame)
