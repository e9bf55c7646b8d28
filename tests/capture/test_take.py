"""Takes: what they give, and what they say when a file of theirs does not fit."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from capture.camera import CameraArray
from capture.errors import CameraError, TakeError
from capture.frame_header import FrameHeader, ImageLayout
from capture.manifest import TakeManifest, read_manifest
from capture.mcap import FrameReader
from capture.take import Take
from capture.take_writer import TakeWriter
from tests.capture.refusals import refusal
from tests.synthetic import small_array

LAYOUT = ImageLayout(64, 48, 1, "uint8")
NAMES = ("cam00", "cam01", "cam02")


def image(place: int, frame: int) -> np.ndarray:
    rng = np.random.default_rng((place, frame))
    return rng.integers(0, 256, LAYOUT.shape, dtype=np.uint8)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A take of 3 devices and 4 frames, frame 2 of cam01 lost."""
    with TakeWriter(tmp_path / "take", dict.fromkeys(NAMES, LAYOUT)) as writer:
        for frame in range(4):
            for place, name in enumerate(NAMES):
                if (frame, name) != (2, "cam01"):
                    writer.write(name, FrameHeader(frame), image(place, frame))
        writer.finish(
            lambda devices: TakeManifest(name="t", kind="capture", devices=devices, frame_count=4)
        )
    return tmp_path / "take"


def test_a_take_gives_what_was_written(folder: Path) -> None:
    take = Take.open(folder)
    assert (take.name, take.device_names, take.frames) == ("t", NAMES, (0, 1, 2, 3))
    assert take.size("cam02") == (64, 48)
    assert take.products == folder / "products"
    assert np.array_equal(take.image("cam02", 3), image(2, 3))
    frame = take.frame("cam02", 3)
    assert (frame.device, frame.header.device_index, frame.header.trigger_index) == ("cam02", 2, 3)


def test_a_lost_frame_is_absent_and_never_another_image(folder: Path) -> None:
    take = Take.open(folder)
    assert [take.present("cam01", k) for k in take.frames] == [True, True, False, True]
    with pytest.raises(TakeError, match=r"frame 2 of cam01 was lost; .*ledger\.csv says how"):
        take.image("cam01", 2)
    frame_set = take.frame_set(2)
    assert frame_set.missing == ("cam01",)
    assert not frame_set.complete
    assert list(frame_set.frames) == ["cam00", "cam02"]
    assert np.array_equal(frame_set.image("cam02"), image(2, 2))
    with pytest.raises(TakeError, match="frame set 2: no frame of 'cam01'; it has cam00, cam02"):
        frame_set.image("cam01")


def test_what_is_not_there_is_named(folder: Path) -> None:
    take = Take.open(folder)
    with pytest.raises(TakeError, match="no device 'cam07'; it has cam00, cam01, cam02"):
        take.image("cam07", 0)
    for frame in (4, -1):
        with pytest.raises(TakeError, match=f"no frame {frame}; it has frames 0 to 3"):
            take.image("cam00", frame)
    with pytest.raises(TakeError, match=r"has no neutral\.obj; make one with `likeness neutral"):
        take.neutral()


def test_cameras_are_kept_and_checked(folder: Path) -> None:
    take = Take.open(folder)
    before = take.input_hash()
    with pytest.raises(CameraError, match=r"has no cameras\.json; calibrate a board take"):
        take.cameras()
    array = small_array(4)  # the array has one camera that this take lacks
    take.set_cameras(CameraArray(tuple(reversed(array.cameras))), report={"mean_error_px": 0.05})
    assert take.cameras().names == NAMES
    assert np.array_equal(take.cameras()[1].matrix, array[1].matrix)
    assert take.input_hash() != before
    with pytest.raises(CameraError, match="no camera for device cam02; it has cam00, cam01"):
        take.set_cameras(small_array(2))
    with pytest.raises(CameraError, match="cam00: camera of 32 x 48 px, frames of 64 x 48 px"):
        take.set_cameras(small_array(3, width=32))
    assert take.cameras().names == NAMES


def test_the_input_hash_follows_the_frames(folder: Path) -> None:
    take = Take.open(folder)
    assert take.input_hash() == Take.open(folder).input_hash()
    document = json.loads((folder / "take.json").read_text())
    document["devices"][0]["sha256"] = "0" * 64
    (folder / "take.json").write_text(json.dumps(document))
    assert Take.open(folder).input_hash() != take.input_hash()


