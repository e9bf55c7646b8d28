"""Rows of a long bench, kept in a file as they are made, so that a stopped run goes on."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

Row = dict[str, Any]


class RowFile:
    """Rows by a key that says all that went into them; JSON lines on disk, or none.

    A row is appended when it is made and read back by the next run; delete the file after the
    measured code has changed. A last line that was cut short by a stop is left out.

    Args:
        path: the file, made when it is absent; None keeps rows in memory only.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._rows: dict[str, Row] = {}
        if path is not None and path.is_file():
            whole = [
                line
                for line in path.read_text(encoding="utf-8").splitlines(True)
                if line.endswith("\n")
            ]
            for line in whole:
                entry = json.loads(line)
                self._rows[entry["key"]] = entry["row"]
            path.write_text("".join(whole), encoding="utf-8")

    def row(self, key: str, make: Callable[[], Row]) -> Row:
        """The row of that key, made now unless an earlier run made it."""
        if key not in self._rows:
            made = make()
            if self._path is not None:
                self._path.parent.mkdir(parents=True, exist_ok=True)
                with self._path.open("a", encoding="utf-8") as out:
                    out.write(json.dumps({"key": key, "row": made}) + "\n")
            self._rows[key] = made
        return self._rows[key]
