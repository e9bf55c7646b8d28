"""Sessions: takes recorded whole, retakes beside them, nothing ever deleted."""

from __future__ import annotations

import json
import resource
from pathlib import Path

import numpy as np
import pytest

from capture.devices.simulated import Fault, FaultKind
from capture.errors import DeviceError, SettingsError, TakeError, WorkError
from capture.recorder import RecordSettings
from capture.session import Session, Shot, ShotList, record_take
from capture.take import Take
from capture.take_notes import NoteBook, OperatorNote, TakeStatus
from capture.verify import verify_take
from tests.capture.recording import array_of, cameras, stamp

PRE = RecordSettings().edge_triggers
SMILE = Shot(slate="smile", kind="expression", frames=6, start_ns=5 * 10**9)


def test_a_take_holds_what_the_scene_showed_at_each_trigger(tmp_path: Path) -> None:
    session = Session.create(tmp_path / "session")
    told: list[tuple[int, int, str]] = []
    take = record_take(
        session, SMILE, array_of(), RecordSettings(), progress=lambda *step: told.append(step)
    )
    assert take.folder == tmp_path / "session" / "takes" / "smile_001"
    assert take.frames == tuple(range(6))
    assert (take.manifest.start_ns, take.manifest.period_ns) == (5 * 10**9, 13_333_333)
    for camera in cameras():
        for k in take.frames:
            expected = stamp(camera, 5 * 10**9 + k * 13_333_333)
            assert np.array_equal(take.image(camera.name, k), expected)
    assert verify_take(take).sound
    assert told[-1] == (24, 24, "record smile_001")
    [note] = session.takes()
    assert (note.slate, note.take_number, note.kind, note.colour) == (
        "smile",
        1,
        "expression",
        "green",
    )
    assert note.sentence == "All 6 frame sets of 4 devices are complete."
    assert sorted(path.name for path in take.folder.iterdir()) == [
        "check.json",
        "frames",
        "ledger.csv",
        "manifest-sha256.txt",
        "take.json",
    ]


def test_a_lost_frame_is_absent_from_the_take_and_named_in_its_judgement(tmp_path: Path) -> None:
    array = array_of(faults={"cam02": [Fault(FaultKind.LOSE_FRAME, PRE + 3)]})
    take = record_take(Session.create(tmp_path / "s"), SMILE, array, RecordSettings())
    assert not take.present("cam02", 3)
    assert take.frame_set(3).missing == ("cam02",)
    assert take.frame_set(4).complete
    judgement = take.manifest.remarks["judgement"]
    assert judgement["colour"] == "amber"
    assert "frame 3 of cam02 was lost in transport" in judgement["sentence"]
    report = verify_take(take)
    assert report.sound
    assert report.frames == 23
    assert sum(report.verdicts.values()) == 24


def test_incomplete_images_are_kept_only_when_asked_and_never_as_good(tmp_path: Path) -> None:
    faults = {"cam02": [Fault(FaultKind.INCOMPLETE, PRE + 3)]}
    session = Session.create(tmp_path / "s")
    for keep, count in ((False, 5), (True, 6)):
        settings = RecordSettings(keep_incomplete=keep)
        take = record_take(session, SMILE, array_of(faults=faults), settings)
        assert len(take.reader("cam02")) == count
        assert not take.present("cam02", 3)
        assert verify_take(take).sound


def test_a_retake_gets_the_next_number_and_supersedes(tmp_path: Path) -> None:
    session = Session.create(tmp_path / "s", name="tuesday")
    array = array_of()
    first = record_take(session, SMILE, array, RecordSettings())
    before = {p: p.read_bytes() for p in first.folder.rglob("*") if p.is_file()}
    second = record_take(session, SMILE, array, RecordSettings())
    other = Shot(slate="smile_2", kind="neutral", frames=1)
    record_take(session, other, array, RecordSettings())
    assert second.name == "smile_002"
    assert {p: p.read_bytes() for p in first.folder.rglob("*") if p.is_file()} == before
    notes = Session.open(tmp_path / "s").takes()
    assert [(n.slate, n.take_number, n.superseded) for n in notes] == [
        ("smile", 1, True), ("smile", 2, False), ("smile_2", 1, False),
    ]  # fmt: skip
    assert session.take("smile").folder == second.folder
    assert np.array_equal(first.image("cam01", 2), second.image("cam01", 2))
    with pytest.raises(TakeError, match="no take of 'frown'; recorded slates: smile, smile_2"):
        session.take("frown")


