"""Simulated devices, in virtual time with a scene, and in real time with a pattern.

In virtual time (`simulated_array`) waiting is instant and a scene renders a frame when it is
fetched: for the demo, and for tests of whole sessions. In real time (`streaming_array`, and the
backend "sim") a device behaves as if a driver stood behind it.
"""

from __future__ import annotations

from capture.devices.faults import Fault, FaultKind
from capture.devices.simulated.opening import SimulatedBackend, backend
from capture.devices.simulated.pattern import Stamp, pattern
from capture.devices.simulated.scene import SCENE_GROUP, Scene, load_scene
from capture.devices.simulated.settings import SimulatedSettings
from capture.devices.simulated.streaming import (
    StreamingDevice,
    streaming_array,
    streaming_settings,
)
from capture.devices.simulated.virtual import SimulatedDevice, SimulatedLine, simulated_array

__all__ = [
    "SCENE_GROUP",
    "Fault",
    "FaultKind",
    "Scene",
    "SimulatedBackend",
    "SimulatedDevice",
    "SimulatedLine",
    "SimulatedSettings",
    "Stamp",
    "StreamingDevice",
    "backend",
    "load_scene",
    "pattern",
    "simulated_array",
    "streaming_array",
    "streaming_settings",
]
