"""Visiting takes: lossless when they fit, refused by name and without a trace when they do not."""

from __future__ import annotations

import json
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.errors import CameraError, TakeError
from capture.take import Take
from capture.verify import verify_take
from recon.colmap import write_model
from recon.visiting import import_take
from tests.synthetic import small_array, write_visit

SHARED = Path(__file__).resolve().parents[2].parent / "shared" / "takes" / "dev-smile"


@pytest.fixture
def visit(tmp_path: Path) -> Path:
    source = tmp_path / "visit"
    source.mkdir()
    return write_visit(source, small_array(3), frames=4)


def edit(source: Path, change: Callable[[list[dict[str, object]]], None]) -> None:
    document = json.loads((source / "cameras.json").read_text())
    change(document["cameras"])
    (source / "cameras.json").write_text(json.dumps(document))


def test_a_take_comes_in_lossless_with_its_cameras(visit: Path, tmp_path: Path) -> None:
    told: list[tuple[int, int, str]] = []
    take = import_take(visit, tmp_path / "take", progress=lambda *step: told.append(step))
    assert take.name == "take"
    assert take.device_names == ("cam00", "cam01", "cam02")
    assert take.frames == (0, 1, 2, 3)
    assert take.size("cam01") == (64, 48)
    for name in take.device_names:
        for frame in take.frames:
            expected = cv2.imread(str(visit / name / f"{frame:04d}.png"), cv2.IMREAD_UNCHANGED)
            assert np.array_equal(take.image(name, frame), expected)
    assert take.cameras().names == take.device_names
    assert take.frame_set(2).complete
    assert verify_take(take).sound
    assert told[-4:] == [(k, 4, "import") for k in (1, 2, 3, 4)]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [1, 3])
def test_depth_and_colour_are_kept(
    visit: Path, tmp_path: Path, dtype: type[np.unsignedinteger], channels: int
) -> None:
    rng = np.random.default_rng(1)
    shape = (48, 64) if channels == 1 else (48, 64, 3)
    images = {}
    for path in visit.glob("*/*.png"):
        bgr = rng.integers(0, np.iinfo(dtype).max, shape, dtype=dtype, endpoint=True)
        cv2.imwrite(str(path), bgr)
        images[path.parent.name, int(path.stem)] = bgr if channels == 1 else bgr[:, :, ::-1]
    take = import_take(visit, tmp_path / "take")
    for (name, frame), rgb in images.items():
        assert take.image(name, frame).dtype == dtype
        assert np.array_equal(take.image(name, frame), rgb)


def test_without_cameras_devices_come_from_the_folders(visit: Path, tmp_path: Path) -> None:
    (visit / "cameras.json").unlink()
    take = import_take(visit, tmp_path / "board")
    assert take.device_names == ("cam00", "cam01", "cam02")
    assert not take.has_cameras
    with pytest.raises(CameraError, match="likeness calibrate"):
        take.cameras()


