"""Small simulated arrays for tests: pictures that say which device exposed them, and when."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from capture.arrays import Image
from capture.camera import Camera, CameraArray
from capture.devices.array import DeviceArray
from capture.devices.simulated import Fault, SimulatedSettings, simulated_array
from capture.frame_header import FrameHeader
from capture.ledger import Ledger
from capture.recorder import Recording, RecordSettings
from capture.stream import record_frames
from tests.synthetic import small_array


class StampScene:
    """A picture whose pixels hold the time of exposure and the camera's name."""

    def __init__(self) -> None:
        self.rendered: list[tuple[str, int]] = []

    def render(self, camera: Camera, t_ns: int) -> Image:
        self.rendered.append((camera.name, t_ns))
        return stamp(camera, t_ns)


def stamp(camera: Camera, t_ns: int) -> Image:
    """The picture of one camera at one time."""
    text = f"{camera.name} {t_ns}".encode()
    image = np.zeros((camera.height, camera.width), np.uint8)
    image.reshape(-1)[: len(text)] = np.frombuffer(text, np.uint8)
    return image


def cameras(count: int = 4) -> CameraArray:
    """Cameras cam00, cam01, ... of 32 x 8 px."""
    return small_array(count, width=32, height=8)


def array_of(
    count: int = 4,
    seed: int = 0,
    faults: Mapping[str, Sequence[Fault]] | None = None,
    settings: SimulatedSettings | None = None,
) -> DeviceArray:
    """A simulated array that looks at stamps."""
    return simulated_array(
        cameras(count), StampScene(), seed=seed, faults=faults, settings=settings
    )


def record(
    array: DeviceArray, count: int = 20, settings: RecordSettings | None = None
) -> tuple[Recording, dict[tuple[int, str], Image]]:
    """Record and keep the images in memory, by trigger index and device."""
    images: dict[tuple[int, str], Image] = {}

    def sink(device: str, header: FrameHeader, image: Image) -> None:
        assert (header.trigger_index, device) not in images
        images[header.trigger_index, device] = image

    recording = record_frames(array, settings or RecordSettings(), sink, count=count)
    return recording, images


def verdicts(ledger: Ledger, device: str) -> dict[int, str]:
    """The verdicts of one device that are not OK, by trigger index."""
    return {
        entry.trigger_index: str(entry.verdict)
        for entry in ledger.entries
        if entry.device == device and entry.verdict != "ok"
    }


def misplaced(
    recording: Recording, images: Mapping[tuple[int, str], Image], array: CameraArray
) -> list[tuple[int, str]]:
    """Images that were not exposed at the trigger they are filed under."""
    return [
        (k, name)
        for (k, name), image in images.items()
        if not np.array_equal(image, stamp(array.by_name(name), recording.train.time_ns(k)))
    ]
