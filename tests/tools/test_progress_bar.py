from __future__ import annotations

import io

from tools.progress_bar import ProgressBar


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_plain_lines_where_there_is_no_terminal() -> None:
    stream = io.StringIO()
    bar = ProgressBar(stream)
    for done in range(1, 4):
        bar(done, 3, "scan")
    bar(1, 1, "mesh")
    lines = stream.getvalue().splitlines()
    assert lines[-2].startswith("scan: 3/3")
    assert lines[-1].startswith("mesh: 1/1")
    assert "\r" not in stream.getvalue()


def test_a_bar_with_rate_on_a_terminal() -> None:
    stream = Terminal()
    bar = ProgressBar(stream)
    for done in range(1, 5):
        bar(done, 4, "scan")
    bar.close()
    text = stream.getvalue()
    assert "\r" in text
    assert "4/4" in text
    assert "it/s" in text or "s/it" in text
