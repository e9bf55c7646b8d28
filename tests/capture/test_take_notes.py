"""Notes of takes: written whole at every change, read strictly, beside the takes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from capture.errors import TakeError, WorkError
from capture.judgement import Colour
from capture.take_notes import NoteBook, OperatorNote, Overrule, TakeStatus

NOTE = OperatorNote(
    status=TakeStatus.KEEP,
    decided_by="operator",
    rating=4,
    text="blinked at the end, très bien, still lovely\nsecond line",
    overruled=Overrule(colour=Colour.RED, sentence="3 lost.", reason="all at the neck"),
)


def test_a_note_comes_back_as_it_was_written(tmp_path: Path) -> None:
    book = NoteBook.of_session(tmp_path)
    assert book.read("smile_001") == OperatorNote()
    book.write("smile_001", NOTE)
    assert (tmp_path / "notes" / "smile_001.json").is_file()
    assert book.read("smile_001") == NOTE
    assert NoteBook.of_session(tmp_path).all() == {"smile_001": NOTE}


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    st.builds(
        OperatorNote,
        status=st.sampled_from(TakeStatus),
        rating=st.integers(0, 5),
        text=st.text(max_size=200) | st.just("\udce4"),
    )
)
def test_any_note_comes_back(tmp_path: Path, note: OperatorNote) -> None:
    book = NoteBook.of_session(tmp_path)
    book.write("smile_001", note)
    assert book.read("smile_001") == note


def test_every_keystroke_leaves_a_whole_note(tmp_path: Path) -> None:
    book, text = NoteBook.of_session(tmp_path), "blinked twice"
    for end in range(len(text) + 1):
        book.write("smile_001", replace(NOTE, text=text[:end]))
        assert book.read("smile_001").text == text[:end]
    assert [path.name for path in (tmp_path / "notes").iterdir()] == ["smile_001.json"]


def test_a_note_that_cannot_be_written_leaves_the_old_one(tmp_path: Path) -> None:
    book = NoteBook.of_session(tmp_path)
    (tmp_path / "notes").write_text("a file where the folder should be", encoding="utf-8")
    with pytest.raises(WorkError, match=r"smile_001\.json: not written: "):
        book.write("smile_001", NOTE)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"format": "likeness-take"}, 'expected "format": "likeness-note"'),
        ({"version": 2}, "written in format version 2, this program reads up to 1"),
        ({"status": "keeep"}, "damaged note: 'keeep' is not a valid TakeStatus"),
        ({"rating": 6}, "rating must be 0 to 5, found 6"),
        ({"rating": True}, "rating: expected a whole number, found True"),
        ({"text": 3}, "text: expected a text, found 3"),
        ({"overruled": {"colour": "red"}}, "damaged note"),
        ({"overruled": 3}, "damaged note"),
        ({"txet": ""}, "unknown key 'txet'; did you mean 'text'?"),
    ],
)
def test_a_damaged_note_is_told_by_name(
    tmp_path: Path, change: dict[str, object], words: str
) -> None:
    book = NoteBook.of_session(tmp_path)
    book.write("smile_001", NOTE)
    path = tmp_path / "notes" / "smile_001.json"
    document = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps(document | change), encoding="utf-8")
    with pytest.raises(TakeError) as caught:
        book.read("smile_001")
    assert str(caught.value).startswith(str(path))
    assert words in str(caught.value)


@pytest.mark.parametrize("take", ["../smile_001", "", ".hidden", "a/b", "x" * 65])
def test_names_that_leave_the_folder_are_refused(tmp_path: Path, take: str) -> None:
    with pytest.raises(TakeError, match="expected the name of a take"):
        NoteBook.of_session(tmp_path).write(take, NOTE)


def test_a_rating_out_of_range_is_refused() -> None:
    with pytest.raises(TakeError, match="rating must be 0 to 5, found -1"):
        OperatorNote(rating=-1)
