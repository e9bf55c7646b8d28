"""The array file: the roster of devices, how they are triggered and how takes are recorded.

::

    [array]
    name = "stage"
    trigger = "hardware"            # hardware, software, action or free_run
    source = "Line0"                # input of a hardware trigger; left out: the device's own choice
    ptp = true                      # switch PTP on; left out: as the devices or presets have it
    calibration = "cameras.json"    # left out: none is named

    [action]                        # action commands; all of it may be left out
    device_key = 1                  # with group_key and group_mask: who is meant
    broadcast = ["10.0.0.255"]      # left out: each device is sent a packet of its own
    ahead_ms = 20.0                 # set for a time of the PTP clock, sent so long before it;
                                    # left out: carried out on arrival
    timeout_ms = 4.0                # for answers; well below the period

    [record]                        # capture.recorder.RecordSettings
    rate_hz = 75.0

    [[device]]                      # one table a device, in the order of the array
    name = "cam01"
    backend = "aravis"              # aravis, v4l2, sim, replay or one of a third party
    serial = "40012345"             # and, or else, address
    preset = "stage.preset.toml"
    width = 2048                    # what its frames must be once the preset is written
    height = 2048
    pixel_format = "Mono8"

Names of files are relative to the array file and stay in its folder.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from capture.devices.lines import ActionSettings
from capture.devices.protocol import ActionKeys, TriggerKind
from capture.devices.roster import ExpectedDevice
from capture.documents import key_problems, read_toml
from capture.errors import LikenessError, SettingsError, raise_all
from capture.names import is_plain_name
from capture.recorder import RecordSettings
from capture.settings import settings_from_table

_MOST_SIMULATED = 64
_TABLES = ("array", "action", "record", "device")


@dataclass(frozen=True, kw_only=True)
class ArrayDevice(ExpectedDevice):
    """One device of an array file.

    Attributes:
        preset: file of the settings to write when it is opened; None: it is used as it is.
        width: columns that its frames must have, px; None: whatever it has.
        height: rows, px.
        pixel_format: such as "Mono8".
    """

    preset: Path | None = None
    width: int | None = None
    height: int | None = None
    pixel_format: str | None = None


@dataclass(frozen=True, kw_only=True)
class ArrayFile:
    """What an array file says.

    Attributes:
        name: of the array.
        trigger: what starts an exposure.
        source: the input of a hardware trigger; empty for the device's own choice.
        action: whom action commands are meant for, and how they are sent.
        scheduled: whether action commands are set for a time of the clock that devices share.
        ptp: whether to switch PTP on in every device that has it; else it is left as it is.
        calibration: cameras.json of the array as it stands; None: none is named.
        record: how takes are recorded.
        devices: in the array's order.
        path: the file; None when it was made in memory.
    """

    name: str
    devices: tuple[ArrayDevice, ...]
    trigger: TriggerKind = TriggerKind.HARDWARE
    source: str = ""
    action: ActionSettings = field(default_factory=ActionSettings)
    scheduled: bool = False
    ptp: bool = False
    calibration: Path | None = None
    record: RecordSettings = field(default_factory=RecordSettings)
    path: Path | None = None


@dataclass(frozen=True, kw_only=True)
class _ArrayTable:
    name: str
    trigger: Literal["hardware", "software", "action", "free_run"] = "hardware"
    source: str = ""
    ptp: bool = False
    calibration: str | None = None


@dataclass(frozen=True, kw_only=True)
class _ActionTable:
    device_key: int = ActionKeys.device_key
    group_key: int = ActionKeys.group_key
    group_mask: int = ActionKeys.group_mask
    broadcast: tuple[str, ...] = ()
    ahead_ms: float | None = None
    timeout_ms: float = ActionSettings.timeout_ms

    def __post_init__(self) -> None:
        self.settings()

    def settings(self) -> ActionSettings:
        """As the line wants them; raises when they do not fit."""
        keys = ActionKeys(
            device_key=self.device_key, group_key=self.group_key, group_mask=self.group_mask
        )
        ahead_ms = ActionSettings.ahead_ms if self.ahead_ms is None else self.ahead_ms
        return ActionSettings(
            keys=keys, broadcast=self.broadcast, ahead_ms=ahead_ms, timeout_ms=self.timeout_ms
        )


@dataclass(frozen=True, kw_only=True)
class _DeviceTable:
    name: str
    backend: str
    serial: str = ""
    address: str = ""
    preset: str | None = None
    width: int | None = None
    height: int | None = None
    pixel_format: str | None = None


def read_array_file(path: Path) -> ArrayFile:
    """Read an array file; nothing unknown, types checked, devices unique.

    Raises:
        SettingsError: listing everything that does not fit, with the nearest known key.
    """
    path = Path(path)
    document = read_toml(path, SettingsError, absent="no such array file")
    problems = key_problems(document, ("array", "device"), _TABLES, "array file")
    array = _made(document.get("array", {}), _ArrayTable, "array", ("name",), problems)
    action = _made(document.get("action", {}), _ActionTable, "action", (), problems)
    record = _made(document.get("record", {}), RecordSettings, "record", (), problems)
    devices = _devices(document.get("device", []), path.parent, problems)
    calibration = None
    if array is not None and array.calibration is not None:
        calibration = _inside(path.parent, array.calibration, "array.calibration", problems)
    raise_all(str(path), problems, SettingsError)
    return ArrayFile(
        name=array.name,
        devices=devices,
        trigger=TriggerKind(array.trigger),
        source=array.source,
        action=action.settings(),
        scheduled=action.ahead_ms is not None,
        ptp=array.ptp,
        calibration=calibration,
        record=record,
        path=path,
    )


def simulated_array_file(count: int, *, size_px: int = 256, rate_hz: float = 25.0) -> ArrayFile:
    """An array of simulated devices in real time, to try everything without hardware.

    Args:
        count: of devices.
        size_px: rows and columns of their frames.
        rate_hz: triggers a second.

    Raises:
        SettingsError: when there are none, or more than an array ever had.
    """
    if not 1 <= count <= _MOST_SIMULATED:
        raise SettingsError(f"simulated devices: asked for {count}, offers 1 to {_MOST_SIMULATED}")
    devices = tuple(
        ArrayDevice(
            name=f"cam{number:02d}", backend="sim", address=f"{size_px}x{size_px}?seed={number}"
        )
        for number in range(1, count + 1)
    )
    roll = round(rate_hz / 2)  # half a second before the key and after the end
    record = RecordSettings(rate_hz=rate_hz, pre_roll=roll, post_roll=roll)
    return ArrayFile(name="simulated", devices=devices, ptp=True, record=record)


def _devices(found: Any, folder: Path, problems: list[str]) -> tuple[ArrayDevice, ...]:
    if not isinstance(found, list) or not found:
        problems.append(f"device: expected [[device]] tables, found {found!r}")
        return ()
    devices = []
    for place, table in enumerate(found, start=1):
        where = f"device {place}"
        if isinstance(table, Mapping) and isinstance(table.get("name"), str):
            where = f"device {place} ({table['name']})"
        made = _made(table, _DeviceTable, where, ("name", "backend"), problems)
        if made is not None:
            devices.append(_device(made, where, folder, problems))
    problems += _doubles(devices)
    return tuple(devices)


def _device(table: _DeviceTable, where: str, folder: Path, problems: list[str]) -> ArrayDevice:
    if not is_plain_name(table.name):
        problems.append(
            f"{where}: name must be letters, digits, '-', '_' or '.', found {table.name!r}"
        )
    if not table.serial and not table.address:
        problems.append(f"{where}: has neither serial nor address; `likeness devices` lists both")
    for key in ("width", "height"):
        size = getattr(table, key)
        if size is not None and size < 1:
            problems.append(f"{where}: {key} must be at least 1, found {size}")
    values = {key.name: getattr(table, key.name) for key in dataclasses.fields(table)}
    if table.preset is not None:
        values["preset"] = _inside(folder, table.preset, f"{where}: preset", problems)
    return ArrayDevice(**values)


def _doubles(devices: list[ArrayDevice]) -> list[str]:
    """Names, serials and addresses that two devices share, in words."""
    problems = []
    names = [device.name for device in devices]
    problems += [
        f"name {name!r} is there {names.count(name)} times; names are unique"
        for name in sorted({name for name in names if names.count(name) > 1})
    ]
    for key in ("serial", "address"):
        users: dict[tuple[str, str], list[str]] = {}
        for device in devices:
            if getattr(device, key):
                users.setdefault((device.backend, getattr(device, key)), []).append(device.name)
        problems += [
            f"{key} {value!r} is that of {' and of '.join(those)}; each device has its own"
            for (_, value), those in users.items()
            if len(those) > 1
        ]
    return problems


def _inside(folder: Path, name: str, where: str, problems: list[str]) -> Path:
    """The file of that name in a folder; a problem when it is outside, or not there."""
    path = folder / name
    if not name or "\0" in name:
        problems.append(f"{where}: expected the name of a file, found {name!r}")
    elif not path.resolve().is_relative_to(folder.resolve()):
        problems.append(
            f"{where} = {name!r}: leads out of {folder}; copy the file beside the array file"
        )
    elif not path.is_file():
        problems.append(f"{where} = {name!r}: no such file in {folder}")
    return path


def _made(
    table: Any, kind: type[Any], where: str, required: tuple[str, ...], problems: list[str]
) -> Any:
    """A dataclass made of a table; None, and problems more, when the table does not fit."""
    if not isinstance(table, Mapping):
        problems.append(f"{where}: expected a table, found {table!r}")
        return None
    missing = [f"{where}: missing key {key!r}" for key in required if key not in table]
    problems += missing
    filled = {**dict.fromkeys(required, ""), **table}
    try:
        made = settings_from_table(filled, kind, where)
    except LikenessError as error:
        problems += _lines(error, where)
        return None
    return None if missing else made


def _lines(error: LikenessError, where: str) -> list[str]:
    """The problems that an error lists, each of which names the table, once."""
    first, *rest = str(error).split("\n")
    if rest:
        return [line.removeprefix("  - ") for line in rest]
    short = first.removeprefix(f"{where}: ")
    return [short if short.startswith(where) else first]
