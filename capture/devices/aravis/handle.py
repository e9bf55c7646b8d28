"""The hold on a device of Aravis, which is let go of at one place."""

from __future__ import annotations

import contextlib
from typing import Any

from capture.devices.aravis.library import translated
from capture.errors import DeviceError


class Handle:
    """A device of Aravis. Whoever lets go of the last hold on it waits until it is left."""

    def __init__(self, name: str, camera: Any) -> None:
        """Hold a device.

        Args:
            name: of the device, for messages.
            camera: of Aravis.
        """
        self.name = name
        self._camera = camera

    @property
    def camera(self) -> Any:
        """The device, as what Aravis calls a camera.

        Raises:
            DeviceError: when it has been let go.
        """
        if self._camera is None:
            raise DeviceError(f"{self.name}: is closed")
        return self._camera

    @property
    def device(self) -> Any:
        """The device, as what Aravis calls a device.

        Raises:
            DeviceError: when it has been let go.
        """
        return self.camera.get_device()

    def drop(self) -> None:
        """Let go. May be called again."""
        camera, self._camera = self._camera, None
        if camera is not None and camera.is_gv_device():
            # Said, not left to the last hold: an error that somebody keeps holds the device too.
            with contextlib.suppress(DeviceError), translated(self.name):
                camera.get_device().leave_control()
