"""Taking up a session: after a crash at any moment, with another list, with damaged files."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from capture.errors import TakeError
from capture.event_log import read_events
from capture.judgement import Colour
from capture.live_take import TakePhase
from capture.rom.events import Key
from capture.rom.memory import as_document, load_state, save_document
from capture.rom.state import RomState, Stage, TakeState
from capture.session import Session
from capture.take_notes import NoteBook, OperatorNote, TakeStatus
from tests.capture.rom.situations import SLATES, armed, judged, prompts, recording, taken, written
from tests.capture.rom.stage import Rehearsal, arm, quiet, short_list, take, until


def session_of(tmp_path: Path, state: RomState) -> Session:
    session = Session.create(tmp_path / "s")
    save_document(session, as_document(prompts(), state))
    return session


def test_a_state_comes_back_idle_at_its_prompt(tmp_path: Path) -> None:
    state = taken(taken(armed(), "neutral_001"), "smile_001", Colour.AMBER)
    session = session_of(tmp_path, state)
    NoteBook.of_session(session.folder).write("smile_001", OperatorNote(status=TakeStatus.FLAG))
    loaded, told = load_state(session, prompts())
    assert (loaded.stage, loaded.place) == (Stage.IDLE, 2)
    assert [each.name for each in loaded.takes] == ["neutral_001", "smile_001"]
    assert loaded.takes[1].sentence == "It is amber."
    assert loaded.takes[1].status == TakeStatus.FLAG
    assert told == ("The session goes on at prompt 3, frown.",)


@pytest.mark.parametrize("phase", ["recording", "draining", "checking"])
def test_a_take_that_was_cut_short_is_told_and_not_forgotten(tmp_path: Path, phase: str) -> None:
    state = recording(armed(), "neutral_001")
    state = state if phase == "recording" else judged(state, "neutral_001")
    state = state if phase != "checking" else written(state, "neutral_001")
    session = session_of(tmp_path, state)
    for _ in range(2):  # whether it was taken up before or not
        loaded, _told = load_state(session, prompts())
        [cut] = loaded.takes
        assert (cut.phase, cut.shown_colour) == (TakePhase.FAILED, Colour.RED)
        assert "likeness recover" in cut.shown_sentence
        assert [each.name for each in loaded.undecided] == ["neutral_001"]
        save_document(session, as_document(prompts(), loaded))


def test_another_shot_list_keeps_the_takes(tmp_path: Path) -> None:
    session = session_of(tmp_path, taken(armed(), "neutral_001"))
    loaded, told = load_state(session, prompts("grin", "neutral"))
    assert (loaded.place, len(loaded.takes)) == (0, 1)
    assert told == ("The session stood at smile, which the shot list no longer has.",)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"format": "x"}, 'expected "format": "likeness-rom"'),
        ({"version": 9}, "written in format version 9, this program reads up to 1"),
        ({"takes": [{"name": "x"}]}, "damaged: KeyError 'colour'"),
        ({"takes": 3}, "damaged: TypeError"),
        ({"takes": [dict.fromkeys(
            ("name", "slate", "number", "phase", "colour", "sentence", "problems"), "x"
        )]}, "damaged: ValueError invalid literal"),
    ],
)  # fmt: skip
def test_a_damaged_file_is_told_by_name(
    tmp_path: Path, change: dict[str, object], words: str
) -> None:
    session = session_of(tmp_path, armed())
    path = session.folder / "rom.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(TakeError) as caught:
        load_state(session, prompts())
    assert str(caught.value).startswith(str(path))
    assert words in str(caught.value)


def test_a_folder_that_a_crash_left_is_told_though_nothing_was_written_down(
    tmp_path: Path,
) -> None:
    session = session_of(tmp_path, armed())
    for name in ("smile_001.partial", "smile_x.partial", ".partial-1-smile_002"):
        (session.folder / "takes" / name).mkdir()
    loaded, told = load_state(session, prompts())
    [cut] = loaded.takes
    assert (cut.name, cut.slate, cut.number, cut.phase) == (
        "smile_001", "smile", 1, TakePhase.FAILED,
    )  # fmt: skip
    assert told == (
        "smile_001: The program ended before it was written and read back; run `likeness recover`.",
    )


def test_a_take_that_cannot_be_read_is_told_and_the_session_goes_on(tmp_path: Path) -> None:
    session = session_of(tmp_path, armed())
    (session.folder / "takes" / "smile_001").mkdir()
    (session.folder / "takes" / "smile_001" / "take.json").write_text("{")
    loaded, told = load_state(session, prompts())
    assert loaded.takes == ()
    assert told[-1].startswith("A take cannot be read: ")
    assert "smile_001/take.json: not readable as JSON" in told[-1]


def test_takes_on_disk_that_nobody_knows_are_taken_up(tmp_path: Path) -> None:
    with Rehearsal(tmp_path / "s").conductor() as conductor:
        arm(conductor)
        take(conductor)
        until(conductor, quiet)
    (tmp_path / "s/rom.json").unlink()
    loaded, told = load_state(Session.open(tmp_path / "s"), short_list())
    assert told == ("neutral_001 stands on the disk and is taken up; decide about it.",)
    assert [(each.name, each.colour, each.phase, each.status) for each in loaded.takes] == [
        ("neutral_001", Colour.GREEN, TakePhase.DONE, TakeStatus.KEEP)
    ]
    # One that was cut short and has been recovered since is whole again.
    cut = TakeState(name="neutral_001", slate="neutral", number=1, phase=TakePhase.RECORDING)
    save_document(Session.open(tmp_path / "s"), as_document(short_list(), RomState(takes=(cut,))))
    loaded, _told = load_state(Session.open(tmp_path / "s"), short_list())
    assert [(each.phase, each.problems) for each in loaded.takes] == [(TakePhase.DONE, ())]


_PROGRAM = """
import sys, time
from pathlib import Path
from tests.capture.rom.stage import Rehearsal, arm, begin, quiet, short_list, take, until
stand = Rehearsal(Path(sys.argv[1]))
with stand.conductor() as conductor:
    arm(conductor)
    take(conductor)
    until(conductor, quiet)
    conductor.note("neutral_001", "half a wor")
