"""JSON and TOML files: whatever is wrong with one is an InputError that names it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from capture.camera_file import read_cameras
from capture.documents import plain_json, read_document, read_json, read_toml
from capture.errors import CameraError, SettingsError, TakeError
from capture.ledger import Verdict, read_ledger
from capture.manifest import read_manifest
from capture.settings import read_settings

FAULTS = {
    "nested": b"[" * 200_000,
    "a long number": b'{"a": ' + b"1" * 5000 + b"}",
    "not text": b"\xff\xfe\x00",
    "cut": b'{"a": ',
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faulty_json_is_refused_with_its_path(tmp_path: Path, fault: str) -> None:
    path = tmp_path / "one.json"
    path.write_bytes(FAULTS[fault])
    with pytest.raises(TakeError, match=r"one\.json: not readable as JSON"):
        read_json(path, TakeError)
    with pytest.raises(CameraError, match=r"one\.json"):
        read_cameras(path)
    with pytest.raises(TakeError, match=r"one\.json"):
        read_manifest(path)


def test_faulty_toml_is_refused_with_its_path(tmp_path: Path) -> None:
    path = tmp_path / "one.toml"
    for text in ("a = " + "[" * 100_000, "a = " + "1" * 5000, "a ="):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(SettingsError, match=r"one\.toml: not readable as TOML"):
            read_toml(path, SettingsError)
        with pytest.raises(SettingsError, match=r"one\.toml"):
            read_settings(path, {})


def test_a_missing_file_is_told_in_the_words_of_the_caller(tmp_path: Path) -> None:
    with pytest.raises(TakeError, match=r"none\.json: run that first"):
        read_json(tmp_path / "none.json", TakeError, absent="run that first")
    with pytest.raises(TakeError, match=r"Is a directory"):
        read_json(tmp_path, TakeError)


@pytest.mark.parametrize(
    ("document", "words"),
    [
        ([1], 'expected "format": "likeness-x"'),
        ({"format": "likeness-y", "version": 1}, 'expected "format": "likeness-x"'),
        ({"format": "likeness-x"}, "version must be a whole number, found None"),
        ({"format": "likeness-x", "version": True}, "version must be a whole number, found True"),
        ({"format": "likeness-x", "version": 0}, "version must be a whole number, found 0"),
        ({"format": "likeness-x", "version": 4}, "written in format version 4, this program reads"),
    ],
)
def test_a_document_of_another_kind_or_a_newer_one_is_refused(
    tmp_path: Path, document: object, words: str
) -> None:
    path = tmp_path / "one.json"
    path.write_text(json.dumps(document))
    with pytest.raises(TakeError) as caught:
        read_document(path, "likeness-x", 3, TakeError)
    assert str(caught.value).startswith(f"{path}: {words}")
    for version in (1, 2, 3):
        path.write_text(json.dumps({"format": "likeness-x", "version": version}))
        assert read_document(path, "likeness-x", 3)["version"] == version


def test_plain_json_is_what_reading_it_back_gives() -> None:
    value = {"a": (1, 2.5, float("nan")), "b": Verdict.OK, "c": {"d": [float("inf"), True, None]}}
    plain = plain_json(value)
    assert plain == {"a": [1, 2.5, None], "b": "ok", "c": {"d": [None, True, None]}}
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain


def test_a_ledger_that_claims_more_than_memory_holds_is_refused(tmp_path: Path) -> None:
    head = "trigger_index,device,verdict,frame_id,t_dev_ns,t_host_ns,t_ns,note\n"
    path = tmp_path / "ledger.csv"
    path.write_text(head + "999999999999,cam00,ok,1,1,1,1,\n", encoding="utf-8")
    with pytest.raises(TakeError, match="1000000000000 triggers"):
        read_ledger(path)
    path.write_text(head + "0,cam00,ok,1,1,1,1," + "a" * 200_000 + "\n", encoding="utf-8")
    with pytest.raises(TakeError, match="not readable"):
        read_ledger(path)
