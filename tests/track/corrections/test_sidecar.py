"""corrections.json: read back as written, and refused by the place of whatever does not fit."""

from __future__ import annotations

import copy
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from capture.errors import InputError, TakeError
from tests.track.corrections.patch_subject import EVERY, MESH, SUBJECT, TRIANGLE, locked
from tests.track.moving_patch import patch_array, patch_mesh
from track.corrections.entries import Entry, Lock, Remarks
from track.corrections.sidecar import (
    FILE,
    Book,
    Step,
    lock_of,
    locked_path,
    read_book,
    read_locked,
    write_book,
    write_locked,
)

REMARKS = Remarks(by="Ånn", time="Tuesday", note='lip "stuck"')


def whole_book() -> Book:
    entries = tuple(Entry(id=n + 1, what=what) for n, what in enumerate(EVERY))
    gone = Entry(id=20, what=lock_of(4, locked(0)), remarks=REMARKS)
    again = Entry(id=30, what=EVERY[5].__class__(frame=7), remarks=REMARKS)
    return Book(
        entries=entries,
        history=(
            Step(numbers=(1, 20)),
            Step(entries=(gone,)),
            Step(numbers=(2, 3)),
        ),
        undone=(Step(numbers=(6,), entries=(again,)),),
    )


def written(folder: Path) -> dict[str, Any]:
    write_book(folder, whole_book(), SUBJECT)
    document: dict[str, Any] = json.loads((folder / FILE).read_text(encoding="utf-8"))
    return document


def refused(folder: Path, document: Any) -> str:
    (folder / FILE).write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(TakeError) as caught:
        read_book(folder, SUBJECT)
    message = str(caught.value)
    assert message.startswith(str(folder / FILE))
    return message


def test_a_take_without_the_file_has_no_corrections(tmp_path: Path) -> None:
    assert read_book(tmp_path, SUBJECT) == Book()


def test_what_is_written_is_read_back_and_written_to_the_same_bytes(tmp_path: Path) -> None:
    write_book(tmp_path, whole_book(), SUBJECT)
    first = (tmp_path / FILE).read_bytes()
    assert read_book(tmp_path, SUBJECT) == whole_book()
    write_book(tmp_path, read_book(tmp_path, SUBJECT), SUBJECT)
    assert (tmp_path / FILE).read_bytes() == first
    assert [p.name for p in tmp_path.iterdir()] == [FILE]


def test_a_file_with_entries_alone_is_enough(tmp_path: Path) -> None:
    document = written(tmp_path)
    for key in ("history", "undone", "mesh"):
        del document[key]
    (tmp_path / FILE).write_text(json.dumps(document), encoding="utf-8")
    assert read_book(tmp_path, SUBJECT) == Book(entries=whole_book().entries)


ENTRY_FAULTS: list[tuple[int, dict[str, Any], str]] = [
    (0, {"frame": 10}, r"entries\[0\]: frame 10 is not of the take, which has 0\.\.9"),
    (0, {"frame": 2.5}, r"entries\[0\]: frame: expected a whole number, found 2\.5"),
    (0, {"frame": True}, r"frame: expected a whole number, found True"),
    (0, {"frame": 10**400}, r"frame: expected a whole number"),
    (0, {"frame": None}, r"frame: expected a whole number, found None"),
    (0, {"vertex": 361}, r"no vertex 361; the mesh has 0\.\.360"),
    (0, {"vertex": -1}, r"no vertex -1"),
    (0, {"triangle": [0, 1, 2]}, r"either vertex, or triangle and barycentric"),
    (0, {"pixels": {}}, r"at least one camera"),
    (0, {"pixels": {"cam9": [1, 2]}}, r"no camera 'cam9'; did you mean"),
    (0, {"pixels": {"cam00": [1, 2, 3]}}, r"pixels: expected an object .*found"),
    (0, {"pixels": {"cam00": [float("nan"), 2]}}, r"pixels: expected an object"),
    (0, {"pixels": {"cam00": [200.0, 3.0]}}, r"pixel 200, 3 lies outside .*cam00, 200 x 200 px"),
    (0, {"weight": 0}, r"weight must be above 0 and at most 1000, found 0"),
    (0, {"weight": "much"}, r"weight: expected a finite number, found 'much'"),
    (0, {"wieght": 1}, r"unknown key 'wieght'; did you mean 'weight'"),
    (0, {"kind": "pun"}, r"no kind 'pun'; did you mean 'pin'"),
    (0, {"kind": ["pin"]}, r"kind: expected text, found \['pin'\]"),
    (0, {"id": 0}, r"id 0: expected 1 or more"),
    (0, {"id": 3}, r"id 3 is given twice"),
    (1, {"triangle": [0, 1, 200]}, r"vertices 0, 1, 200 are no triangle of the mesh"),
    (1, {"triangle": [0, 1]}, r"triangle: expected a list of 3 whole numbers, found \[0, 1\]"),
    (1, {"barycentric": [0.5, 0.5, 0.5]}, r"from 0 to 1 of sum 1, found \[0\.5, 0\.5, 0\.5\]"),
    (1, {"barycentric": [1.5, -0.5, 0.0]}, r"from 0 to 1 of sum 1"),
    (2, {"vertices": [4]}, r"a chain of two or more is needed, found 1"),
    (2, {"vertices": [4, 999]}, r"no vertex 999"),
    (2, {"pixels": [[1, 2], [1, 2]]}, r"a line of two or more is needed, found 1"),
    (2, {"pixels": [[1, 2], [1]]}, r"pixels: expected a list of pixels"),
    (2, {"pixels": [[1, 2], [1, -5]]}, r"pixel 1, -5 lies outside"),
    (2, {"camera": "cam7"}, r"no camera 'cam7'"),
    (2, {"chain": " "}, r"chain: a name is needed"),
    (3, {"first": 7}, r"first 7 is after last 6"),
    (3, {"last": 12}, r"last 12 is not of the take"),
    (4, {"first": 0}, r"frame 0 cannot be excluded: it shows the neutral"),
    (5, {"note": 5}, r"note: expected text, found 5"),
]


