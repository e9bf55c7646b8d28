"""The backend "sim": simulated devices by address.

An address is ``WIDTHxHEIGHT?key=value&...``, all of it optional; a number alone is a seed, and so
is a serial::

    7                        256 x 256 px, drawn with seed 7
    SIM-0007                 the same
    64x48                    64 x 48 px, seed 0
    2048x2048?seed=3&first_id=65500&latency_ms=5

Keys: seed, first_id, id_bits, wraps_to, latency_ms, latency_jitter_ms, offset_ns, drift_ppm,
jitter_ns, channels, dtype. What is not given is drawn by the seed: see `streaming_settings`.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from capture.devices.backend import FoundDevice
from capture.devices.lines import RealTimeLine
from capture.devices.protocol import TriggerLine
from capture.devices.simulated.settings import SimulatedSettings
from capture.devices.simulated.streaming import StreamingDevice, streaming_settings
from capture.errors import DeviceError, LikenessError
from capture.frame_header import ImageLayout
from capture.names import known_hint

_FOUND = 16
_SIZE_PX = 256
_ADDRESS = re.compile(
    r"(?:(?P<seed>\d{1,9})|SIM-(?P<serial>\d{4,9})|(?P<width>\d{1,5})x(?P<height>\d{1,5}))?(?:\?(?P<keys>.*))?"
)
_CLOCK = {"offset_ns": int, "drift_ppm": float, "jitter_ns": float}
_LAYOUT = {"channels": int, "dtype": str}
_OWN = {
    "first_id": int, "id_bits": int, "wraps_to": int, "latency_ms": float,
    "latency_jitter_ms": float,
}  # fmt: skip
_KEYS: dict[str, Callable[[str], Any]] = {"seed": int, **_CLOCK, **_LAYOUT, **_OWN}


class SimulatedBackend:
    """Opens simulated devices, and owns the wire that triggers them.

    All devices that one backend object opens are on one wire, until they are closed. Two arrays
    that live at the same time in one process stay apart by each having a backend object of its own.
    """

    name = "sim"

    def __init__(self, line: RealTimeLine | None = None) -> None:
        """Lay the wire.

        Args:
            line: the wire; one on which `fire` sends the edges when not given.
        """
        self._line = line if line is not None else RealTimeLine()

    def discover(self) -> tuple[FoundDevice, ...]:
        """Sixteen devices; any other address can be opened too."""
        return tuple(
            FoundDevice(
                backend=self.name,
                address=str(seed),
                serial=f"SIM-{seed:04d}",
                model="likeness simulated",
                transport="simulated",
                link_mbps=10_000.0,
            )
            for seed in range(_FOUND)
        )

    def open(self, address: str, name: str) -> StreamingDevice:
        """Open a device.

        Args:
            address: see the module.
            name: that it shall have in the array.

        Raises:
            DeviceError: when the address is none.
        """
        try:
            layout, settings = parse_address(address)
            return StreamingDevice(name, layout, self._line, settings, address)
        except LikenessError as error:
            raise DeviceError(f"{name}: simulated device {address!r}: {error}") from error

    def line(self) -> TriggerLine:
        """The wire of all devices that this object opened."""
        return self._line


backend = SimulatedBackend()


def parse_address(address: str) -> tuple[ImageLayout, SimulatedSettings]:
    """What an address asks for.

    Raises:
        DeviceError: saying what an address looks like.
    """
    matched = _ADDRESS.fullmatch(address)
    if matched is None:
        raise DeviceError("expected a number, or WIDTHxHEIGHT?key=value&..., such as 64x48?seed=3")
    values = _values(matched["keys"] or "")
    layout = ImageLayout(
        int(matched["width"] or _SIZE_PX),
        int(matched["height"] or _SIZE_PX),
        values.get("channels", 1),
        values.get("dtype", "uint8"),
    )
    usual = streaming_settings(int(values.get("seed") or matched["seed"] or matched["serial"] or 0))
    clock = replace(usual.clock, **{key: values[key] for key in _CLOCK if key in values})
    own = {key: values[key] for key in _OWN if key in values}
    return layout, replace(usual, clock=clock, channels=layout.channels, dtype=layout.dtype, **own)


def _values(text: str) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for part in filter(None, text.split("&")):
        key, _, value = part.partition("=")
        if key not in _KEYS:
            raise DeviceError(f"unknown key {key!r}; {known_hint(key, _KEYS)}")
        try:
            values[key] = _KEYS[key](value)
        except ValueError as error:
            raise DeviceError(f"{key}: expected a number, found {value!r}") from error
    return values
