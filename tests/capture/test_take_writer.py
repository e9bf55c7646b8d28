"""Recordings on disk: many threads, a full disk, an abandoned take; and how a take is settled."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from capture.durable import FolderLock
from capture.errors import TakeError, WorkError
from capture.frame_header import FrameHeader, ImageLayout, pixel_crc
from capture.mcap import FrameReader
from capture.opening import read_opening
from capture.recover import Outcome, recover_take
from capture.take import Take
from capture.take_writer import TakeWriter, partial_folder
from capture.verify import VerifySettings, settle, verify_take
from tests.capture.disk_faults import (
    LAYOUTS,
    NAMES,
    Case,
    Recorder,
    close_files,
    finish,
    open_writer,
    picture,
    write_frame,
)


def names(folder: Path) -> list[str]:
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())


def test_a_recording_says_first_what_it_is_and_has_its_name_last(tmp_path: Path) -> None:
    final = tmp_path / "smile_003"
    with open_writer(final, 4) as writer:
        opening = read_opening(partial_folder(final) / "opening.json")
        assert (opening.name, opening.expected_frames) == ("smile_003", 4)
        assert dict(opening.devices) == LAYOUTS
        assert opening.recording["take_number"] == 3
        with FolderLock(writer.folder) as lock:
            assert not lock.held
        for k in range(4):
            for device in NAMES:
                write_frame(writer, device, k)
        take = finish(writer, final, 4)
    assert take.folder == final
    assert names(final) == [
        "check.json",
        *(f"frames/{name}.mcap" for name in NAMES),
        "ledger.csv",
        "manifest-sha256.txt",
        "opening.json",
        "take.json",
    ]
    assert list(tmp_path.iterdir()) == [final]
    assert all(len(device.sha256) == 64 for device in take.manifest.devices)
    check = json.loads((final / "check.json").read_text())
    assert (check["sound"], check["frames"], check["problems"]) == (True, 12, [])
    assert verify_take(take, VerifySettings(from_disk=True, gently=True)).sound


def test_devices_are_written_from_many_threads_at_once(tmp_path: Path) -> None:
    devices = [f"cam{place:02d}" for place in range(8)]
    layout = ImageLayout(64, 48, 1, "uint8")

    def images(place: int) -> Iterator[np.ndarray]:
        rng = np.random.default_rng(place)
        for _ in range(40):
            yield rng.integers(0, 256, layout.shape, dtype=np.uint8)

    with TakeWriter(tmp_path / "t", dict.fromkeys(devices, layout), opening={}) as writer:

        def record(place: int) -> None:
            for k, image in enumerate(images(place)):
                crc = pixel_crc(image) if k % 2 else None  # of another thread, or of the writer
                writer.write(devices[place], FrameHeader(k), image, crc)

        with ThreadPoolExecutor(8) as pool:
            list(pool.map(record, range(8)))
        writer.abandon()
    for place, device in enumerate(devices):
        found = FrameReader(tmp_path / "t" / "frames" / f"{device}.mcap.partial")
        assert len(found) == 40
        for k, image in enumerate(images(place)):
            assert np.array_equal(found.read(k), image)


def test_an_abandoned_take_stays_and_is_unlocked(tmp_path: Path) -> None:
    final = tmp_path / "smile_001"

    def fail() -> None:
        with open_writer(final, 3) as writer:
            write_frame(writer, "cam00", 0)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    recovery = recover_take(partial_folder(final))
    assert recovery.outcome == Outcome.SETTLED
    assert [device.frames for device in recovery.devices] == [1, 0, 0]


def test_a_folder_that_is_there_is_not_touched(tmp_path: Path) -> None:
    (tmp_path / "smile_001.partial").mkdir()
    (tmp_path / "smile_001.partial" / "mine").write_text("x")
    with pytest.raises(FileExistsError):
        open_writer(tmp_path / "smile_001", 3)
    assert names(tmp_path) == ["smile_001.partial/mine"]


def test_unknown_devices_are_refused(tmp_path: Path) -> None:
    with (
        open_writer(tmp_path / "smile_001", 3) as writer,
        pytest.raises(TakeError, match=r"smile_001\.partial: no device 'cam09'"),
    ):
        write_frame_of("cam09", writer)


def write_frame_of(device: str, writer: TakeWriter) -> None:
    writer.write(device, FrameHeader(0), picture("cam00", 0))


def test_a_take_is_settled_only_under_a_free_name(tmp_path: Path) -> None:
    final = tmp_path / "smile_001"
    with open_writer(final, 1) as writer:
        for device in NAMES:
            write_frame(writer, device, 0)
        close_files(writer, final, 1)
    take = Take.open(partial_folder(final))
    report = verify_take(take)
    final.mkdir()
    with pytest.raises(TakeError, match="smile_001: exists already; move it away"):
        settle(take, report)
    final.rmdir()
    settled = settle(take, report)
    with pytest.raises(TakeError, match=r"smile_001: expected a folder NAME\.partial"):
        settle(settled, report)


def test_hashes_that_reading_back_did_not_make_are_made_when_it_is_settled(tmp_path: Path) -> None:
    final = tmp_path / "smile_001"
    with open_writer(final, 1) as writer:
        for device in NAMES:
            write_frame(writer, device, 0)
        close_files(writer, final, 1)
    take = Take.open(partial_folder(final))
    take = settle(take, verify_take(take, VerifySettings(hashed=False)))
    assert verify_take(take).problems == ()
    assert all(len(device.sha256) == 64 for device in take.manifest.devices)


def test_an_unsound_take_is_settled_too_and_says_so(tmp_path: Path) -> None:
    final = tmp_path / "smile_001"
    with open_writer(final, 2) as writer:
        for k in range(2):
            for device in NAMES:
                write_frame(writer, device, k)
        close_files(writer, final, 2)
    path = partial_folder(final) / "frames" / "cam00.mcap"
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 1
    path.write_bytes(bytes(data))
    take = Take.open(partial_folder(final))
    take = settle(take, verify_take(take))
    check = json.loads((final / "check.json").read_text())
    assert not check["sound"]
    assert "cam00.mcap: frame 0 (trigger 0): damaged" in check["problems"][0]


def what_is_said(writer: TakeWriter, device: str, k: int) -> str:
    try:
        write_frame(writer, device, k)
    except WorkError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("left_bytes", [700_000, 600_123, 400_000])
def test_a_full_disk_stops_a_take_between_frames_and_it_can_be_closed(
    small_disk: Path, left_bytes: int
) -> None:
    free = os.statvfs(small_disk).f_bavail * os.statvfs(small_disk).f_frsize
    (small_disk / "other").write_bytes(bytes(free - left_bytes))
    final = small_disk / "smile_001"
    written = dict.fromkeys(NAMES, 0)
    expected = 300 if left_bytes == 600_123 else 10  # more than it has room for, or less
    with open_writer(final, expected) as writer:
        full = set()
        for k in range(1000):
            for device in NAMES:
                said = what_is_said(writer, device, k)
                if said:
                    assert f"{device}.mcap: cannot be written: No space left" in said
                    full.add(device)
                elif device not in full:
                    written[device] = k + 1
            if len(full) == 3:
                break
        assert full == set(NAMES)
        close_files(writer, final, max(written.values()))
        take = Take.open(writer.folder)
        take = settle(take, verify_take(take))
    for device in NAMES:
        assert len(take.reader(device)) >= written[device]
        assert take.reader(device).closed_well
        for k in range(written[device]):
            assert np.array_equal(take.image(device, k), picture(device, k))


def test_a_disk_without_any_room_refuses_a_take_and_keeps_nothing(small_disk: Path) -> None:
    free = os.statvfs(small_disk).f_bavail * os.statvfs(small_disk).f_frsize
    (small_disk / "other").write_bytes(bytes(free - 100_000))
    with pytest.raises(WorkError, match="the disk is full: no room even to close a take"):
        open_writer(small_disk / "smile_001", 10)
    assert names(small_disk) == ["other"]


def test_recovery_completes_a_take_on_a_full_disk(small_disk: Path, tmp_path: Path) -> None:
    final = small_disk / "smile_001"
    with Recorder() as recorder:
        acks = str(tmp_path / "acks")
        assert recorder.run(Case(folder=str(final), frames=60, acks=acks, torn_call=150))
    free = os.statvfs(small_disk).f_bavail * os.statvfs(small_disk).f_frsize
    (small_disk / "other").write_bytes(bytes(free))  # all, but for the room the take has kept
    recovery = recover_take(partial_folder(final))
    assert recovery.outcome == Outcome.SETTLED, recovery.sentence
    assert [device.frames for device in recovery.devices] == [50, 50, 50]
    assert (recovery.frame_count, recovery.planned) == (51, 60)
    assert recovery.devices[0].torn == 50
