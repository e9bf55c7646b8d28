"""The named settings of a device (GenICam): reading, writing, and all of them at once."""

from __future__ import annotations

import hashlib
import math
from typing import Any

from capture.devices.aravis.handle import Handle
from capture.devices.aravis.library import aravis, genicam_xml, translated
from capture.devices.capabilities import FeatureDump, FeatureValue
from capture.errors import DeviceError
from capture.names import known_hint


class Features:
    """The settings of one device. All calls belong on the device's own control thread."""

    def __init__(self, handle: Handle) -> None:
        """Hold a device.

        Args:
            handle: to it.
        """
        self._handle, self._name = handle, handle.name

    @property
    def _device(self) -> Any:
        return self._handle.device

    def has(self, name: str) -> bool:
        """Whether there is such a setting, and it can be used as things are."""
        with translated(self._name, name):
            return bool(self._device.is_feature_available(name))

    def first(self, *names: str) -> str:
        """The first of these that the device has; empty when it has none."""
        return next((name for name in names if self.has(name)), "")

    def read(self, name: str) -> FeatureValue:
        """The value of a setting; `DeviceError` when there is none of that name."""
        library, node, device = aravis(), self._node(name), self._device
        with translated(self._name, name):
            if isinstance(node, library.GcEnumeration):
                return str(device.get_string_feature_value(name))
            if isinstance(node, library.GcBoolean):
                return bool(device.get_boolean_feature_value(name))
            if isinstance(node, library.GcCommand):
                raise DeviceError(f"{self._name}: {name} is a command, it has no value")
            if isinstance(node, library.GcString) and not isinstance(node, library.GcInteger):
                return str(device.get_string_feature_value(name))
            if isinstance(node, library.GcFloat) and not isinstance(node, library.GcInteger):
                return float(device.get_float_feature_value(name))
            if isinstance(node, library.GcStringRegNode):
                return str(device.get_string_feature_value(name))
            return int(device.get_integer_feature_value(name))

    def write(self, name: str, value: FeatureValue) -> None:
        """Set one, or run a command; `DeviceError` saying what it offers instead."""
        library, node, device = aravis(), self._node(name), self._device
        with translated(self._name, f"{name} = {value!r}"):
            if isinstance(node, library.GcEnumeration):
                offered = self.entries(name)
                if value not in offered:
                    raise self._refusal(name, value, ", ".join(offered))
                device.set_string_feature_value(name, value)
            elif isinstance(node, library.GcBoolean):
                if not isinstance(value, bool):
                    raise self._refusal(name, value, "true, false")
                device.set_boolean_feature_value(name, value)
            elif isinstance(node, library.GcCommand):
                device.execute_command(name)
            elif isinstance(node, library.GcStringRegNode):
                device.set_string_feature_value(name, str(value))
            elif isinstance(node, library.GcFloat) and not isinstance(node, library.GcInteger):
                device.set_float_feature_value(name, self._number(name, value, whole=False))
            elif isinstance(node, library.GcInteger):
                device.set_integer_feature_value(name, int(self._number(name, value, whole=True)))
            else:
                device.set_string_feature_value(name, str(value))

    def run(self, name: str) -> None:
        """Run a command."""
        with translated(self._name, name):
            self._device.execute_command(name)

    def entries(self, name: str) -> tuple[str, ...]:
        """What a setting that is a choice offers; empty when there is no such setting."""
        if not self.has(name):
            return ()
        with translated(self._name, name):
            return tuple(self._device.dup_available_enumeration_feature_values_as_strings(name))

    def bounds(self, name: str) -> tuple[float, float]:
        """The least and the greatest value of a number."""
        library, node = aravis(), self._node(name)
        with translated(self._name, name):
            if isinstance(node, library.GcInteger):
                least, most = self._device.get_integer_feature_bounds(name)
            else:
                least, most = self._device.get_float_feature_bounds(name)
        return least, most

    def dump(self) -> FeatureDump:
        """All settings, and the device's description of them."""
        with translated(self._name, "its description"):
            description = genicam_xml(self._device)
        values: dict[str, FeatureValue] = {}
        unread: dict[str, str] = {}
        for name in self._names():
            try:
                if not isinstance(self._node(name), aravis().GcCommand):
                    if self.has(name):
                        values[name] = self.read(name)
                    else:
                        unread[name] = "not available as things are"
            except DeviceError as error:
                unread[name] = str(error)
        digest = hashlib.sha256(description).hexdigest()
        return FeatureDump(values, description.decode("utf-8", "replace"), digest, unread)

    def _names(self) -> list[str]:
        """Of all settings, as the description's categories list them."""
        library, genicam = aravis(), self._device.get_genicam()
        names: dict[str, None] = {}
        waiting, seen = ["Root"], set()
        while waiting:
            name = waiting.pop(0)
            if name in seen:
                continue
            seen.add(name)
            node = genicam.get_node(name)
            if isinstance(node, library.GcCategory):
                waiting += list(node.get_features())
            elif node is not None:
                names[name] = None
        return list(names)

    def _node(self, name: str) -> Any:
        node = self._device.get_feature(name)
        if node is None or isinstance(node, aravis().GcCategory):
            raise DeviceError(
                f"{self._name}: no setting {name!r}; {known_hint(name, sorted(self._names()))}"
            )
        return node

    def _number(self, name: str, value: FeatureValue, *, whole: bool) -> float:
        least, most = self.bounds(name)
        span = f"{least:g} to {most:g}"
        if isinstance(value, bool | str) or not math.isfinite(value):
            raise self._refusal(name, value, span)
        if not least <= value <= most or (whole and value != int(value)):
            raise self._refusal(name, value, f"{'whole numbers, ' if whole else ''}{span}")
        return value

    def _refusal(self, name: str, value: FeatureValue, offered: str) -> DeviceError:
        return DeviceError(f"{self._name}: asked for {name} = {value!r}, offers {offered}")