with Rehearsal(Path(sys.argv[1]), prompts=short_list(total_s=60.0)).conductor() as conductor:
    arm(conductor)
    begin(conductor)
    print("now", flush=True)
    time.sleep(60)
"""


def test_a_program_killed_while_it_records_is_taken_up(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", _PROGRAM, str(tmp_path / "s")],
        stdout=subprocess.PIPE, text=True, cwd=Path(__file__).resolve().parents[3],
    )  # fmt: skip
    assert process.stdout is not None
    assert process.stdout.readline() == "now\n"
    os.kill(process.pid, signal.SIGKILL)
    process.stdout.close()
    process.wait()
    with Rehearsal(tmp_path / "s").conductor() as conductor:
        view = conductor.view()
        assert (view.prompt.slate, view.stage) == ("smile", Stage.IDLE)
        assert [(each.name, each.colour) for each in view.takes] == [
            ("neutral_001", Colour.GREEN), ("smile_001", Colour.RED),
        ]  # fmt: skip
        assert view.takes[0].note.text == "half a wor"
        assert view.undecided == ("smile_001",)
        assert conductor.key(Key.RETAKE) == ""
        arm(conductor)
        view = take(conductor)
        assert view.takes[-1].name == "smile_002"  # what the crash left is never overwritten
    assert read_events(tmp_path / "s/events.jsonl").problems == ()


def test_a_disk_that_takes_nothing_more_is_told_once_and_the_session_goes_on(
    tmp_path: Path,
) -> None:
    with Rehearsal(tmp_path / "s", keep_green=False).conductor() as conductor:
        arm(conductor)
        take(conductor)
        view = until(conductor, quiet)
        notes = tmp_path / "s/notes"
        for path in notes.glob("*"):
            path.unlink()
        if notes.exists():
            notes.rmdir()
        notes.write_text("in the way", encoding="utf-8")
        assert conductor.key(Key.KEEP) == ""
        until(conductor, lambda view: "not written" in view.messages[-1].text)
        for _ in range(5):
            conductor.tick()
        view = conductor.view()
        told = [message for message in view.messages if "not written" in message.text]
        assert len(told) == 1
        assert told[0].colour == Colour.RED
        assert view.takes[0].note.status == TakeStatus.KEEP
        assert conductor.note("neutral_001", "x").startswith(str(notes))
        notes.unlink()
    kept = NoteBook.of_session(tmp_path / "s").read("neutral_001")
    assert (kept.status, kept.text) == (TakeStatus.KEEP, "x")


def test_the_document_of_a_state_holds_no_decision() -> None:
    state = taken(armed(), "neutral_001")
    document = as_document(prompts(), state)
    assert "keep" not in json.dumps(document)
    assert document["prompt"] == SLATES[1]