@pytest.mark.parametrize(("index", "change", "words"), ENTRY_FAULTS)
def test_an_entry_that_does_not_fit_is_refused_by_its_place(
    tmp_path: Path, index: int, change: dict[str, Any], words: str
) -> None:
    document = written(tmp_path)
    document["entries"][index].update(change)
    message = refused(tmp_path, document)
    with pytest.raises(InputError, match=words):
        raise InputError(message)


def test_every_fault_is_told_at_once(tmp_path: Path) -> None:
    document = written(tmp_path)
    document["entries"][0]["frame"] = 77
    del document["entries"][2]["camera"]
    document["history"][1]["removed"][0]["sha256"] = "abc"
    document["colour"] = "red"
    message = refused(tmp_path, document)
    assert "4 problems" in message
    assert "entries[0]: frame 77" in message
    assert "entries[2]: camera is missing; expected text" in message
    assert "history[1].removed[0]: sha256: expected 64 hexadecimal digits, found 'abc'" in message
    assert "unknown key 'colour'" in message


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"version": 2}, "version: 2 is not known; this program reads version 1"),
        ({"format": "likeness-take"}, 'format: expected "likeness-corrections"'),
        ({"entries": {}}, "entries: expected a list of objects"),
        ({"entries": [5]}, "entries: expected a list of objects"),
        ({"mesh": {"vertices": 5, "topology": ""}}, "of 5 vertices, this mesh has 361"),
        ({"mesh": {"vertices": 361, "topology": "x"}}, "another mesh of 361 vertices"),
        ({"mesh": 3}, "mesh: expected an object, found 3"),
        ({"history": [{"added": [99]}]}, "history[0]: there is no entry 99 at that point"),
        ({"history": [{"added": "all"}]}, "history[0]: added: expected a list of whole numbers"),
    ],
)
def test_a_file_of_another_make_is_refused(
    tmp_path: Path, change: dict[str, Any], words: str
) -> None:
    document = written(tmp_path)
    document.update(change)
    assert words in refused(tmp_path, document)


