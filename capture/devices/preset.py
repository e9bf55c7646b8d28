"""Presets: settings of a device, written in a given order and read back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from capture.devices.capabilities import Featured, FeatureValue
from capture.documents import read_toml
from capture.errors import DeviceError, SettingsError, raise_all

_CLOSE = 1e-3  # relative: a device rounds an exposure or a gain to its own steps
_SLIGHT = 1e-2  # relative: coarse steps of its own; told, and no reason not to record


@dataclass(frozen=True)
class Preset:
    """Settings to write, in order: some devices accept one only after another.

    Attributes:
        name: of the preset.
        writes: feature name and value, in order; a name may stand there twice.
    """

    name: str
    writes: tuple[tuple[str, FeatureValue], ...]


@dataclass(frozen=True)
class Difference:
    """A setting that does not read back as it was written.

    Attributes:
        feature: its name.
        asked: what was written.
        found: what was read back; None when it could not be read.
        why: what the device said; empty when it took the value and gave another back.
    """

    feature: str
    asked: FeatureValue
    found: FeatureValue | None
    why: str = ""

    @property
    def slight(self) -> bool:
        """Whether the device took the value and rounded it to coarse steps of its own."""
        return self.found is not None and not self.why and alike(self.asked, self.found, _SLIGHT)

    def __str__(self) -> str:
        found = "nothing" if self.found is None else repr(self.found)
        reason = f" ({self.why})" if self.why else ""
        return f"{self.feature}: asked for {self.asked!r}, reads {found}{reason}"


def apply_preset(device: Featured, preset: Preset) -> tuple[Difference, ...]:
    """Write a preset in its order, then read everything back; nothing the device held is assumed.

    Every setting is tried, whatever became of those before it.

    Returns:
        Each setting that does not read back as asked, the last value asked of it counting.
    """
    refused: dict[str, str] = {}
    for name, value in preset.writes:
        try:
            device.write_feature(name, value)
            refused.pop(name, None)
        except DeviceError as error:
            refused[name] = str(error)
    return compare_preset(device, preset, refused)


def compare_preset(
    device: Featured, preset: Preset, refused: Mapping[str, str] | None = None
) -> tuple[Difference, ...]:
    """Each setting that does not read as a preset asks, the last value asked of it counting.

    Args:
        device: only read.
        preset: what is wanted.
        refused: by feature, what the device said when it was written.
    """
    said = dict(refused or {})
    differences = []
    for name, asked in dict(preset.writes).items():
        try:
            found: FeatureValue | None = device.read_feature(name)
        except DeviceError as error:
            found, said[name] = None, said.get(name) or str(error)
        if found is None or not alike(asked, found):
            differences.append(Difference(name, asked, found, said.get(name, "")))
    return tuple(differences)


def read_preset(path: Path) -> Preset:
    """Read a preset file: a list of ``[[feature]]`` tables with `name` and `value`, in order.

    Raises:
        SettingsError: naming the file and the entry that does not fit.
    """
    document = read_toml(path, SettingsError, absent="no such preset")
    return preset_from_table(document, str(path), Path(path).stem)


def preset_from_table(document: Mapping[str, object], where: str, name: str) -> Preset:
    """A preset from a parsed table with a list `feature`.

    Raises:
        SettingsError: naming `where` and the entry that does not fit.
    """
    problems = [f"unknown key {key!r}; known: feature" for key in document if key != "feature"]
    writes: list[tuple[str, FeatureValue]] = []
    entries = document.get("feature", [])
    if not isinstance(entries, list):
        raise SettingsError(f"{where}: expected [[feature]] tables, found {entries!r}")
    for place, entry in enumerate(entries, start=1):
        if not isinstance(entry, Mapping) or set(entry) != {"name", "value"}:
            problems.append(f"feature {place}: expected name and value, found {entry!r}")
        elif not isinstance(entry["name"], str) or not isinstance(
            entry["value"], bool | int | float | str
        ):
            problems.append(
                f"feature {place}: a value is a switch, number or text, found {entry!r}"
            )
        else:
            writes.append((entry["name"], entry["value"]))
    raise_all(where, problems, SettingsError)
    return Preset(name, tuple(writes))


def alike(asked: FeatureValue, found: FeatureValue, share: float = _CLOSE) -> bool:
    """Whether two values are the same setting: numbers up to a share of the first."""
    if isinstance(asked, bool) or isinstance(found, bool):
        return asked is found
    if isinstance(asked, int | float) and isinstance(found, int | float):
        return abs(asked - found) <= share * max(abs(asked), 1e-9)
    return asked == found
