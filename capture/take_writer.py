"""Writing a take: frames go straight to their files, the manifest comes last."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType

from capture.arrays import Image
from capture.errors import TakeError
from capture.frame_header import FrameHeader, ImageLayout
from capture.manifest import DeviceEntry, TakeManifest, write_manifest
from capture.mcap import FrameWriter
from capture.product import hash_file
from capture.take import MANIFEST


class TakeWriter:
    """Fills a take folder; used in a `with` block inside `capture.product.replacing`.

    One frame is in memory at a time. `finish` closes the files and writes the manifest.
    """

    def __init__(self, folder: Path, layouts: Mapping[str, ImageLayout]) -> None:
        """Make the folder and open one file a device.

        Args:
            folder: must not exist.
            layouts: by device name, in the take's order, size and pixel type.
        """
        self.folder = Path(folder)
        self._layouts = dict(layouts)
        self._places = {name: place for place, name in enumerate(layouts)}
        self._counts = dict.fromkeys(layouts, 0)
        frames = self.folder / "frames"
        frames.mkdir(parents=True)
        with ExitStack() as stack:
            self._writers = {
                name: stack.enter_context(FrameWriter(frames / f"{name}.mcap", name, layout))
                for name, layout in layouts.items()
            }
            self._stack = stack.pop_all()

    def __enter__(self) -> TakeWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    def write(self, device: str, header: FrameHeader, image: Image) -> None:
        """Append a frame to its device's file; the header's device index is filled in."""
        if device not in self._writers:
            raise TakeError(f"{self.folder}: no device {device!r}")
        header = FrameHeader(
            header.trigger_index, self._places[device], header.frame_id, header.t_dev_ns,
            header.t_host_ns, header.exposure_us, header.status,
        )  # fmt: skip
        self._writers[device].write(header, image)
        self._counts[device] += 1

    def finish(self, describe: Callable[[tuple[DeviceEntry, ...]], TakeManifest]) -> TakeManifest:
        """Close and hash the files, and write the manifest that `describe` makes of the devices."""
        self._stack.close()
        devices = tuple(
            DeviceEntry(
                name=name,
                layout=layout,
                frames=self._counts[name],
                sha256=hash_file(self.folder / "frames" / f"{name}.mcap"),
            )
            for name, layout in self._layouts.items()
        )
        manifest = describe(devices)
        write_manifest(self.folder / MANIFEST, manifest)
        return manifest
