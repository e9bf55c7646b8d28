"""Benchmark of the rig stage: python -m tools.bench.rig [speed|known|em|cases|pixels|all]

speed   updates, weights, QPs, Menzel, EBFR and Hable against the printed systems (goals 1, 2, 5, 6)
known   every method with known weights against the truth, on two testbeds (goal 4)
em      unknown weights on the testbeds, with default settings (goal 3)
cases   hidden rigs of SHARED/tools/make_rig_case.py through `likeness rig` and score_rig.py
pixels  takes of SHARED/tools/render_take.py, tracked, and a held-out expression reproduced

One JSON line a measurement; with --table a table follows. Seconds are of wall clock: run it on a
quiet machine. What needs SHARED, or a package of the extra `bench`, says so and is left out.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from tools.bench.rig_beds import BEDS, seeds_of
from tools.bench.rig_cases import case_lines, em_lines
from tools.bench.rig_instances import ict_path
from tools.bench.rig_known import known_lines, methods
from tools.bench.rig_known_speed import hable_line, position_lines
from tools.bench.rig_pixels import make_takes, pixel_lines
from tools.bench.rig_speed import UPDATES, qp_line, speed_template, update_lines, weights_line

Line = dict[str, Any]
_PARTS = ("speed", "known", "em", "cases", "pixels")
_SEEDS = {"known": "101-103", "em": "101-102", "cases": "101-102", "pixels": "1"}
_SHAPES = {"known": 51, "em": 35}


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the lines of the parts asked for."""
    options = _parse(arguments)
    parts = _PARTS if options.part == "all" else (options.part,)
    rows: list[Line] = []
    for part in parts:
        for line in _lines(part, options):
            print(json.dumps(line), flush=True)
            rows.append(line)
    if options.table:
        print(table(rows))
    return 0


def table(rows: Sequence[Line]) -> str:
    """The lines as text, one block a goal, columns in the order in which keys come."""
    blocks = []
    for goal in dict.fromkeys(str(row["goal"]) for row in rows):
        own = [row for row in rows if str(row["goal"]) == goal]
        keys = list(dict.fromkeys(key for row in own for key in row if key != "goal"))
        cells = [keys, *([_cell(row.get(key, "")) for key in keys] for row in own)]
        widths = [max(len(line[k]) for line in cells) for k in range(len(keys))]
        text = [
            "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
            for line in cells
        ]
        blocks.append("\n".join([f"\n{goal}", *text]))
    return "\n".join(blocks)


def _cell(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _lines(part: str, options: argparse.Namespace) -> Iterator[Line]:
    shared: Path = options.shared
    there = ict_path(shared).exists()
    if part in ("cases", "pixels") and not there:
        yield {"goal": part, "skipped": f"{shared} has no data/ict: give --shared"}
    elif part == "speed":
        yield from _speed(options, there)
    elif part == "cases":
        seeds = list(seeds_of(options.seeds or _SEEDS[part]))
        with tempfile.TemporaryDirectory() as scratch:
            folder = options.folder or Path(scratch)
            told = options.case_arguments.split()
            for method in options.methods.split(","):
                yield from case_lines(
                    seeds, told, shared, folder, "" if method == "unknown" else method
                )
    elif part == "pixels":
        folder = options.folder or Path(tempfile.gettempdir()) / "rig_pixels"
        make_takes(folder, shared)
        yield from pixel_lines(folder, shared, list(seeds_of(options.seeds or _SEEDS[part])))
    else:
        yield from _beds(part, options, there)


def _speed(options: argparse.Namespace, there: bool) -> Iterator[Line]:
    shared: Path = options.shared
    cases = tuple(options.updates.split(",")) if there else UPDATES[:1]
    yield from update_lines(shared, cases, literal=options.literal)
    template = speed_template(shared if there else None)
    yield weights_line(template, options.frames)
    for active in (3, 20):
        yield qp_line(template, active)
    if there:
        yield from position_lines(shared)
        yield hable_line(shared, literal=options.literal)
    else:
        yield {"goal": "speed", "skipped": f"{shared} has no data/ict: give --shared for the rest"}


def _beds(part: str, options: argparse.Namespace, there: bool) -> Iterator[Line]:
    seeds = list(seeds_of(options.seeds or _SEEDS[part]))
    shapes = options.shapes or _SHAPES[part]
    chosen = methods(options.quick, options.oracle)
    for bed in BEDS if options.bed == "both" else (options.bed,):
        if bed == "ict" and not there:
            yield {"goal": part, "bed": bed, "skipped": f"{options.shared} has no data/ict"}
        elif part == "known":
            yield from known_lines(bed, seeds, shapes, options.shared, chosen)
        else:
            yield from em_lines(bed, seeds, shapes, options.poses, options.shared)


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m tools.bench.rig", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    add = parser.add_argument
    add("part", nargs="?", choices=[*_PARTS, "all"], default="all")
    add("--shared", type=Path, default=Path("../shared"), help="folder with data and tools")
    add("--table", action="store_true", help="print a table at the end")
    add("--seeds", default="", help='actors, such as "101-103,7" (known, em, cases, pixels)')
    add("--folder", type=Path, default=None, help="where cases or takes are kept")
    add("--bed", choices=[*BEDS, "both"], default="both", help="known, em")
    add("--shapes", type=int, default=0, help="known, em; 51 and 35 when left out")
    add("--poses", type=int, default=63, help="em")
    add("--quick", action="store_true", help="known: one strength a method, no sweeps")
    add("--oracle", action="store_true", help="known: hold-out, and our own strengths swept")
    add("--updates", default=",".join(UPDATES), help="speed: which instances")
    add("--frames", type=int, default=1000, help="speed: of the take of goal 2")
    add("--no-literal", dest="literal", action="store_false", help="speed: ours alone")
    add(
        "--methods", default="unknown,ma,hable,menzel,ebfr,transfer",
        help="cases: methods that are told the true weights, and unknown: not told",
    )  # fmt: skip
    add(
        "--case-arguments", default="--shapes 35 --poses 63",
        help='cases: as make_rig_case.py takes them, "--smooth .5 --holes .1"',
    )  # fmt: skip
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
