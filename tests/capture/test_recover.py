"""Recovery: what it says, what it leaves alone, what it puts aside, what it does not believe."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from capture.errors import TakeError
from capture.frame_header import FrameHeader, ImageLayout
from capture.ledger import Verdict
from capture.mcap import FrameReader, FrameWriter, frame_bytes
from capture.recover import FileMend, Outcome, recover_session, recover_take
from capture.recover.salvage import salvage
from capture.session import Session
from capture.take import Take
from capture.take_writer import partial_folder
from capture.verify import verify_take
from tests.capture.disk_faults import (
    LAYOUTS,
    NAMES,
    close_files,
    finish,
    open_writer,
    picture,
    write_frame,
)

SIZE = {name: frame_bytes(layout) for name, layout in LAYOUTS.items()}


def record(final: Path, frames: int = 6, planned: int = 6, *, closed: bool = False) -> Path:
    """A take that was not finished; the folder it stands in."""
    with open_writer(final, planned) as writer:
        for k in range(frames):
            for device in NAMES:
                write_frame(writer, device, k)
        if closed:
            close_files(writer, final, frames)
    return partial_folder(final)


def file_of(folder: Path, device: str) -> Path:
    return next((folder / "frames").glob(f"{device}.mcap*"))


def spoil(path: Path, at: int, data: bytes = b"\xff") -> None:
    with path.open("r+b") as file:
        file.seek(at)
        file.write(data)


def start_of(path: Path, k: int) -> int:
    return FrameReader(path).offsets[k]


def test_it_says_exactly_what_it_saved_and_what_is_lost(tmp_path: Path) -> None:
    folder = record(tmp_path / "smile_001", frames=5, planned=8)
    size = file_of(folder, "cam00").stat().st_size
    os.truncate(file_of(folder, "cam00"), size - 131)  # 100 bytes of the last chunk, its index
    spoil(file_of(folder, "cam01"), start_of(file_of(folder, "cam01"), 2) + 300)
    recovery = recover_take(folder)
    assert recovery.sentence == (
        "smile_001: saved 13 frames of 3 devices, 5 of 8 planned triggers; "
        f"cam00: torn while it was written: frame 4, {SIZE['cam00'] - 100} bytes dropped; "
        f"cam01: damaged on the disk: frame 2, {SIZE['cam01'] + 31} bytes dropped"
    )
    assert [device.mend for device in recovery.devices] == [
        FileMend.COMPLETED,
        FileMend.REBUILT,
        FileMend.COMPLETED,
    ]
    take = Take.open(tmp_path / "smile_001")
    ledger = take.ledger()
    assert (ledger.entry(4, "cam00").verdict, ledger.entry(4, "cam00").note) == (
        Verdict.LOST,
        "recovered: torn while it was written",
    )
    assert ledger.entry(2, "cam01").note == "recovered: damaged on the disk"
    assert (take.manifest.start_ns, take.manifest.period_ns) == (1000, 10)
    assert take.manifest.remarks["judgement"]["sentence"] == (
        "Recovered after a crash: 5 of 8 frame sets were begun, 3 are complete. Take it again."
    )
    assert take.manifest.remarks["recovered"]["devices"]["cam01"].startswith("damaged on the disk")
    assert json.loads(json.dumps(recovery.document()))["outcome"] == "settled"


def test_a_damaged_file_is_kept_beside_its_copy(tmp_path: Path) -> None:
    folder = record(tmp_path / "smile_001", closed=True)
    path = file_of(folder, "cam01")
    spoil(path, start_of(path, 0) + 400)
    damaged = path.read_bytes()
    assert recover_take(folder).outcome == Outcome.SETTLED
    assert (tmp_path / "smile_001" / "damaged" / "cam01.mcap").read_bytes() == damaged


def test_a_completed_file_is_the_file_that_closing_makes(tmp_path: Path) -> None:
    for frames in (0, 1, 4):
        images = [picture("cam00", k) for k in range(frames)]
        with FrameWriter(tmp_path / "a.mcap", "cam00", LAYOUTS["cam00"]) as writer:
            for k, image in enumerate(images):
                writer.write(FrameHeader(k), image)
        folder = partial_folder(tmp_path / f"smile_{frames:03d}")
        (folder / "frames").mkdir(parents=True)
        torn = FrameWriter(folder / "frames" / "cam00.mcap", "cam00", LAYOUTS["cam00"])
        for k in range(frames + 1):
            torn.write(FrameHeader(k), picture("cam00", k))
        torn.abandon()
        path = file_of(folder, "cam00")
        os.truncate(path, path.stat().st_size - 40)  # of the last frame, which is torn then
        recovery = recover_take(folder)
        if frames == 0:
            assert recovery.outcome == Outcome.EMPTY
            continue
        mended = tmp_path / f"smile_{frames:03d}" / "frames" / "cam00.mcap"
        assert mended.read_bytes() == (tmp_path / "a.mcap").read_bytes()


def test_frames_behind_bytes_that_are_gone_or_too_many_are_found(tmp_path: Path) -> None:
    folder = record(tmp_path / "smile_001")
    path = file_of(folder, "cam00")
    data, starts = path.read_bytes(), FrameReader(path).offsets
    hole, extra = starts[1] + 500, starts[4] + 20
    path.write_bytes(data[:hole] + data[hole + 77 : extra] + b"?" * 50 + data[extra:])
    recovery = recover_take(folder)
    assert recovery.devices[0].damaged == (1, 4)
    take = Take.open(tmp_path / "smile_001")
    assert [take.present("cam00", k) for k in range(6)] == [True, False, True, True, False, True]
    assert np.array_equal(take.image("cam00", 5), picture("cam00", 5))


def test_a_whole_stretch_that_is_gone_is_named(tmp_path: Path) -> None:
    folder = record(tmp_path / "smile_001")
    path = file_of(folder, "cam02")
    spoil(path, start_of(path, 1) + 5, bytes(3 * SIZE["cam02"]))
    recovery = recover_take(folder)
    assert recovery.devices[2].damaged == (1, 2, 3)
    assert recovery.verdicts[Verdict.LOST] == 3


def test_a_header_that_was_hit_is_not_believed(tmp_path: Path) -> None:
    layout = ImageLayout(16, 8, 1, "uint8")
    writer = FrameWriter(tmp_path / "a.mcap", "cam00", layout)
    for k in range(3):
        writer.write(FrameHeader(k), np.full((8, 16), k, np.uint8))
    writer.abandon()
    path = tmp_path / "a.mcap.partial"
    spoil(path, FrameReader(path).offsets[2] + 49 + 31 + 8, b"\x07")  # its trigger index
    found = salvage(path, "cam00", layout, 0)
    assert [header.trigger_index for header in found.headers] == [0, 1]
    assert [(d.frames, d.triggers) for d in found.damages] == [(1, ())]


def test_what_the_ledger_knew_is_kept_where_the_files_agree(tmp_path: Path) -> None:
    folder = record(tmp_path / "smile_001", closed=True)
    ledger = folder / "ledger.csv"
    ledger.write_text(ledger.read_text().replace("5,cam01,ok", "5,cam01,missed_trigger"))
    path = file_of(folder, "cam00")
    os.truncate(path, start_of(path, 4) + 10)  # frames 4 and 5 of cam00 are gone
    recovery = recover_take(folder)
    assert recovery.remade == ("ledger.csv", "take.json")
    found = Take.open(tmp_path / "smile_001").ledger()
    kept = found.entry(3, "cam02")
    assert (kept.verdict, kept.t_ns, kept.note) == (Verdict.OK, 1030, "")
    lost = found.entry(5, "cam00")
    assert (lost.verdict, lost.note) == (Verdict.LOST, "recovered: its frame is not on the disk")
    assert found.entry(5, "cam01").verdict == Verdict.OK  # the file has it
    assert verify_take(Take.open(tmp_path / "smile_001")).sound


def test_a_take_that_was_only_not_settled_is_settled_as_it_is(tmp_path: Path) -> None:
    folder = record(tmp_path / "smile_001", closed=True)
    before = (folder / "ledger.csv").read_bytes()
    recovery = recover_take(folder)
    assert (recovery.remade, recovery.frame_count) == ((), 6)
    assert recovery.sentence == "smile_001: saved 18 frames of 3 devices, 6 triggers"
    take = Take.open(tmp_path / "smile_001")
    assert take.manifest.remarks["judgement"]["colour"] == "green"
    assert "recovered" not in take.manifest.remarks
    assert (take.folder / "ledger.csv").read_bytes() == before


def test_what_is_being_recorded_is_left_alone(tmp_path: Path) -> None:
    session = Session.create(tmp_path / "s")
    final = session.folder / "takes" / "smile_001"
    with open_writer(final, 3) as writer:
        for k in range(3):
            for device in NAMES:
                write_frame(writer, device, k)
        [recovery] = recover_session(session)
        assert recovery.outcome == Outcome.BUSY
        assert "smile_001.partial: busy: another process records or recovers it" in (
            recovery.sentence
        )
        finish(writer, final, 3)
    assert recover_session(session) == ()
    assert recover_take(final).sentence == "smile_001: nothing to do"


def test_what_holds_no_frame_stays_as_it_is(tmp_path: Path) -> None:
    folder = record(tmp_path / "smile_001", frames=0)
    for _ in range(2):
        recovery = recover_take(folder)
        assert recovery.outcome == Outcome.EMPTY
        assert "there is no whole frame in it; it stays as it is" in recovery.sentence
        assert folder.is_dir()


def test_a_name_that_is_taken_fails_and_nothing_is_lost(tmp_path: Path) -> None:
    folder = record(tmp_path / "smile_001")
    (tmp_path / "smile_001").mkdir()
    recovery = recover_take(folder)
    assert recovery.outcome == Outcome.FAILED
    assert "smile_001: exists already; move it away, and run this again" in recovery.sentence
    (tmp_path / "smile_001").rmdir()
    assert recover_take(folder).outcome == Outcome.SETTLED


def test_a_session_tells_each_take_as_it_goes(tmp_path: Path) -> None:
    session = Session.create(tmp_path / "s")
    for number in (1, 2):
        record(session.folder / "takes" / f"smile_{number:03d}", frames=number)
    told: list[str] = []
    done = recover_session(session, told=lambda recovery: told.append(recovery.sentence))
    assert told == [recovery.sentence for recovery in done]
    assert [note.take_number for note in session.takes()] == [1, 2]
    assert [note.colour for note in session.takes()] == ["red", "red"]


def test_without_any_paper_the_files_say_what_they_are(tmp_path: Path) -> None:
    folder = record(tmp_path / "smile_001", frames=2)
    (folder / "opening.json").unlink()
    assert recover_take(folder).outcome == Outcome.SETTLED
    assert Take.open(tmp_path / "smile_001").device_names == NAMES
    folder = partial_folder(tmp_path / "smile_002")
    (folder / "frames").mkdir(parents=True)
    (folder / "frames" / "cam00.mcap.partial").write_bytes(b"nothing of ours")
    recovery = recover_take(folder)
    assert recovery.outcome == Outcome.FAILED
    assert "nor any file of frames says what was recorded" in recovery.sentence


def test_other_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(TakeError, match=r"expected a session, or a folder NAME\.partial"):
        recover_take(tmp_path / "nowhere")
    with pytest.raises(TakeError, match=r"expected a take, found no take\.json"):
        recover_take(tmp_path)


@pytest.mark.parametrize("place", ["frames", "frames/cam00.mcap.partial", "damaged"])
def test_a_link_in_it_is_refused_and_what_it_leads_to_stays_as_it_is(
    tmp_path: Path, place: str
) -> None:
    folder = record(tmp_path / "smile_001", frames=3)
    path = file_of(folder, "cam00")
    os.truncate(path, path.stat().st_size - 40)  # recovery would cut the rest off
    outside = tmp_path / "outside"
    (outside / "damaged").mkdir(parents=True)
    if (folder / place).exists():
        (folder / place).rename(outside / "there")
        (folder / place).symlink_to(outside / "there")
    else:
        (folder / place).symlink_to(outside / "damaged")
    before = {p: p.read_bytes() for p in outside.rglob("*") if p.is_file()}
    recovery = recover_take(folder)
    assert recovery.outcome == Outcome.FAILED
    assert f"{folder / place}: is a link, and a recording makes none" in recovery.sentence
    assert {p: p.read_bytes() for p in outside.rglob("*") if p.is_file()} == before


def test_what_the_system_refuses_fails_one_take_and_not_the_others(tmp_path: Path) -> None:
    session = Session.create(tmp_path / "s")
    for number in (1, 2):
        record(session.folder / "takes" / f"smile_{number:03d}", frames=2)
    (session.folder / "takes" / "smile_001.partial" / ".room").mkdir()
    first, second = recover_session(session)
    assert (first.outcome, second.outcome) == (Outcome.FAILED, Outcome.SETTLED)
    assert "smile_001.partial/.room: Is a directory" in first.sentence


def test_a_summary_that_claims_more_than_the_file_can_hold_is_not_read(tmp_path: Path) -> None:
    folder = record(tmp_path / "smile_001", frames=2, planned=2, closed=True)
    path = file_of(folder, "cam00")
    end = path.read_bytes()[-37:]  # footer and magic
    with path.open("r+b") as file:
        os.truncate(file.fileno(), 1 << 42)  # 4 TiB of nothing: the summary would be all of it
        file.seek(-len(end), os.SEEK_END)
        file.write(end)
    reader = FrameReader(path)
    assert (len(reader), reader.closed_well) == (2, False)
