"""Writing a take: frames go straight to their files, the manifest comes last.

A recording that cannot be repeated is written to `NAME.partial`. It says in opening.json what is
recorded before the first frame comes, and keeps its frames whatever happens; `capture.verify` reads
it back and gives it its name.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any

from capture.arrays import Image
from capture.disk_faults import Disk
from capture.durable import AppendFile, FolderLock, KeptSynced, in_memory, sync_tree
from capture.errors import TakeError, WorkError
from capture.frame_header import FrameHeader, ImageLayout
from capture.ledger import Ledger, write_ledger
from capture.manifest import DeviceEntry, TakeManifest, write_manifest
from capture.mcap import FrameWriter
from capture.opening import OPENING, Opening, write_opening
from capture.product import hash_file
from capture.take import MANIFEST

ROOM = ".room"
"""A file of nothing but room on the disk: for what is written last, when frames have filled it."""
_ROOM_BYTES = 256 << 10
_FRAME_ROOM_BYTES = 256  # a line of the ledger, and one in the index of the file
_FEW_FRAMES = 200  # expected of a device when nobody says
_SPARE = 1.02  # of what is expected must be free before room is taken for all of it


def partial_folder(folder: Path) -> Path:
    """Where a take stands until it has been read back: beside its final place, and to be seen."""
    return folder.with_name(folder.name + ".partial")


class TakeWriter:
    """Fills a take folder; used in a `with` block.

    Frames of different devices may be written from different threads at once, those of one device
    from one thread at a time. An exception in the block abandons what was written: it stays.
    """

    def __init__(
        self,
        folder: Path,
        layouts: Mapping[str, ImageLayout],
        *,
        opening: Mapping[str, Any] | None = None,
        expected_frames: int | None = None,
        disk: Disk | None = None,
    ) -> None:
        """Make the folder and open one file a device.

        Args:
            folder: must not exist.
            layouts: by device name, in the take's order, size and pixel type.
            opening: of a recording, which cannot be repeated, all that is known beforehand: `shot`,
                `take_number`, `settings`, `train`. It is written to opening.json, the folder stays
                locked until the `with` block ends, and frames reach the disk within half a second.
            expected_frames: how many frames each device is to give.
            disk: that frames are written to; this machine's when not given.

        Raises:
            WorkError: when the disk is full or fails.
        """
        self.folder = Path(folder)
        self._layouts = dict(layouts)
        self._places = {name: place for place, name in enumerate(layouts)}
        self._writers: dict[str, FrameWriter] = {}
        self._room: AppendFile | None = None
        self._stack = ExitStack()
        frames = self.folder / "frames"
        self.folder.mkdir(parents=True)
        frames.mkdir()
        try:
            if opening is not None:
                self._open(opening, expected_frames)
            room = self._room_for(expected_frames)
            for name, layout in layouts.items():
                path = frames / f"{name}.mcap"
                self._writers[name] = FrameWriter(
                    path, name, layout, reserve_frames=room, disk=disk
                )
            if opening is not None:
                sync_tree(self.folder)
                self._stack.enter_context(KeptSynced([w.sync for w in self._writers.values()]))
        except BaseException:
            self.abandon()
            shutil.rmtree(self.folder)  # no frame is in it yet
            raise

    def __enter__(self) -> TakeWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.abandon()

    def write(
        self, device: str, header: FrameHeader, image: Image, pixel_crc: int | None = None
    ) -> None:
        """Append a frame to its device's file.

        Args:
            device: its name.
            header: what is known of the frame; device index and CRC are filled in.
            image: the pixels; they are not needed any more when this returns.
            pixel_crc: `capture.frame_header.pixel_crc` of the pixels, when another thread has it.

        Raises:
            TakeError: when there is no such device, or its frames have another layout.
            WorkError: when the disk is full or fails; the frames before this one are whole, and
                `finish` still makes a take of them.
        """
        if device not in self._writers:
            raise TakeError(f"{self.folder}: no device {device!r}")
        header = replace(header, device_index=self._places[device])
        self._writers[device].write(header, image, pixel_crc)

    def finish(
        self,
        describe: Callable[[tuple[DeviceEntry, ...]], TakeManifest],
        *,
        ledger: Ledger | None = None,
        hashed: bool = True,
    ) -> TakeManifest:
        """Close the files, write the ledger, and then the manifest.

        Args:
            describe: makes the manifest of the devices.
            ledger: of the take; None when somebody else writes it.
            hashed: whether to hash the files now, which reads them again. A take that is read back
                by `capture.verify` gets its hashes there.

        Raises:
            WorkError: listing the files that could not be closed; all frames stay where they are,
                and `likeness recover` makes a take of them.
        """
        self._give_up_room()
        self._close()
        devices = tuple(
            DeviceEntry(
                name=name,
                layout=layout,
                frames=len(self._writers[name]),
                sha256=hash_file(self.folder / "frames" / f"{name}.mcap") if hashed else "",
            )
            for name, layout in self._layouts.items()
        )
        manifest = describe(devices)
        try:
            if ledger is not None:
                write_ledger(self.folder / "ledger.csv", ledger)
            sync_tree(self.folder)  # a manifest on the disk says that all else is there
            write_manifest(self.folder / MANIFEST, manifest)
        except OSError as error:
            raise WorkError(f"{self.folder}: cannot be finished: {error.strerror}") from error
        return manifest

    def abandon(self) -> None:
        """Close all files as they are, and unlock the folder; after `finish` it only unlocks."""
        for writer in self._writers.values():
            writer.abandon()
        self._stack.close()

    def _open(self, opening: Mapping[str, Any], expected_frames: int | None) -> None:
        if not self._stack.enter_context(FolderLock(self.folder)).held:
            raise WorkError(f"{self.folder}: locked by another process, `likeness recover` perhaps")
        known = Opening(
            name=self.folder.name.removesuffix(".partial"),
            devices=self._layouts,
            expected_frames=expected_frames,
            recording=opening,
        )
        write_opening(self.folder / OPENING, known)
        self._room = AppendFile(self.folder / ROOM)
        self._stack.callback(self._give_up_room)
        frames = (expected_frames or _FEW_FRAMES) * len(self._layouts)
        if not self._room.reserve(_ROOM_BYTES + frames * _FRAME_ROOM_BYTES):
            raise WorkError(f"{self.folder}: the disk is full: no room even to close a take")

    def _give_up_room(self) -> None:
        if self._room is not None:
            self._room.close()
            self._room.path.unlink(missing_ok=True)
            self._room = None

    def _room_for(self, expected_frames: int | None) -> int:
        """How many frames to take room for now: all if the disk has it, else none beforehand."""
        # Room in memory is filled with zeros, which takes as long as writing the frames.
        if expected_frames is None or in_memory(self.folder):
            return 0
        size = expected_frames * sum(layout.nbytes for layout in self._layouts.values())
        free = shutil.disk_usage(self.folder).free
        # Not all of it for the first devices and nothing for the last ones.
        return expected_frames if size * _SPARE < free else 0

    def _close(self) -> None:
        problems = []
        for writer in self._writers.values():
            try:
                writer.close()
            except WorkError as error:
                problems.append(str(error))
        if problems:
            raise WorkError("; ".join(problems))
