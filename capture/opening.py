"""opening.json: what is being recorded, written before the first frame, for `likeness recover`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from capture.documents import is_whole, read_document, write_json
from capture.errors import LikenessError, TakeError, raise_all
from capture.frame_header import ImageLayout
from capture.names import is_plain_name

OPENING = "opening.json"
_FORMAT = "likeness-opening"
_VERSION = 1


@dataclass(frozen=True, kw_only=True)
class Opening:
    """All that opening.json says.

    Attributes:
        name: the take's name.
        devices: by name, in the take's order, size and pixel type of their frames.
        expected_frames: how many frames each device is to give; None when nobody knows.
        recording: what the recorder wants kept; `likeness recover` uses `shot`, `take_number`,
            `settings` and `train` (`start_ns`, `period_ns`) where they are there.
    """

    name: str
    devices: Mapping[str, ImageLayout]
    expected_frames: int | None = None
    recording: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        problems = [
            f"device name must be letters, digits, '-', '_' or '.', found {name!r}"
            for name in self.devices
            if not is_plain_name(name)
        ]
        if not self.devices:
            problems.append("a take needs at least one device")
        raise_all("opening", problems, TakeError)


def write_opening(path: Path, opening: Opening) -> None:
    """Write opening.json, whole or not at all, and wait until the disk holds it."""
    document = {
        "format": _FORMAT,
        "version": _VERSION,
        "name": opening.name,
        "expected_frames": opening.expected_frames,
        "devices": [
            {
                "name": name,
                "width": layout.width,
                "height": layout.height,
                "channels": layout.channels,
                "dtype": layout.dtype,
            }
            for name, layout in opening.devices.items()
        ],
        "recording": dict(opening.recording),
    }
    write_json(path, document)


def read_opening(path: Path) -> Opening:
    """Read opening.json.

    Raises:
        TakeError: naming the file, when it is missing, damaged or of a newer version.
    """
    document = read_document(path, _FORMAT, _VERSION, TakeError)
    try:
        expected = document["expected_frames"]
        return Opening(
            name=str(document["name"]),
            devices={str(entry["name"]): _layout(entry) for entry in document["devices"]},
            expected_frames=None if expected is None else _whole(expected, "expected_frames"),
            recording=dict(document["recording"]),
        )
    except KeyError as error:
        raise TakeError(f"{path}: missing key {error}") from error
    except (TypeError, ValueError, AttributeError, LikenessError) as error:
        raise TakeError(f"{path}: damaged: {error}") from error


def _layout(entry: Mapping[str, Any]) -> ImageLayout:
    width, height, channels = (_whole(entry[key], key) for key in ("width", "height", "channels"))
    return ImageLayout(width, height, channels, entry["dtype"])


def _whole(value: object, key: str) -> int:
    if not is_whole(value):
        raise TakeError(f"{key} must be a whole number, found {value!r}")
    return value
