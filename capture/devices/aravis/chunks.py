"""What a device says of a frame in the frame itself (chunk data of GenICam)."""

from __future__ import annotations

from typing import Any

from capture.devices.aravis.features import Features
from capture.devices.aravis.library import aravis, translated
from capture.errors import DeviceError

_SWITCH, _EXPOSURE = "ChunkModeActive", "ChunkExposureTime"


class ExposureChunk:
    """Reads how long each frame was exposed; belongs to the thread that polls."""

    def __init__(self, name: str, device: Any) -> None:
        """Be ready to read.

        Args:
            name: of the device, for messages.
            device: of Aravis.
        """
        self._name = name
        with translated(name, "its chunks"):
            self._parser = device.create_chunk_parser()
            self._whole = isinstance(device.get_feature(_EXPOSURE), aravis().GcInteger)

    def exposure_us(self, buffer: Any, otherwise_us: float) -> float:
        """The exposure time that a frame carries, us.

        Args:
            buffer: of Aravis, complete.
            otherwise_us: what to say of a frame that carries none.
        """
        parser = self._parser
        read = parser.get_integer_value if self._whole else parser.get_float_value
        try:
            with translated(self._name, _EXPOSURE):
                return float(read(buffer, _EXPOSURE))
        except DeviceError:
            return otherwise_us


def sends_exposure(features: Features) -> bool:
    """Whether the device is set to say in each frame how long that was exposed."""
    if not features.has(_SWITCH) or not features.read(_SWITCH):
        return False
    return features.has(_EXPOSURE)