def test_what_a_killed_recording_left_is_no_take(tmp_path: Path) -> None:
    session = Session.create(tmp_path / "s")
    take = record_take(session, SMILE, array_of(), RecordSettings())
    take.folder.rename(take.folder.with_name(".partial-77-smile_001"))
    assert session.takes() == ()
    assert session.next_number("smile") == 1


def test_the_same_array_and_shot_give_the_same_bytes(tmp_path: Path) -> None:
    contents = []
    for name in ("a", "b"):
        take = record_take(
            Session.create(tmp_path / name), SMILE, array_of(seed=3), RecordSettings()
        )
        files = sorted(p for p in take.folder.rglob("*") if p.is_file())
        files = [path for path in files if path.name != "check.json"]  # says when it was checked
        contents.append({str(p.relative_to(take.folder)): p.read_bytes() for p in files})
    assert contents[0] == contents[1]


@pytest.mark.parametrize("after", [1, 10, 24])
def test_an_interrupted_take_leaves_nothing_and_the_next_one_works(
    tmp_path: Path, after: int
) -> None:
    session = Session.create(tmp_path / "s")
    array = array_of()

    def interrupt(done: int, total: int, what: str) -> None:
        if done == after:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record_take(session, SMILE, array, RecordSettings(), progress=interrupt)
    assert list((tmp_path / "s" / "takes").iterdir()) == []
    assert record_take(session, SMILE, array, RecordSettings()).name == "smile_001"


def test_one_image_is_in_memory_at_a_time(tmp_path: Path) -> None:
    """Between two fetches nothing but small events waits: no device holds a slot at the end."""
    array = array_of(faults={"cam01": [Fault(FaultKind.DUPLICATE, 3), Fault(FaultKind.STALE, 5)]})
    record_take(Session.create(tmp_path / "s"), SMILE, array, RecordSettings())
    assert [device._exposed for device in array.devices] == [{}] * 4  # type: ignore[attr-defined]


def test_start_is_now_when_the_shot_does_not_say(tmp_path: Path) -> None:
    array = array_of()
    array.line.wait(7 * 10**9)
    shot = Shot(slate="n", kind="neutral", frames=2)
    take = record_take(Session.create(tmp_path / "s"), shot, array, RecordSettings())
    assert take.manifest.start_ns == 7 * 10**9 + (PRE + 1) * 13_333_333


def test_a_device_that_fails_leaves_no_take(tmp_path: Path) -> None:
    class Broken:
        def render(self, camera: object, t_ns: int) -> np.ndarray:
            raise DeviceError("cam01: no answer for 0.5 s")

    array = array_of()
    array.devices[1]._scene = Broken()  # type: ignore[attr-defined]
    with pytest.raises(DeviceError, match=r"cam01: no answer for 0\.5 s"):
        record_take(Session.create(tmp_path / "s"), SMILE, array, RecordSettings())
    assert list((tmp_path / "s" / "takes").iterdir()) == []


@pytest.mark.parametrize("limit", [600, 1700, 2000, 4000, 5000])
def test_a_disk_that_takes_no_more_leaves_no_take(tmp_path: Path, limit: int) -> None:
    session = Session.create(tmp_path / "s")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))  # bytes a file may have
        with pytest.raises(WorkError, match=r"cam0\d\.mcap: cannot be written: File too large"):
            record_take(session, SMILE, array_of(), RecordSettings())
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list((tmp_path / "s" / "takes").iterdir()) == []
    assert record_take(session, SMILE, array_of(), RecordSettings()).name == "smile_001"


