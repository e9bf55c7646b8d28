"""Runs ruff, mypy and import-linter: the one script that CI and contributors both call."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

_CHECKS = (
    ("ruff check", ["-m", "ruff", "check", "."]),
    ("ruff format", ["-m", "ruff", "format", "--check", "."]),
    ("mypy", ["-m", "mypy"]),
    ("import-linter", ["-c", "from importlinter.cli import lint_imports_command as c; c()"]),
)


def main() -> int:
    """Run every check, print the output of those that fail, return how many failed."""
    root = Path(__file__).resolve().parents[1]
    failed = 0
    for name, words in _CHECKS:
        done = subprocess.run(
            [sys.executable, *words], cwd=root, capture_output=True, text=True, check=False
        )
        print(f"{name}: {'ok' if done.returncode == 0 else 'FAILED'}")
        if done.returncode != 0:
            print(done.stdout + done.stderr)
            failed += 1
    return failed


if __name__ == "__main__":
    raise SystemExit(main())
