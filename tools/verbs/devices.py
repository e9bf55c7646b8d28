"""List the devices that are found, hold them against an array file, read or write their settings.

Example: likeness devices --array array.toml
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from capture.array_file import ArrayFile, read_array_file
from capture.devices.backend import FoundDevice, load_backend
from capture.devices.capabilities import Featured
from capture.devices.preset import apply_preset, read_preset
from capture.devices.protocol import Device
from capture.devices.roster import Finding, Sighting, all_there, compare, look
from capture.documents import write_json
from capture.errors import DeviceError, InputError, WorkError
from capture.product import replacing
from capture.progress import Progress
from tools.verbs.options import Options

_SIM = "sim"


@dataclass(frozen=True, kw_only=True)
class Arguments(Options):
    """Options of `likeness devices`."""

    array: Path | None = None
    """An array file whose roster is compared with what is found."""
    backend: tuple[str, ...] = ()
    """Backends to ask; all that are installed when not given."""
    features: str | None = None
    """A device, by name in the array file, serial or address: its settings go to --out."""
    out: Path | None = None
    """The JSON file to write settings to; the device's own description stands beside it as .xml."""
    preset: Path | None = None
    """A preset file to write to --device and read back."""
    device: str | None = None
    """The device of --preset, by name in the array file, serial or address."""


def run(arguments: Arguments, progress: Progress) -> dict[str, Any]:
    """Look, and do what is asked for.

    Raises:
        InputError: when options that belong together are not all there.
        WorkError: when a setting does not read back as it was written.
    """
    _check(arguments)
    array = None if arguments.array is None else read_array_file(arguments.array)
    backends = arguments.backend or None
    listed = () if array is None else array.devices
    for name in dict.fromkeys(entry.backend for entry in listed):
        load_backend(name)  # a slip in the array file is no device that is missing
    progress(0, 1, "look for devices")
    sighting = look(backends)
    progress(1, 1, "look for devices")
    if arguments.features is not None and arguments.out is not None:
        with _opened(arguments.features, array, sighting) as device:
            return _dump(device, arguments.out)
    if arguments.preset is not None and arguments.device is not None:
        with _opened(arguments.device, array, sighting) as device:
            return _write_preset(device, arguments.preset)
    findings = () if array is None else compare(array.devices, sighting)
    if arguments.json:
        return _document(sighting, findings, array)
    return _text(sighting, findings, array, everything=backends is not None)


def _check(arguments: Arguments) -> None:
    if (arguments.features is None) != (arguments.out is None):
        raise InputError("--features DEVICE and --out FILE belong together")
    if (arguments.preset is None) != (arguments.device is None):
        raise InputError("--preset FILE and --device DEVICE belong together")
    if arguments.features is not None and arguments.preset is not None:
        raise InputError("--features and --preset are two pieces of work; run it twice")


@contextmanager
def _opened(asked: str, array: ArrayFile | None, sighting: Sighting) -> Iterator[Device]:
    """A device by its name in the array file, serial or address."""
    if array is not None and any(entry.name == asked for entry in array.devices):
        entry = next(entry for entry in array.devices if entry.name == asked)
        backend, address, name = entry.backend, entry.known_as, entry.name
    else:
        matching = [found for found in sighting.found if asked in (found.serial, found.address)]
        if not matching:
            raise InputError(_unknown(asked, sighting))
        backend, address, name = matching[0].backend, matching[0].address, "device"
    device = load_backend(backend).open(address, name)
    try:
        yield device
    finally:
        device.close()


def _unknown(asked: str, sighting: Sighting) -> str:
    there = ", ".join(f"{found.serial} at {found.address}" for found in sighting.found)
    why = "".join(f"; backend {name}: {reason}" for name, reason in sighting.unseen.items())
    return f"no device {asked!r}; found: {there or 'none'}{why}"


def _featured(device: Device) -> Featured:
    if not isinstance(device, Featured):
        raise DeviceError(f"{device.info.model} {device.info.serial}: has no named settings")
    return device