def test_the_neutral_comes_along(visit: Path, tmp_path: Path) -> None:
    (visit / "neutral.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    take = import_take(visit, tmp_path / "take")
    assert take.neutral().read_bytes() == (visit / "neutral.obj").read_bytes()


def test_numbers_may_begin_anywhere(visit: Path, tmp_path: Path) -> None:
    for path in sorted(visit.glob("*/*.png"), reverse=True):
        path.rename(path.with_name(f"{int(path.stem) + 1001}.png"))
    take = import_take(visit, tmp_path / "take")
    assert take.frames == (0, 1, 2, 3)
    assert take.manifest.remarks["first_source_number"] == 1001


def test_the_same_source_gives_the_same_bytes(visit: Path, tmp_path: Path) -> None:
    contents = []
    for parent in ("a", "b"):
        take = import_take(visit, tmp_path / parent / "take")
        files = sorted(path for path in take.folder.rglob("*") if path.is_file())
        contents.append({str(p.relative_to(take.folder)): p.read_bytes() for p in files})
    assert contents[0] == contents[1]


def test_a_second_import_is_skipped_and_keeps_what_was_made_since(
    visit: Path, tmp_path: Path
) -> None:
    take = import_take(visit, tmp_path / "take")
    take.products.mkdir()
    (take.products / "scan.ply").write_text("made since")
    before = (take.folder / "take.json").stat().st_mtime_ns
    import_take(visit, tmp_path / "take")
    assert (take.folder / "take.json").stat().st_mtime_ns == before
    assert (take.products / "scan.ply").read_text() == "made since"
    cv2.imwrite(str(visit / "cam00" / "0000.png"), np.zeros((48, 64), np.uint8))
    with pytest.raises(TakeError, match="holds a take made from other files; remove it"):
        import_take(visit, tmp_path / "take")
    assert (take.products / "scan.ply").exists()


def missing_folder(source: Path) -> None:
    shutil.rmtree(source / "cam01")


def extra_folder(source: Path) -> None:
    shutil.copytree(source / "cam01", source / "cam09")


def wrong_size(source: Path) -> None:
    edit(source, lambda cameras: cameras[1].update(width=640))


def nan_in_k(source: Path) -> None:
    edit(source, lambda cameras: cameras[1].update(K=[[float("nan"), 0, 1], [0, 1, 1], [0, 0, 1]]))


def truncated(source: Path) -> None:
    path = source / "cam02" / "0003.png"
    path.write_bytes(path.read_bytes()[:-300])


def end_mark_cut(source: Path) -> None:
    path = source / "cam02" / "0003.png"
    path.write_bytes(path.read_bytes()[:-12])


def empty_file(source: Path) -> None:
    (source / "cam02" / "0003.png").write_bytes(b"")


def bit_flipped(source: Path) -> None:
    path = source / "cam02" / "0003.png"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(bytes(data))


def rows_missing(source: Path) -> None:
    """A file whose chunks are all sound and whose pixels end early."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return (
            struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        )

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 64, 48, 8, 0, 0, 0, 0))
    rows = chunk(b"IDAT", zlib.compress(bytes(65 * 20)))
    path = source / "cam02" / "0003.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + header + rows + chunk(b"IEND", b""))


def unequal_counts(source: Path) -> None:
    (source / "cam02" / "0003.png").unlink()


def gap(source: Path) -> None:
    (source / "cam02" / "0002.png").rename(source / "cam02" / "0004.png")


def gap_everywhere(source: Path) -> None:
    for camera in ("cam00", "cam01", "cam02"):
        (source / camera / "0002.png").unlink()


def mixed_depth(source: Path) -> None:
    cv2.imwrite(str(source / "cam02" / "0003.png"), np.zeros((48, 64), np.uint16))


def mixed_size(source: Path) -> None:
    cv2.imwrite(str(source / "cam02" / "0003.png"), np.zeros((48, 65), np.uint8))


def with_alpha(source: Path) -> None:
    cv2.imwrite(str(source / "cam02" / "0003.png"), np.zeros((48, 64, 4), np.uint8))


def no_number(source: Path) -> None:
    (source / "cam02" / "0003.png").rename(source / "cam02" / "frame3.png")


def number_twice(source: Path) -> None:
    shutil.copy(source / "cam02" / "0003.png", source / "cam02" / "3.png")


def not_json(source: Path) -> None:
    (source / "cameras.json").write_text("{cameras: ")


def unknown_key(source: Path) -> None:
    edit(source, lambda cameras: cameras[0].update(focal=3))


def broken_neutral(source: Path) -> None:
    (source / "neutral.obj").write_text("v 0 0 0\nv 1 0\nf 1 2 3\n")


def no_images(source: Path) -> None:
    for camera in ("cam00", "cam01", "cam02"):
        shutil.rmtree(source / camera)


BAD = [
    (missing_folder, r"camera cam01: its folder cam01/ with images is missing"),
    (extra_folder, r"folder cam09/ holds images, and no camera is called cam09"),
    (wrong_size, r"camera cam01: cameras say 640 x 48 px, its images are 64 x 48 px"),
    (nan_in_k, r"cam01: K holds NaN or infinity"),
    (truncated, r"cam02/0003\.png: truncated"),
    (end_mark_cut, r"cam02/0003\.png: truncated: .* before its end mark"),
    (empty_file, r"cam02/0003\.png: expected a PNG file, found an empty file"),
    (bit_flipped, r"cam02/0003\.png: damaged: chunk b'IDAT' .* wrong CRC"),
    (rows_missing, r"cam02/0003\.png: truncated: 1300 bytes of pixel rows, expected 3120"),
    (
        unequal_counts,
        r"frame counts differ: 4 in 2 cameras, 3 in cam02\n.*cam02: missing frame 0003",
    ),
    (gap, r"cam00: missing frame 0004\n.*cam01: missing frame 0004\n.*cam02: missing frame 0002"),
    (gap_everywhere, r"no camera has frame 0002"),
    (mixed_depth, r"cam02: mixed images: 64 x 48 mono uint8 in 3 frames, .*uint16 in 0003\.png"),
    (mixed_size, r"cam02: mixed images: .*65 x 48 mono uint8 in 0003\.png"),
    (with_alpha, r"cam02/0003\.png: has transparency"),
    (no_number, r"cam02/frame3\.png: expected a frame number as file name"),
    (number_twice, r"cam02/3\.png: frame 3 is there twice, also as 0003\.png"),
    (not_json, r"cameras\.json: not readable as JSON"),
    (unknown_key, r"cam00: camera: unknown key 'focal'"),
    (broken_neutral, r"neutral\.obj:2: expected"),
    (no_images, r"no image found"),
]


@pytest.mark.parametrize(("spoil", "words"), BAD, ids=[spoil.__name__ for spoil, _ in BAD])
def test_what_does_not_fit_is_named_and_leaves_nothing_behind(
    visit: Path, tmp_path: Path, spoil: Callable[[Path], None], words: str
) -> None:
    spoil(visit)
    with pytest.raises(TakeError, match=words) as caught:
        import_take(visit, tmp_path / "take")
    assert caught.value.exit_status == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["visit"]


def test_all_misfits_come_in_one_message(visit: Path, tmp_path: Path) -> None:
    for spoil in (extra_folder, wrong_size, truncated, unequal_counts_of_cam00):
        spoil(visit)
    with pytest.raises(TakeError) as caught:
        import_take(visit, tmp_path / "take")
    text = str(caught.value)
    for part in ("5 problems", "cam09", "cam01: cameras say", "cam02/0003.png", "cam00: missing"):
        assert part in text


def unequal_counts_of_cam00(source: Path) -> None:
    (source / "cam00" / "0003.png").unlink()


def test_what_stands_in_the_way_is_not_touched(visit: Path, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.txt").write_text("precious")
    with pytest.raises(TakeError, match="other: exists and is not a take"):
        import_take(visit, tmp_path / "other")
    assert (tmp_path / "other" / "thesis.txt").read_text() == "precious"
    with pytest.raises(TakeError, match="must not lie in one another"):
        import_take(visit, visit / "take")
    with pytest.raises(TakeError, match="nowhere: expected a folder, found nothing"):
        import_take(tmp_path / "nowhere", tmp_path / "take")
    take = import_take(visit, tmp_path / "take")
    with pytest.raises(TakeError, match="is a take already"):
        import_take(take.folder, tmp_path / "again")


@pytest.mark.parametrize("after", [1, 3, 5, 6])
def test_an_interruption_leaves_nothing_behind(visit: Path, tmp_path: Path, after: int) -> None:
    steps = iter(range(100))

    def interrupt(done: int, total: int, what: str) -> None:
        if next(steps) == after:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        import_take(visit, tmp_path / "take", progress=interrupt)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["visit"]
    import_take(visit, tmp_path / "take")


def test_an_unsafe_camera_name_never_leaves_the_folder(visit: Path, tmp_path: Path) -> None:
    edit(visit, lambda cameras: cameras[1].update(name="../cam01"))
    with pytest.raises(TakeError, match="name must be letters"):
        import_take(visit, tmp_path / "take")


def as_colmap(visit: Path, *, single: bool, text: bool) -> None:
    (visit / "cameras.json").unlink()
    cameras = small_array(3)
    (visit / "images").mkdir()
    for camera in cameras:
        if single:
            (visit / camera.name / "0000.png").rename(visit / "images" / f"{camera.name}.png")
            shutil.rmtree(visit / camera.name)
        else:
            (visit / camera.name).rename(visit / "images" / camera.name)
    write_model(visit / "sparse" / "0", cameras, text=text)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("single", [False, True])
def test_images_with_a_colmap_model_come_in(
    visit: Path, tmp_path: Path, single: bool, text: bool
) -> None:
    expected = cv2.imread(str(visit / "cam01" / "0000.png"), cv2.IMREAD_UNCHANGED)
    as_colmap(visit, single=single, text=text)
    take = import_take(visit, tmp_path / "take")
    assert take.device_names == ("cam00", "cam01", "cam02")
    assert len(take.frames) == (1 if single else 4)
    assert np.array_equal(take.image("cam01", 0), expected)
    points = np.random.default_rng(0).normal(0, 20, (30, 3))
    assert np.abs(take.cameras().project(points) - small_array(3).project(points)).max() < 1e-6
    assert import_take(visit, tmp_path / "take").input_hash() == take.input_hash()


def test_a_colmap_model_without_some_images_is_refused(visit: Path, tmp_path: Path) -> None:
    as_colmap(visit, single=False, text=False)
    shutil.rmtree(visit / "images" / "cam02")
    with pytest.raises(TakeError, match="camera cam02: its folder cam02/ with images is missing"):
        import_take(visit, tmp_path / "take")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["visit"]


@pytest.mark.shared_data
def test_the_shared_take_comes_in(tmp_path: Path) -> None:
    take = import_take(SHARED, tmp_path / "dev-smile")
    assert len(take.device_names) == 16
    assert len(take.frames) == 12
    assert take.cameras()[3].name == "cam03"
    expected = cv2.imread(str(SHARED / "cam15" / "0011.png"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(Take.open(take.folder).image("cam15", 11), expected)
