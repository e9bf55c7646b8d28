"""Archives: the same bytes twice, never unpickled, named when damaged."""

from __future__ import annotations

import struct
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from capture.archive import read_archive, whole_numbers, write_archive
from capture.errors import ShapeError
from tests.capture.refusals import refusal

ARRAYS = {"a": np.arange(6, dtype=np.float32).reshape(2, 3), "names": np.array(["x", "yy"])}


def test_the_round_trip_is_exact_and_the_bytes_are_the_same_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_archive(tmp_path / "one.npz", ARRAYS)
    monkeypatch.setattr(time, "time", lambda: 2e9)
    write_archive(tmp_path / "two.npz", ARRAYS)
    assert (tmp_path / "one.npz").read_bytes() == (tmp_path / "two.npz").read_bytes()
    back = read_archive(tmp_path / "one.npz", ["a"], optional=["names", "absent"])
    assert sorted(back) == ["a", "names"]
    assert back["a"].dtype == np.float32
    assert np.array_equal(back["a"], ARRAYS["a"])
    assert back["names"].tolist() == ["x", "yy"]


def test_a_pickled_array_is_refused_and_not_run(tmp_path: Path) -> None:
    class Trap:
        def __reduce__(self) -> tuple[object, ...]:
            return (Path.touch, (tmp_path / "sprung",))

    np.savez(tmp_path / "evil.npz", a=np.array([Trap()], dtype=object))
    with pytest.raises(ShapeError, match=r"evil.npz: a cannot be read"):
        read_archive(tmp_path / "evil.npz", ["a"])
    assert not (tmp_path / "sprung").exists()


def test_missing_keys_files_and_numbers_are_named(tmp_path: Path) -> None:
    write_archive(tmp_path / "one.npz", ARRAYS | {"bad": np.array([0.0, np.nan])})
    with pytest.raises(ShapeError, match="missing b, c; it holds a, names, bad"):
        read_archive(tmp_path / "one.npz", ["a", "b", "c"])
    with pytest.raises(ShapeError, match="bad holds 1 number"):
        read_archive(tmp_path / "one.npz", ["bad"])
    with pytest.raises(ShapeError, match="no such file"):
        read_archive(tmp_path / "two.npz", ["a"])
    np.save(tmp_path / "single.npy", np.zeros(3))
    with pytest.raises(ShapeError, match=r"expected an \.npz archive"):
        read_archive(tmp_path / "single.npy", ["a"])


@settings(max_examples=120, deadline=None)
@given(data=st.data())
def test_damaged_bytes_are_refused_and_never_crash(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("archive") / "one.npz"
    write_archive(path, ARRAYS)
    whole = bytearray(path.read_bytes())
    if data.draw(st.booleans()):
        whole = whole[: data.draw(st.integers(0, len(whole) - 1))]
    else:
        whole[data.draw(st.integers(0, len(whole) - 1))] ^= data.draw(st.integers(1, 255))
    path.write_bytes(bytes(whole))
    said = refusal(lambda: read_archive(path, ["a", "names"]))  # damage to unread bytes may pass
    assert not said or "one.npz" in said


def test_text_complex_numbers_and_fractions_are_refused_where_numbers_are_due(
    tmp_path: Path,
) -> None:
    np.savez(tmp_path / "odd.npz", a=np.array(["1.5"]), b=np.array([1j]), names=np.array([1]))
    for key, words in (("a", "real numbers"), ("b", "real numbers"), ("names", "text")):
        with pytest.raises(ShapeError, match=f"odd.npz: {key} must hold {words}"):
            read_archive(tmp_path / "odd.npz", [key])
    assert whole_numbers(np.array([1.0, -1.0]), "polygons").tolist() == [1, -1]
    for wrong in ([0.5], [2.0**40], [np.nan]):
        with pytest.raises(ShapeError, match="polygons: whole numbers"):
            whole_numbers(np.array(wrong), "polygons")


def test_an_array_that_claims_more_than_is_read_is_refused_before_it_is_made(
    tmp_path: Path,
) -> None:
    path = tmp_path / "bomb.npz"
    write_archive(path, {"a": np.zeros(8)})
    data = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        entry = archive.getinfo("a.npy")
    place = data.rindex(b"PK\x01\x02")  # its line in the central directory
    claimed = struct.pack("<I", entry.file_size)
    at = data.index(claimed, place + 24)
    assert at == place + 24
    path.write_bytes(data[:at] + struct.pack("<I", 0xFFFFFFFE) + data[at + 4 :])
    with pytest.raises(ShapeError, match=r"bomb\.npz: a claims 4294967294 bytes"):
        read_archive(path, ["a"], largest_bytes=1 << 30)
