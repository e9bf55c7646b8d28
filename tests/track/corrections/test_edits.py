"""Steps of correcting: each can be undone and done again, and leaves nothing behind."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from capture.errors import InputError, TakeError
from tests.track.corrections.patch_subject import EVERY, SUBJECT, locked
from track.corrections.edits import Change, add, lock, redo, remove, undo
from track.corrections.entries import Anchor, Curve, Pin, Remarks
from track.corrections.sidecar import FILE, read_book

PIN = Pin(frame=2, corners=(100,), barycentric=(1.0,), pixels={"cam01": (40.0, 50.0)})


def stored(folder: Path) -> list[object]:
    return [entry.what for entry in read_book(folder, SUBJECT).entries]


def test_corrections_get_ids_in_order_and_are_added_once(tmp_path: Path) -> None:
    made = add(tmp_path, SUBJECT, EVERY, Remarks(by="me")).came
    assert [entry.id for entry in made] == [1, 2, 3, 4, 5, 6]
    assert all(entry.remarks.by == "me" for entry in made)
    before = (tmp_path / FILE).read_bytes()
    assert add(tmp_path, SUBJECT, EVERY) == Change()
    assert (tmp_path / FILE).read_bytes() == before


def test_the_same_steps_give_the_same_bytes(tmp_path: Path) -> None:
    contents = []
    for name in ("one", "two"):
        add(tmp_path / name, SUBJECT, EVERY)
        lock(tmp_path / name, SUBJECT, {7: locked(1)})
        undo(tmp_path / name, SUBJECT)
        redo(tmp_path / name, SUBJECT)
        files = sorted((tmp_path / name).rglob("*"))
        contents.append([(p.name, p.read_bytes()) for p in files if p.is_file()])
    assert contents[0] == contents[1]
    assert len(contents[0]) == 2


def test_a_pin_of_a_pinned_point_moves_it_view_by_view(tmp_path: Path) -> None:
    add(tmp_path, SUBJECT, [replace(PIN, pixels={"cam00": (1.0, 2.0), "cam01": (3.0, 4.0)})])
    add(tmp_path, SUBJECT, [replace(PIN, pixels={"cam01": (5.0, 6.0), "cam02": (7.0, 8.0)})])
    merged = {"cam00": (1.0, 2.0), "cam01": (5.0, 6.0), "cam02": (7.0, 8.0)}
    assert stored(tmp_path) == [replace(PIN, pixels=merged)]
    assert add(tmp_path, SUBJECT, [replace(PIN, pixels={"cam00": (1.0, 2.0)})]) == Change()
    add(tmp_path, SUBJECT, [replace(PIN, frame=3), replace(PIN, corners=(101,))])
    assert len(stored(tmp_path)) == 3
    change = undo(tmp_path, SUBJECT)
    assert (len(change.went), change.came) == (2, ())
    undo(tmp_path, SUBJECT)
    assert stored(tmp_path) == [replace(PIN, pixels={"cam00": (1.0, 2.0), "cam01": (3.0, 4.0)})]


def test_a_curve_drawn_again_takes_the_old_one_s_place(tmp_path: Path) -> None:
    curve = EVERY[2]
    assert isinstance(curve, Curve)
    again = replace(curve, pixels=((1.0, 1.0), (9.0, 9.0)))
    add(tmp_path, SUBJECT, [curve, replace(curve, camera="cam03"), again])
    assert stored(tmp_path) == [replace(curve, camera="cam03"), again]
    assert len(read_book(tmp_path, SUBJECT).history) == 1


def test_a_new_step_forgets_what_was_undone(tmp_path: Path) -> None:
    add(tmp_path, SUBJECT, [Anchor(frame=3)])
    undo(tmp_path, SUBJECT)
    add(tmp_path, SUBJECT, [Anchor(frame=4)])
    with pytest.raises(InputError, match="nothing was undone since the last change"):
        redo(tmp_path, SUBJECT)
    assert stored(tmp_path) == [Anchor(frame=4)]


def test_there_must_be_something_to_undo_and_to_remove(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nothing to undo"):
        undo(tmp_path, SUBJECT)
    add(tmp_path, SUBJECT, [Anchor(frame=3)])
    with pytest.raises(InputError, match=r"no correction 2, 9; there are: 1"):
        remove(tmp_path, SUBJECT, [1, 9, 2])
    assert stored(tmp_path) == [Anchor(frame=3)]


def test_what_does_not_fit_is_told_at_once_and_nothing_is_changed(tmp_path: Path) -> None:
    bad = [replace(PIN, frame=70, weight=-1.0), Anchor(frame=3), Anchor(frame=99)]
    with pytest.raises(TakeError) as caught:
        add(tmp_path, SUBJECT, bad)
    assert "3 problems" in str(caught.value)
    assert "pin at frame 70: vertex 100 in cam01: frame 70 is not of the take" in str(caught.value)
    with pytest.raises(TakeError, match="frame 99"):
        lock(tmp_path, SUBJECT, {99: locked(1)})
    assert not list(tmp_path.iterdir())


def test_locks_are_undone_with_their_vertices_and_orphans_are_swept(tmp_path: Path) -> None:
    first, second, third = (locked(seed) for seed in range(3))
    lock(tmp_path, SUBJECT, {4: first})
    lock(tmp_path, SUBJECT, {4: second})
    files = sorted((tmp_path / "corrections").iterdir())
    assert len(files) == 2  # the first one's can come back
    assert len(stored(tmp_path)) == 1
    undo(tmp_path, SUBJECT)
    undo(tmp_path, SUBJECT)
    assert stored(tmp_path) == []
    assert sorted((tmp_path / "corrections").iterdir()) == files
    lock(tmp_path, SUBJECT, {5: third})  # what was undone is forgotten
    assert [p.name[:11] for p in (tmp_path / "corrections").iterdir()] == ["locked_0005"]


MOVES = st.lists(
    st.one_of(
        st.tuples(st.just("add"), st.integers(0, len(EVERY) - 1)),
        st.tuples(st.just("lock"), st.integers(0, 3)),
        st.tuples(st.just("remove"), st.integers(0, 9)),
    ),
    max_size=8,
)


@settings(max_examples=30, deadline=None)
@given(moves=MOVES)
def test_undoing_all_and_doing_it_again_comes_back(
    tmp_path_factory: pytest.TempPathFactory, moves: list[tuple[str, int]]
) -> None:
    folder = tmp_path_factory.mktemp("moves")
    states = [read_book(folder, SUBJECT).entries]
    for kind, number in moves:
        if kind == "add":
            add(folder, SUBJECT, [EVERY[number]])
        elif kind == "lock":
            lock(folder, SUBJECT, {1 + number: locked(number)})
        elif entries := read_book(folder, SUBJECT).entries:
            remove(folder, SUBJECT, [entries[number % len(entries)].id])
        states.append(read_book(folder, SUBJECT).entries)
    whole = (folder / FILE).read_bytes() if (folder / FILE).exists() else b""
    steps = len(read_book(folder, SUBJECT).history)
    distinct = [state for n, state in enumerate(states) if n == 0 or state != states[n - 1]]
    assert steps == len(distinct) - 1
    for state in reversed(distinct[:-1]):
        undo(folder, SUBJECT)
        assert read_book(folder, SUBJECT).entries == state
    for state in distinct[1:]:
        redo(folder, SUBJECT)
        assert read_book(folder, SUBJECT).entries == state
    assert whole == ((folder / FILE).read_bytes() if steps else b"")
