"""What simulated devices look at in virtual time: a `Scene`, found by entry point."""

from __future__ import annotations

from importlib import metadata
from typing import Any, Protocol

from capture.arrays import Image
from capture.camera import Camera
from capture.errors import SettingsError

SCENE_GROUP = "likeness.scenes"


class Scene(Protocol):
    """What simulated devices look at."""

    def render(self, camera: Camera, t_ns: int) -> Image:
        """The image that `camera` takes at the true time `t_ns`, noise of the sensor included."""


def load_scene(name: str) -> Any:
    """The function that opens the scene called `name`, found by entry point `likeness.scenes`.

    Raises:
        SettingsError: naming the scenes that are installed.
    """
    found = {entry.name: entry for entry in metadata.entry_points(group=SCENE_GROUP)}
    if name not in found:
        raise SettingsError(f"no scene {name!r}; installed: {', '.join(sorted(found)) or 'none'}")
    return found[name].load()