def _dump(device: Device, out: Path) -> dict[str, Any]:
    dump = _featured(device).features()
    info = device.info
    document = {
        "serial": info.serial,
        "model": info.model,
        "address": info.address,
        "layout": dataclasses.asdict(info.layout),
        "description_sha256": dump.description_sha256,
        "values": dict(dump.values),
        "unread": dict(dump.unread),
    }
    write_json(out, document)
    report: dict[str, Any] = {
        "features": str(out), "read": len(dump.values), "unread": len(dump.unread),
    }  # fmt: skip
    if dump.description:
        beside = out.with_suffix(".xml")
        with replacing(beside) as partial:
            partial.write_text(dump.description, encoding="utf-8")
        report["description"] = str(beside)
    return report


def _write_preset(device: Device, path: Path) -> dict[str, Any]:
    preset = read_preset(path)
    differences = apply_preset(_featured(device), preset)
    wrong = [difference for difference in differences if not difference.slight]
    if wrong:
        lines = "\n".join(f"  - {difference}" for difference in wrong)
        raise WorkError(
            f"{device.info.serial}: {len(wrong)} setting(s) of {path} do not read back as "
            f"asked\n{lines}"
        )
    info = device.info
    return {
        "device": info.serial, "preset": preset.name, "written": len(preset.writes),
        "layout": f"{info.layout.width} x {info.layout.height} px, {info.layout.dtype}",
        "rounded": "; ".join(str(one) for one in differences) or "none",
    }  # fmt: skip


def _document(
    sighting: Sighting, findings: Sequence[Finding], array: ArrayFile | None
) -> dict[str, Any]:
    report: dict[str, Any] = {
        "devices": [dataclasses.asdict(found) for found in sighting.found],
        "not_installed": dict(sighting.absent),
        "failed": dict(sighting.failed),
    }
    if array is not None:
        report |= {
            "array": array.name,
            "complete": all_there(findings),
            "roster": [
                {
                    "name": finding.name, "kind": str(finding.kind), "sentence": finding.sentence,
                    "remedy": finding.remedy,
                }
                for finding in findings
            ],
        }  # fmt: skip
    return report


def _text(
    sighting: Sighting, findings: Sequence[Finding], array: ArrayFile | None, *, everything: bool
) -> dict[str, Any]:
    # Sixteen simulated devices are always there: they would bury the real ones.
    shown = [found for found in sighting.found if everything or found.backend != _SIM]
    report: dict[str, Any] = {"devices": _table(shown)}
    if hidden := len(sighting.found) - len(shown):
        report[f"backend {_SIM}"] = f"{hidden} simulated devices; --backend {_SIM} lists them"
    report |= {f"backend {name}": f"not installed: {why}" for name, why in sighting.absent.items()}
    report |= {f"backend {name}": f"failed: {why}" for name, why in sighting.failed.items()}
    if array is not None:
        there = sum(finding.found is not None for finding in findings[: len(array.devices)])
        report[f"array {array.name}"] = f"{there} of {len(array.devices)} devices are there"
        report["roster"] = "".join(f"\n  {finding.kind:<9}{finding}" for finding in findings)
    return report


def _table(found: Sequence[FoundDevice]) -> str:
    """The devices in aligned columns, what may be wrong with one under it."""
    if not found:
        return "none found"
    heads = ("backend", "address", "serial", "model", "link")
    rows = [(f.backend, f.address, f.serial, f.model, _link(f)) for f in found]
    widths = [max(len(row[at]) for row in (heads, *rows)) for at in range(len(heads))]
    lines = [f"{len(found)} found", _row(heads, widths)]
    for device, row in zip(found, rows, strict=True):
        lines.append(_row(row, widths))
        lines += [f"    ! {problem}" for problem in device.problems]
    return "\n".join(lines)


def _row(cells: Sequence[str], widths: Sequence[int]) -> str:
    return "  " + "  ".join(f"{c:<{w}}" for c, w in zip(cells, widths, strict=True)).rstrip()


def _link(found: FoundDevice) -> str:
    speed = "" if found.link_mbps is None else f", {found.link_mbps:g} Mbit/s"
    return found.transport + speed
