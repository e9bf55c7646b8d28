"""`Take`: the frames of one recording on disk, with its cameras.

::

    TAKE/take.json              manifest: format version, devices, frame count, hashes
    TAKE/frames/<device>.mcap   lossless frames, one file a device
    TAKE/ledger.csv             one verdict for every (trigger index, device)
    TAKE/cameras.json           once calibrated
    TAKE/neutral.obj            optional: the actor's neutral in the tracking topology
    TAKE/products/              what the stages made
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from capture.arrays import Image
from capture.camera import CameraArray
from capture.camera_file import read_cameras, write_cameras
from capture.errors import CameraError, TakeError, raise_all
from capture.frame import Frame, FrameSet
from capture.ledger import Ledger, read_ledger
from capture.manifest import DeviceEntry, TakeManifest, read_manifest
from capture.mcap import FrameReader
from capture.product import hash_file

MANIFEST = "take.json"


@dataclass(frozen=True, eq=False)
class Take:
    """One recording on disk. Open it with `Take.open`.

    Attributes:
        folder: where it stands.
        manifest: what take.json says.
    """

    folder: Path
    manifest: TakeManifest
    _readers: dict[str, tuple[FrameReader, dict[int, int]]] = field(
        default_factory=dict, repr=False
    )

    @classmethod
    def open(cls, folder: Path) -> Take:
        """Open a take folder; only its manifest is read.

        Raises:
            TakeError: when the folder is not a take, a file of it is missing, the manifest is
                damaged or of a newer format; the message says what to do.
        """
        folder = Path(folder)
        path = folder / MANIFEST
        if not path.is_file():
            raise TakeError(_not_a_take(folder))
        manifest = read_manifest(path)
        missing = [
            f"frames/{device.name}.mcap is missing"
            for device in manifest.devices
            if not (folder / "frames" / f"{device.name}.mcap").is_file()
        ]
        raise_all(str(folder), missing, TakeError)
        return cls(folder, manifest)

    @property
    def name(self) -> str:
        """The take's name."""
        return self.manifest.name

    @property
    def device_names(self) -> tuple[str, ...]:
        """Names of the devices, in the take's order."""
        return tuple(device.name for device in self.manifest.devices)

    @property
    def frames(self) -> tuple[int, ...]:
        """Frame numbers: trigger indices from 0."""
        return tuple(range(self.manifest.frame_count))

    @property
    def products(self) -> Path:
        """The folder of the stages' products."""
        return self.folder / "products"

    def size(self, device: str) -> tuple[int, int]:
        """(width, height) of a device's frames, px."""
        layout = self._entry(device).layout
        return layout.width, layout.height

    def present(self, device: str, frame: int) -> bool:
        """Whether the device's frame of that number is on disk."""
        return frame in self._reader(device)[1]

    def image(self, device: str, frame: int) -> Image:
        """Read one image, its CRC checked.

        Args:
            device: the device's name.
            frame: the frame number.

        Returns:
            (H, W) mono or (H, W, 3) RGB, uint8 or uint16.

        Raises:
            TakeError: when that frame was lost, is not of this take, or is damaged.
        """
        reader, places = self._reader(device)
        return reader.read(self._place(device, frame, places))

    def frame(self, device: str, frame: int) -> Frame:
        """Read one image with its header; raises as `image` does."""
        reader, places = self._reader(device)
        place = self._place(device, frame, places)
        return Frame(device, reader.headers[place], reader.read(place))

    def frame_set(self, frame: int) -> FrameSet:
        """Read what all devices saw at one trigger; lost frames are named in `missing`."""
        self._check_number(frame)
        there = [name for name in self.device_names if self.present(name, frame)]
        missing = tuple(name for name in self.device_names if name not in there)
        return FrameSet(frame, {name: self.frame(name, frame) for name in there}, missing)

    @property
    def has_cameras(self) -> bool:
        """Whether the take holds a cameras.json."""
        return (self.folder / "cameras.json").is_file()

    def cameras(self) -> CameraArray:
        """The calibrated camera of each device, in the take's order.

        Raises:
            CameraError: when there is no cameras.json, or it lacks a device or has another size.
        """
        path = self.folder / "cameras.json"
        if not self.has_cameras:
            raise CameraError(
                f"{self.folder}: this take has no cameras.json; calibrate a board take of "
                "the same array with "
                f"`likeness calibrate BOARD_TAKE --board BOARD.toml --out {path}`"
            )
        array = read_cameras(path)
        self._check_cameras(array, str(path))
        return CameraArray(tuple(array.by_name(name) for name in self.device_names))

    def set_cameras(self, cameras: CameraArray, report: Mapping[str, Any] | None = None) -> None:
        """Write the take's cameras.json; cameras of devices that the take lacks are kept in it.

        Args:
            cameras: at least one camera for each device, of the right size.
            report: what the calibration says of itself.

        Raises:
            CameraError: listing devices without a camera and sizes that differ.
        """
        self._check_cameras(cameras, f"cameras for {self.folder}")
        write_cameras(self.folder / "cameras.json", cameras, report)

    def neutral(self) -> Path:
        """The path of the actor's neutral, an OBJ in the tracking topology.

        Raises:
            TakeError: when the take has none.
        """
        path = self.folder / "neutral.obj"
        if not path.is_file():
            raise TakeError(
                f"{self.folder}: this take has no neutral.obj; make one with "
                f"`likeness neutral {self.folder} --template MESH.obj --out {path}`"
            )
        return path

    def ledger(self) -> Ledger:
        """The verdict of every (trigger index, device) pair."""
        return read_ledger(self.folder / "ledger.csv")

    def frames_hash(self) -> str:
        """A hash of all frames, from the manifest: it does not read them."""
        digest = hashlib.sha256()
        for device in self.manifest.devices:
            digest.update(f"{device.name} {device.sha256}\n".encode())
        return digest.hexdigest()

    def input_hash(self) -> str:
        """A hash of all frames and of the cameras, cheap to get."""
        cameras = hash_file(self.folder / "cameras.json") if self.has_cameras else "none"
        return hashlib.sha256(f"{self.frames_hash()} {cameras}".encode()).hexdigest()

    def reader(self, device: str) -> FrameReader:
        """The reader of a device's file, for whoever wants headers or damaged files."""
        return self._reader(device)[0]

    def _reader(self, device: str) -> tuple[FrameReader, dict[int, int]]:
        entry = self._entry(device)
        if device not in self._readers:
            reader = FrameReader(self.folder / "frames" / f"{device}.mcap")
            if reader.layout != entry.layout:
                raise TakeError(
                    f"{reader.path}: holds frames of {reader.layout}, take.json says {entry.layout}"
                )
            places = {
                header.trigger_index: place
                for place, header in enumerate(reader.headers)
                if header.status == 0
            }
            self._readers[device] = (reader, places)
        return self._readers[device]

    def _entry(self, device: str) -> DeviceEntry:
        for entry in self.manifest.devices:
            if entry.name == device:
                return entry
        raise TakeError(
            f"{self.folder}: no device {device!r}; it has {', '.join(self.device_names)}"
        )

    def _place(self, device: str, frame: int, places: Mapping[int, int]) -> int:
        self._check_number(frame)
        if frame not in places:
            raise TakeError(
                f"{self.folder}: frame {frame} of {device} was lost; "
                f"{self.folder / 'ledger.csv'} says how"
            )
        return places[frame]

    def _check_number(self, frame: int) -> None:
        if not 0 <= frame < self.manifest.frame_count:
            raise TakeError(
                f"{self.folder}: no frame {frame}; "
                f"it has frames 0 to {self.manifest.frame_count - 1}"
            )

    def _check_cameras(self, cameras: CameraArray, where: str) -> None:
        problems = []
        for entry in self.manifest.devices:
            if entry.name not in cameras.names:
                problems.append(
                    f"no camera for device {entry.name}; it has {', '.join(cameras.names)}"
                )
                continue
            camera = cameras.by_name(entry.name)
            if (camera.width, camera.height) != (entry.layout.width, entry.layout.height):
                problems.append(
                    f"{entry.name}: camera of {camera.width} x {camera.height} px, "
                    f"frames of {entry.layout.width} x {entry.layout.height} px"
                )
        raise_all(where, problems, CameraError)


def _not_a_take(folder: Path) -> str:
    if not folder.exists():
        return f"{folder}: no such folder; a take is a folder with {MANIFEST}"
    if not folder.is_dir():
        return f"{folder}: expected a take, which is a folder with {MANIFEST}; found a file"
    if (folder / "session.json").is_file():
        return f"{folder}: this is a session; its takes stand in {folder / 'takes'}"
    visiting = (folder / "cameras.json").is_file() or any(folder.glob("*/*.png"))
    hint = f"; to bring it in run `likeness import {folder} --out TAKE`" if visiting else ""
    return f"{folder}: expected a take, found no {MANIFEST}{hint}"