def test_the_worked_example_of_the_documentation_is_read(tmp_path: Path) -> None:
    page = Path(__file__).resolve().parents[3] / "docs" / "corrections.md"
    (block,) = re.findall(r"```json\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    document = json.loads(re.sub(r'"([0-9a-f]{8})\.\.\."', rf'"\g<1>{"0" * 56}"', block))
    del document["mesh"]  # it is of a mesh that nobody has
    mesh = patch_mesh(40)
    subject = replace(
        SUBJECT,
        frames=tuple(range(60)),
        cameras=patch_array(16, 1024),
        vertex_count=len(mesh.vertices),
        triangles=mesh.triangles,
    )
    (tmp_path / FILE).write_text(json.dumps(document), encoding="utf-8")
    book = read_book(tmp_path, subject)
    assert [entry.what.kind for entry in book.entries] == [
        *("pin", "curve", "exclude_frame", "exclude_view", "lock")
    ]
    assert len(book.history) == 5


def test_what_is_no_object_is_refused(tmp_path: Path) -> None:
    assert "expected an object, found a list" in refused(tmp_path, [1])
    (tmp_path / FILE).write_text("{", encoding="utf-8")
    with pytest.raises(TakeError, match="not readable as JSON"):
        read_book(tmp_path, SUBJECT)


def test_contradictions_are_refused(tmp_path: Path) -> None:
    document = written(tmp_path)
    twin = copy.deepcopy(document["entries"][0])
    twin["id"] = 50
    assert "entries 1 and 50 say the same place twice: pin at frame 2: vertex 100" in refused(
        tmp_path, {**document, "entries": [*document["entries"], twin]}
    )
    corner = {
        "id": 51, "kind": "pin", "frame": 3, "triangle": list(TRIANGLE),
        "barycentric": [0.0, 1.0, 0.0], "pixels": {"cam00": [1, 2]},
    }  # fmt: skip
    vertex = {
        "id": 52,
        "kind": "pin",
        "frame": 3,
        "vertex": TRIANGLE[1],
        "pixels": {"cam01": [1, 2]},
    }
    assert "entries 51 and 52 say the same place twice" in refused(
        tmp_path, {**document, "entries": [corner, vertex], "history": [], "undone": []}
    )


def test_two_views_must_be_left(tmp_path: Path) -> None:
    document = {**written(tmp_path), "history": [], "undone": []}
    document["entries"] = [
        {"id": n, "kind": "exclude_view", "camera": f"cam0{n}", "first": 2, "last": 3 + n}
        for n in (1, 2, 3)
    ]
    assert "frame 2: 1 of 4 views are left; two are needed" in refused(tmp_path, document)
    document["entries"].append({"id": 4, "kind": "exclude_frame", "first": 2, "last": 4})
    (tmp_path / FILE).write_text(json.dumps(document), encoding="utf-8")
    assert len(read_book(tmp_path, SUBJECT).entries) == 4  # frame 5 has two again


def test_a_misfit_is_not_written_over_a_good_file(tmp_path: Path) -> None:
    written(tmp_path)
    before = (tmp_path / FILE).read_bytes()
    bad = Book(entries=(Entry(id=1, what=EVERY[5].__class__(frame=99)),))
    with pytest.raises(TakeError, match="entry 1: frame 99 is not of the take"):
        write_book(tmp_path, bad, SUBJECT)
    assert (tmp_path / FILE).read_bytes() == before


def test_locked_vertices_are_kept_bit_by_bit_and_guarded(tmp_path: Path) -> None:
    held = locked(3)
    lock = lock_of(7, held)
    write_locked(tmp_path, lock, held)
    path = locked_path(tmp_path, lock)
    assert path.relative_to(tmp_path).as_posix() == (
        f"corrections/locked_0007_{lock.sha256[:8]}.npz"
    )
    found = read_locked(tmp_path, lock, len(MESH.vertices))
    assert found.vertices.tobytes() == held.vertices.tobytes()
    assert found.confidence.tobytes() == held.confidence.tobytes()
    with pytest.raises(TakeError, match=r"vertices: expected shape \(5 3\)"):
        read_locked(tmp_path, lock, 5)
    with pytest.raises(TakeError, match=r"changed since frame 7 was locked; put it back, or"):
        read_locked(tmp_path, _renamed(tmp_path, lock), len(MESH.vertices))
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(TakeError, match=r"locked_0007.*unlock --frames 7"):
        read_locked(tmp_path, lock, len(MESH.vertices))
    path.unlink()
    with pytest.raises(TakeError, match=r"the vertices of locked frame 7 are gone"):
        read_locked(tmp_path, lock, len(MESH.vertices))


def _renamed(folder: Path, lock: Lock) -> Lock:
    """Another lock whose file holds this one's vertices."""
    other = Lock(frame=7, sha256="0" * 64)
    locked_path(folder, other).write_bytes(locked_path(folder, lock).read_bytes())
    return other


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner),
    max_leaves=12,
)
KEYS = st.sampled_from(
    ("id", "kind", "frame", "vertex", "triangle", "barycentric", "pixels", "weight", "camera")
    + ("chain", "vertices", "first", "last", "sha256", "by", "time", "note", "added", "removed")
)


@settings(max_examples=150, deadline=None)
@given(
    where=st.sampled_from(["entries", "history", "undone"]), index=st.integers(0, 5), key=KEYS,
    value=JSON,
)  # fmt: skip
def test_any_value_anywhere_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, where: str, index: int, key: str, value: Any
) -> None:
    folder = tmp_path_factory.mktemp("any")
    document = written(folder)
    rows = document[where]
    rows[index % len(rows)][key] = value
    (folder / FILE).write_text(json.dumps(document), encoding="utf-8")
    try:
        book = read_book(folder, SUBJECT)
    except TakeError as error:
        message = str(error)
        book = None
    if book is None:
        assert message.startswith(str(folder / FILE))
        return
    write_book(folder, book, SUBJECT)
    again = read_book(folder, SUBJECT)
    assert again.entries == tuple(sorted(book.entries, key=lambda entry: entry.id))


@settings(max_examples=100, deadline=None)
@given(content=JSON | st.binary(max_size=64))
def test_any_file_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, content: Any
) -> None:
    folder = tmp_path_factory.mktemp("any")
    raw = content if isinstance(content, bytes) else json.dumps(content).encode()
    (folder / FILE).write_bytes(raw)
    with pytest.raises(TakeError):
        read_book(folder, SUBJECT)
