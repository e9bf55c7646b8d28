"""All settings of a device by name: what it streams, and its controls.

What it streams has the names that GenICam gives it, so that one preset serves devices of any kind;
controls have the driver's names, in lower case with underscores.
"""

from __future__ import annotations

import hashlib
import json

from capture.devices.capabilities import FeatureDump, FeatureValue
from capture.devices.v4l2 import ioctls
from capture.devices.v4l2.controls import (
    ControlInfo,
    control_table,
    find_control,
    list_controls,
    read_control,
    write_control,
)
from capture.devices.v4l2.formats import fourcc_text
from capture.devices.v4l2.node import Node
from capture.devices.v4l2.stream_settings import (
    offered_formats,
    period_ns,
    present_format,
    set_format,
    set_period,
    set_size,
)
from capture.errors import DeviceError

_STREAM = ("PixelFormat", "Width", "Height", "AcquisitionFrameRate")
_MOST = 65535


class FeatureTable:
    """Reads and writes settings, and remembers what was written for a device that comes back."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._written: dict[str, FeatureValue] = {}

    def read(self, name: str) -> FeatureValue:
        """The value of a setting; `DeviceError` when there is none of that name."""
        if name in _STREAM:
            return self._read_stream(name)
        return read_control(self._node, self._control(name))

    def write(self, name: str, value: FeatureValue) -> None:
        """Set one; `DeviceError` saying what is offered."""
        if name in _STREAM:
            self._write_stream(name, value)
            return
        control = self._control(name)
        write_control(self._node, control, value)
        if control.type != ioctls.TYPE_BUTTON:
            self._written.pop(name, None)  # last written, last written again
            self._written[name] = value

    def dump(self) -> FeatureDump:
        """All settings; controls without a value that can be read are told apart."""
        controls = list_controls(self._node)
        values: dict[str, FeatureValue] = {}
        unread: dict[str, str] = {}
        for name in (*_STREAM, *controls):
            try:
                values[name] = self.read(name) if name in _STREAM else (
                    read_control(self._node, controls[name])
                )  # fmt: skip
            except DeviceError as error:
                unread[name] = str(error)
        table = {
            "pixel_formats": list(offered_formats(self._node)),
            "controls": control_table(controls),
        }
        text = json.dumps(table, indent=1)
        return FeatureDump(values, text, hashlib.sha256(text.encode()).hexdigest(), unread)

    def return_to(self, node: Node) -> None:
        """Write to a node all that was written to the one before it.

        Raises:
            DeviceError: when a value is no longer taken.
        """
        self._node = node
        for name, value in dict(self._written).items():
            self.write(name, value)

    def _control(self, name: str) -> ControlInfo:
        return find_control(list_controls(self._node), name, list(_STREAM))

    def _read_stream(self, name: str) -> FeatureValue:
        if name == "AcquisitionFrameRate":
            found = period_ns(self._node)
            if found is None:
                raise DeviceError("AcquisitionFrameRate: the driver does not say")
            return 1e9 / found
        pix = present_format(self._node)
        if name == "PixelFormat":
            return fourcc_text(pix.pixelformat)
        return int(pix.width if name == "Width" else pix.height)

    def _write_stream(self, name: str, value: FeatureValue) -> None:
        if name == "PixelFormat":
            pix = present_format(self._node)
            set_format(self._node, str(value), int(pix.width), int(pix.height))
            return
        number = _number(name, value)
        try:
            if name == "AcquisitionFrameRate":
                set_period(self._node, round(1e9 / number))
            else:
                side = round(number)
                wide = name == "Width"
                set_size(self._node, side if wide else None, None if wide else side)
        except DeviceError as error:
            raise DeviceError(f"{name}: {error}") from error


def _number(name: str, value: FeatureValue) -> float:
    if isinstance(value, bool | str) or not 0 < value <= _MOST:
        raise DeviceError(f"{name}: asked for {value!r}, expected a number in 0..{_MOST}")
    return float(value)