def test_what_is_no_take_says_what_to_run(tmp_path: Path) -> None:
    with pytest.raises(TakeError, match="no such folder"):
        Take.open(tmp_path / "nowhere")
    (tmp_path / "file").write_text("x")
    with pytest.raises(TakeError, match="found a file"):
        Take.open(tmp_path / "file")
    (tmp_path / "visit" / "cam00").mkdir(parents=True)
    (tmp_path / "visit" / "cam00" / "0000.png").write_text("x")
    with pytest.raises(TakeError, match=r"found no take\.json; .* run `likeness import .*visit"):
        Take.open(tmp_path / "visit")
    (tmp_path / "session").mkdir()
    (tmp_path / "session" / "session.json").write_text("{}")
    with pytest.raises(TakeError, match="this is a session; its takes stand in"):
        Take.open(tmp_path / "session")


def test_a_missing_file_is_named(folder: Path) -> None:
    (folder / "frames" / "cam01.mcap").unlink()
    (folder / "frames" / "cam02.mcap").unlink()
    with pytest.raises(
        TakeError, match=r"2 problems\n.*cam01.mcap is missing\n.*cam02.mcap is mis"
    ):
        Take.open(folder)


def test_a_file_of_another_layout_is_refused(folder: Path) -> None:
    document = json.loads((folder / "take.json").read_text())
    document["devices"][0]["width"] = 32
    (folder / "take.json").write_text(json.dumps(document))
    with pytest.raises(TakeError, match=r"holds frames of 64 x 48 mono uint8, take.json says 32 x"):
        Take.open(folder).image("cam00", 0)


def put(key: str, value: Any) -> Callable[[Any], None]:
    return lambda document: document.update({key: value})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (put("version", 2), "written in format version 2, this program reads up to 1; update"),
        (put("format", "other"), 'expected "format": "likeness-take"'),
        (put("version", "1"), "version must be a whole number, found '1'"),
        (put("devices", []), "needs at least one device"),
        (put("devices", {}), "devices must be a list"),
        (put("devices", [3]), "damaged manifest"),
        (put("frame_count", 0), "needs 1 to 10000000 frames, found frame_count 0"),
        (put("frame_count", 1.5), "frame_count must be a whole number, found 1.5"),
        (put("kind", "film"), "kind must be one of import, capture, found 'film'"),
        (lambda d: d.pop("frame_count"), "missing key 'frame_count'"),
        (lambda d: d["devices"][0].update(name="../../etc"), "device name must be letters"),
        (lambda d: d["devices"][0].update(name="cam01"), "device 'cam01' stands there twice"),
        (lambda d: d["devices"][0].update(dtype="float64"), "pixel type must be uint8 or uint16"),
    ],
)
def test_a_damaged_manifest_is_refused_with_its_path(
    folder: Path, change: Callable[[Any], None], words: str
) -> None:
    document = json.loads((folder / "take.json").read_text())
    change(document)
    (folder / "take.json").write_text(json.dumps(document))
    with pytest.raises(TakeError, match=words) as caught:
        Take.open(folder)
    assert "take.json" in str(caught.value)


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_any_bytes_are_read_or_refused_but_never_crash(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("manifest") / "take.json"
    value = (
        st.none() | st.booleans() | st.integers() | st.text(max_size=5) | st.lists(st.integers())
    )
    document: dict[str, Any] = {
        "format": "likeness-take", "version": 1, "name": "t", "kind": "import", "frame_count": 3,
        "period_ns": None, "start_ns": None, "remarks": {},
        "devices": [{"name": "a", "width": 4, "height": 4, "channels": 1, "dtype": "uint8",
                     "frames": 3, "sha256": "0"}],
    }  # fmt: skip
    tree = data.draw(st.sampled_from([document, document["devices"][0]]))
    tree[data.draw(st.sampled_from(sorted(tree)))] = data.draw(value)
    path.write_text(json.dumps(document))
    said = refusal(lambda: read_manifest(path))
    assert not said or "take.json" in said


@pytest.mark.parametrize("error", [TakeError, KeyboardInterrupt])
def test_an_interrupted_writer_keeps_its_frames(tmp_path: Path, error: type[BaseException]) -> None:
    def fail() -> None:
        with TakeWriter(tmp_path / "take", {"cam00": LAYOUT}) as writer:
            writer.write("cam00", FrameHeader(0), image(0, 0))
            raise error

    with pytest.raises(error):
        fail()
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert [path.name for path in files] == ["cam00.mcap.partial"]
    assert np.array_equal(FrameReader(files[0]).read(0), image(0, 0))


def test_a_manifest_that_claims_a_giant_image_is_refused(folder: Path) -> None:
    document = json.loads((folder / "take.json").read_text())
    document["devices"][0].update(width=10**9)
    (folder / "take.json").write_text(json.dumps(document))
    with pytest.raises(TakeError, match="damaged manifest: 1000000000 x"):
        Take.open(folder)