def test_sessions_that_are_none_are_refused(tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").write_text("x")
    with pytest.raises(TakeError, match="full: exists and is not a session"):
        Session.create(tmp_path / "full")
    with pytest.raises(TakeError, match=r"expected a session, found no session\.json"):
        Session.open(tmp_path / "full")
    session = Session.create(tmp_path / "s", name="monday")
    assert Session.create(tmp_path / "s").name == session.name == "monday"
    document = json.loads((tmp_path / "s" / "session.json").read_text())
    (tmp_path / "s" / "session.json").write_text(json.dumps(document | {"version": 9}))
    with pytest.raises(TakeError, match="format version 9, this program reads up to 1; update"):
        Session.open(tmp_path / "s")
    with pytest.raises(TakeError, match="this is a session; its takes stand in"):
        Take.open(tmp_path / "s")


def test_shots_that_cannot_be_are_refused() -> None:
    with pytest.raises(SettingsError) as caught:
        Shot(slate="../x", kind="dance", frames=0)
    for words in ("slate must be letters", "kind must be one of board", "at least 1, found 0"):
        assert words in str(caught.value)
    with pytest.raises(SettingsError, match=r"hold must lie within frames 0\.\.5, found \(3, 6\)"):
        Shot(slate="x", kind="neutral", frames=6, hold=(3, 6))
    with pytest.raises(SettingsError, match="slates must be unique, found twice: smile"):
        ShotList((SMILE, SMILE))
    with pytest.raises(
        SettingsError, match=r"record\.rate_hz = 0: must be at least 1 and at most 1000"
    ):
        RecordSettings(rate_hz=0)
    with pytest.raises(SettingsError, match="below the period of 13333 us, found 15000"):
        RecordSettings(exposure_us=15_000)


def test_verify_finds_what_is_wrong(tmp_path: Path) -> None:
    take = record_take(Session.create(tmp_path / "s"), SMILE, array_of(), RecordSettings())
    path = take.folder / "frames" / "cam02.mcap"
    data = bytearray(path.read_bytes())
    at = data.find(b"cam02 5")  # the first pixels of a frame
    data[at + 1] ^= 1
    path.write_bytes(bytes(data))
    ledger = take.folder / "ledger.csv"
    ledger.write_text(ledger.read_text().replace("4,cam03,ok", "4,cam03,lost"))
    report = verify_take(Take.open(take.folder))
    assert not report.sound
    assert report.frames == 23
    text = "\n".join(report.problems)
    assert "its SHA-256 is not the one in take.json" in text
    assert "frame 0 (trigger 0): damaged: expected CRC" in text
    assert "the file has frame 4 of cam03, the ledger has not" in text
    (take.folder / "ledger.csv").unlink()
    path.write_bytes(bytes(data[: len(data) // 2]))
    text = "\n".join(verify_take(Take.open(take.folder)).problems)
    assert "ledger.csv: not readable" in text
    assert "cam02.mcap: expected 6 frames, found" in text


@pytest.mark.parametrize(
    "odd",
    [
        {"take_number": "1"},
        {"shot": ["smile"]},
        {"shot": {"slate": 3}},
        {"shot": {"slate": "../smile", "kind": "expression"}},
        {"judgement": None},
        {"judgement": {"colour": "blue", "sentence": "x"}},
    ],
)
def test_a_take_that_does_not_say_what_was_recorded_is_named(
    tmp_path: Path, odd: dict[str, object]
) -> None:
    session = Session.create(tmp_path / "s")
    take = record_take(session, SMILE, array_of(), RecordSettings())
    path = take.folder / "take.json"
    document = json.loads(path.read_text())
    document["remarks"].update(odd)
    path.write_text(json.dumps(document))
    record_take(session, SMILE, array_of(), RecordSettings())
    with pytest.raises(TakeError, match=r"smile_001/take\.json: damaged manifest: remarks must"):
        session.takes()
    damaged: list[str] = []
    assert [note.take_number for note in session.takes(damaged)] == [2]
    assert "smile_001/take.json" in damaged[0]


def test_the_take_that_the_operator_kept_counts_though_a_later_one_stands_there(
    tmp_path: Path,
) -> None:
    session = Session.create(tmp_path / "s")
    for _ in range(3):
        record_take(session, SMILE, array_of(), RecordSettings())
    assert session.take("smile").name == "smile_003"
    book = NoteBook.of_session(session.folder)
    book.write("smile_003", OperatorNote(status=TakeStatus.RETAKE))
    assert session.take("smile").name == "smile_002"
    book.write("smile_001", OperatorNote(status=TakeStatus.KEEP))
    assert session.take("smile").name == "smile_001"


def test_the_hold_is_counted_from_the_key_and_not_from_the_pre_roll(tmp_path: Path) -> None:
    shot = Shot(slate="smile", kind="expression", frames=20, hold=(8, 12))
    settings = RecordSettings(pre_roll=10, post_roll=5)
    for at, colour in ((8, "amber"), (18, "red"), (22, "red"), (23, "amber")):
        faults = {"cam02": [Fault(FaultKind.LOSE_FRAME, PRE + at)]}
        take = record_take(
            Session.create(tmp_path / str(at)), shot, array_of(faults=faults), settings
        )
        assert take.manifest.frame_count == 35
        assert take.manifest.remarks["judgement"]["colour"] == colour
