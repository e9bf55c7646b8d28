"""Named settings of a simulated device, as awkward as real ones: ranges, steps and an order."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass

from capture.devices.capabilities import FeatureDump, FeatureValue
from capture.errors import DeviceError
from capture.names import known_hint


@dataclass(frozen=True)
class NumberFeature:
    """A number within a range, rounded to steps.

    Attributes:
        low: the least value.
        high: the greatest.
        step: the device rounds to multiples of it, counted from `low`.
    """

    low: float
    high: float
    step: float


@dataclass(frozen=True)
class ChoiceFeature:
    """A word of a few.

    Attributes:
        words: that the device knows.
        locked_by: a setting and the word of it, while which this one cannot be set.
    """

    words: tuple[str, ...]
    locked_by: tuple[str, str] | None = None


Feature = NumberFeature | ChoiceFeature | bool | None  # a bool is a switch; None cannot be set

_FEATURES: dict[str, Feature] = {
    "ExposureTime": NumberFeature(10.0, 1_000_000.0, 0.5),
    "Gain": NumberFeature(0.0, 24.0, 0.1),
    "BlackLevel": NumberFeature(0.0, 64.0, 1.0),
    "AcquisitionFrameRate": NumberFeature(1.0, 1000.0, 0.01),
    "TriggerMode": ChoiceFeature(("Off", "On")),
    "TriggerSource": ChoiceFeature(("Line0", "Line1", "Software"), ("TriggerMode", "On")),
    "PtpEnable": True,
    "Width": None,
    "Height": None,
    "PixelFormat": None,
    "DeviceModelName": None,
    "DeviceSerialNumber": None,
}


class FeatureTable:
    """The settings and their values."""

    def __init__(self, fixed: Mapping[str, FeatureValue]) -> None:
        """Begin with the values of a device that was just switched on.

        Args:
            fixed: values of the settings that cannot be set.
        """
        self._values: dict[str, FeatureValue] = {
            "ExposureTime": 5000.0,
            "Gain": 0.0,
            "BlackLevel": 4.0,
            "AcquisitionFrameRate": 30.0,
            "TriggerMode": "Off",
            "TriggerSource": "Line0",
            "PtpEnable": False,
            **fixed,
        }

    def read(self, name: str) -> FeatureValue:
        """The value of a setting.

        Raises:
            DeviceError: when there is no such setting, naming the nearest.
        """
        if name not in self._values:
            raise DeviceError(f"no feature {name!r}; {known_hint(name, self._values)}")
        return self._values[name]

    def write(self, name: str, value: FeatureValue) -> FeatureValue:
        """Set one, and return what it became.

        Raises:
            DeviceError: saying what the device offers, when it does not take that value.
        """
        self.read(name)
        feature = _FEATURES[name]
        if feature is None:
            raise DeviceError(f"{name} cannot be set; it is {self._values[name]!r}")
        if isinstance(feature, bool):
            if not isinstance(value, bool):
                raise DeviceError(f"{name}: asked for {value!r}, offers true, false")
            self._values[name] = value
        elif isinstance(feature, ChoiceFeature):
            self._values[name] = self._word(name, feature, value)
        else:
            self._values[name] = _rounded(name, feature, value)
        return self._values[name]

    def dump(self) -> FeatureDump:
        """All settings."""
        lines = [f"  <{name}>{_offer(feature)}</{name}>" for name, feature in _FEATURES.items()]
        text = "\n".join(["<SimulatedDevice>", *lines, "</SimulatedDevice>", ""])
        return FeatureDump(dict(self._values), text, hashlib.sha256(text.encode()).hexdigest())

    def _word(self, name: str, feature: ChoiceFeature, value: FeatureValue) -> str:
        if feature.locked_by is not None:
            other, word = feature.locked_by
            if self._values[other] == word:
                raise DeviceError(
                    f"{name} cannot be set while {other} is {word}; set {other} first"
                )
        if not isinstance(value, str) or value not in feature.words:
            raise DeviceError(f"{name}: asked for {value!r}, offers {_offer(feature)}")
        return value


def _rounded(name: str, feature: NumberFeature, value: FeatureValue) -> float:
    if isinstance(value, bool | str) or not feature.low <= value <= feature.high:
        raise DeviceError(f"{name}: asked for {value!r}, offers {_offer(feature)}")
    return feature.low + round((value - feature.low) / feature.step) * feature.step


def _offer(feature: Feature) -> str:
    if isinstance(feature, NumberFeature):
        return f"{feature.low:g} to {feature.high:g} in steps of {feature.step:g}"
    if isinstance(feature, ChoiceFeature):
        return ", ".join(feature.words)
    return "read only" if feature is None else "true, false"
