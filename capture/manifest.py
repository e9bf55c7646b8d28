"""take.json: what a take holds, with a format version and a hash of every file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from capture.documents import is_whole, read_document, write_json
from capture.errors import LikenessError, TakeError, raise_all
from capture.frame_header import ImageLayout
from capture.names import is_plain_name

FORMAT = "likeness-take"
VERSION = 1
_KINDS = ("import", "capture")
_MOST_FRAMES = 10_000_000  # 28 hours at 100 frames/s


@dataclass(frozen=True, kw_only=True)
class DeviceEntry:
    """One device of a take.

    Attributes:
        name: unique, safe as a file name.
        layout: size and pixel type of its frames.
        frames: how many frames its file holds.
        sha256: of its file, hex.
    """

    name: str
    layout: ImageLayout
    frames: int
    sha256: str


@dataclass(frozen=True, kw_only=True)
class TakeManifest:
    """All that take.json says.

    Attributes:
        name: the take's name.
        kind: "import" or "capture".
        devices: in their fixed order.
        frame_count: trigger indices 0..frame_count-1 belong to the take.
        period_ns: time from trigger to trigger; None when it is not known.
        start_ns: time of trigger 0; None when it is not known.
        remarks: whatever else the maker wants kept: shot, settings, verdict, source.
    """

    name: str
    kind: str
    devices: tuple[DeviceEntry, ...]
    frame_count: int
    period_ns: int | None = None
    start_ns: int | None = None
    remarks: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        problems = []
        if self.kind not in _KINDS:
            problems.append(f"kind must be one of {', '.join(_KINDS)}, found {self.kind!r}")
        if not self.devices:
            problems.append("a take needs at least one device")
        if not 1 <= self.frame_count <= _MOST_FRAMES:
            problems.append(
                f"a take needs 1 to {_MOST_FRAMES} frames, found frame_count {self.frame_count}"
            )
        names = [device.name for device in self.devices]
        problems += [
            f"device name must be letters, digits, '-', '_' or '.', found {name!r}"
            for name in names
            if not is_plain_name(name)
        ]
        problems += [
            f"device {name!r} stands there twice"
            for name in sorted(set(names))
            if names.count(name) > 1
        ]
        raise_all("manifest", problems, TakeError)


def read_manifest(path: Path) -> TakeManifest:
    """Read take.json.

    Raises:
        TakeError: naming the file, when it is damaged or was written by a newer version.
    """
    document = read_document(path, FORMAT, VERSION, TakeError)
    try:
        return _manifest(document)
    except KeyError as error:
        raise TakeError(f"{path}: damaged manifest: missing key {error}") from error
    except (TypeError, ValueError, AttributeError, LikenessError) as error:
        raise TakeError(f"{path}: damaged manifest: {error}") from error


def write_manifest(path: Path, manifest: TakeManifest) -> None:
    """Write take.json, whole or not at all, and wait until the disk holds it.

    Raises:
        WorkError: naming the file, when the disk does not take it; the old file stays.
    """
    document = {
        "format": FORMAT,
        "version": VERSION,
        "name": manifest.name,
        "kind": manifest.kind,
        "frame_count": manifest.frame_count,
        "period_ns": manifest.period_ns,
        "start_ns": manifest.start_ns,
        "devices": [
            {
                "name": device.name,
                "width": device.layout.width,
                "height": device.layout.height,
                "channels": device.layout.channels,
                "dtype": device.layout.dtype,
                "frames": device.frames,
                "sha256": device.sha256,
            }
            for device in manifest.devices
        ],
        "remarks": dict(manifest.remarks),
    }
    write_json(path, document)


def _manifest(document: Mapping[str, Any]) -> TakeManifest:
    if not isinstance(document["devices"], list):
        raise TakeError("devices must be a list")
    return TakeManifest(
        name=str(document["name"]),
        kind=document["kind"],
        devices=tuple(_device(entry) for entry in document["devices"]),
        frame_count=_whole(document, "frame_count"),
        period_ns=_whole(document, "period_ns") if document["period_ns"] is not None else None,
        start_ns=_whole(document, "start_ns") if document["start_ns"] is not None else None,
        remarks=dict(document.get("remarks", {})),
    )


def _device(entry: Mapping[str, Any]) -> DeviceEntry:
    layout = ImageLayout(
        _whole(entry, "width"), _whole(entry, "height"), _whole(entry, "channels"), entry["dtype"]
    )
    return DeviceEntry(
        name=entry["name"],
        layout=layout,
        frames=_whole(entry, "frames"),
        sha256=str(entry["sha256"]),
    )


def _whole(entry: Mapping[str, Any], key: str) -> int:
    value = entry[key]
    if not is_whole(value):
        raise TakeError(f"{key} must be a whole number, found {value!r}")
    return value
