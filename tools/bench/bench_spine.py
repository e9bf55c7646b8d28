"""A visiting take through the program: import, recon, track, rig, and the scores of each.

    python -m tools.bench.bench_spine TAKE [TAKE ...] --shared SHARED [--frames 0,6] [--out FOLDER]

TAKE is a visiting take with truth.npz and neutral.obj. SHARED holds tools/score_scan.py,
tools/score_track.py and data/ict/ict_light.npz, from which the template of the rig is made. Every
step is the verb of the program in a process of its own; printed are its seconds of wall clock and
what the score says.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the takes one after another and print one JSON line for each step."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("takes", type=Path, nargs="+")
    parser.add_argument("--shared", type=Path, required=True)
    parser.add_argument("--frames", default="0,6")
    parser.add_argument("--out", type=Path, default=None, help="kept there; else thrown away")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.out if options.out is not None else Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        template = folder / "template.npz"
        source = options.shared / "data" / "ict" / "ict_light.npz"
        _run([sys.executable, "-m", "tools.make_template", "ict", str(source), str(template)])
        for take in options.takes:
            _spine(take, folder / take.name, template, options)
    return 0


def _spine(source: Path, out: Path, template: Path, options: argparse.Namespace) -> None:
    take = out / "take"
    scores = options.shared / "tools"
    _verb(source.name, "import", [str(source), "--out", str(take)])
    _verb(source.name, "recon", [str(take), "--frames", options.frames])
    for frame in options.frames.split(","):
        scan = take / "products" / "recon" / f"frame_{int(frame):04d}.ply"
        words = [str(scores / "score_scan.py"), str(source), frame, str(scan)]
        _tell(source.name, f"score scan {frame}", _run([sys.executable, *words]))
    _verb(source.name, "track", [str(take), "--neutral", str(source / "neutral.obj")])
    performance = take / "products" / "track" / "performance.npz"
    words = [str(scores / "score_track.py"), str(source / "truth.npz"), str(performance)]
    _tell(source.name, "score track", _run([sys.executable, *words]))
    words = ["--template", str(template), "--performance", str(performance)]
    _verb(source.name, "rig", [*words, "--out", str(out / "rig")])


def _verb(take: str, verb: str, words: list[str]) -> None:
    start = time.monotonic()
    report = _run([sys.executable, "-m", "tools.cli", verb, *words, "--json"])
    plain = {k: v for k, v in report.items() if isinstance(v, int | float | bool)}
    _tell(take, verb, {"seconds": round(time.monotonic() - start, 1), **plain})


def _run(command: list[str]) -> dict[str, Any]:
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    found: dict[str, Any] = json.loads(done.stdout) if done.stdout.startswith("{") else {}
    return found


def _tell(take: str, step: str, found: dict[str, Any]) -> None:
    print(json.dumps({"take": take, "step": step, **found}), flush=True)


if __name__ == "__main__":
    raise SystemExit(main())
