"""opening.json: all that recovery needs, or a refusal with its path."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from capture.errors import TakeError
from capture.frame_header import ImageLayout
from capture.opening import Opening, read_opening, write_opening

OPENING = Opening(
    name="smile_003",
    devices={"cam01": ImageLayout(8, 4, 3, "uint8"), "cam00": ImageLayout(6, 4, 1, "uint16")},
    expected_frames=150,
    recording={"shot": {"slate": "smile"}, "train": {"start_ns": 5, "period_ns": 7}},
)


def test_it_comes_back_as_it_was_devices_in_order(tmp_path: Path) -> None:
    write_opening(tmp_path / "opening.json", OPENING)
    found = read_opening(tmp_path / "opening.json")
    assert found == OPENING
    assert list(found.devices) == ["cam01", "cam00"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d.update(version=2), "format version 2, this program reads up to 1; update"),
        (lambda d: d.update(format="x"), 'expected "format": "likeness-opening"'),
        (lambda d: d.update(devices=[]), "needs at least one device"),
        (lambda d: d.update(devices=[3]), "damaged"),
        (lambda d: d["devices"][0].update(name="../x"), "device name must be letters"),
        (lambda d: d["devices"][0].update(width="8"), "width must be a whole number, found '8'"),
        (lambda d: d.update(expected_frames=1.5), "expected_frames must be a whole number"),
        (lambda d: d.update(recording=3), "damaged"),
        (lambda d: d.pop("recording"), "missing key 'recording'"),
    ],
)
def test_a_damaged_one_is_refused_by_name(
    tmp_path: Path, change: Callable[[Any], object], words: str
) -> None:
    path = tmp_path / "opening.json"
    write_opening(path, OPENING)
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))
    with pytest.raises(TakeError, match=r"opening\.json: .*" + words):
        read_opening(path)
