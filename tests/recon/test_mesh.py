"""OBJ files: the line that does not fit is named."""

from __future__ import annotations

from pathlib import Path

import pytest

from capture.errors import TakeError
from recon.mesh import read_obj

SOUND = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (SOUND + "v 1 2\nf 1 2 3\n", r":4: .*3 numbers are needed, found 2"),
        (SOUND + "vt 1\nf 1/1 2/1 3/1\n", r":4: .*2 numbers are needed, found 1"),
        (SOUND + "v 0 0 9\nv 0 9 0\nf 1 2 3 4 5\n", r":6: .*3 or 4 corners are supported, found 5"),
        (SOUND + "f 1 2 9\n", r":4: .*index 9 of 3"),
        (SOUND + "f 1 2 -4\n", r":4: .*index -4 of 3"),
        (SOUND + "v 0 0 nan\nf 1 2 3\n", r"finite numbers, found 1"),
        (SOUND, r"expected vertices and faces, found 3 and 0"),
    ],
)
def test_a_line_that_does_not_fit_is_named(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "head.obj"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(TakeError, match=r"head\.obj.*" + words):
        read_obj(path)
