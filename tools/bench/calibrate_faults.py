"""What the calibration says of takes with one fault each, and of good ones."""

from __future__ import annotations

import dataclasses
import re
import time
from collections.abc import Sequence
from functools import partial

from capture.errors import LikenessError
from recon.calibration.alignment import align_to_previous, alignment_problems
from recon.calibration.report import ReportExtras, calibration_report
from recon.calibration.scale_bar import measure_bar
from recon.calibration.solver import CalibrateSettings, solve_array
from tools.bench.bench_rows import Row, RowFile
from tools.bench.calibrate_opponents import failure
from tools.bench.faulty_images import IMAGE_FAULTS, ImageFault, diagnosis
from tools.bench.faulty_takes import BAR_MM, FaultyTake, faulty_takes, healthy_takes

_HEAD = "| fault | array | guilty | named | cpu s | the program says |\n" + 6 * "| --- " + "|"
_WORDS_OF = {"squares": ("bar",)}  # a fault of no device is named by one of these


def program_says(take: FaultyTake) -> list[str]:
    """Every message of the program on one take that speaks of a fault, one line each.

    As the stage gives them: what stops the solve; grave reasons of its verdict that more poses of
    the board would not mend; what the scale bar says; what differs from the session before.
    """
    settings = CalibrateSettings(halves=False, held_out=0.0)  # neither can name a fault
    try:
        solution = solve_array(take.shown, take.board.corners_mm(), settings, every=take.every)
    except LikenessError as error:
        return [failure(error)]
    cameras = solution.state.cameras
    bar = None
    if take.bar is not None:
        found = measure_bar(cameras, take.bar, BAR_MM)
        bar = {**dataclasses.asdict(found), "ratio": found.ratio}
    report = calibration_report(solution, take.board, extras=ReportExtras(scale_bar=bar))
    says = [
        reason["words"]
        for reason in report["gate"]["reasons"]
        if (reason["level"] == "bad" and not reason["more_poses"]) or "bar" in reason["words"]
    ]
    if take.previous is not None:
        says += alignment_problems(align_to_previous(cameras, take.previous), take.board.square_mm)
    return says


def named_right(take: FaultyTake, messages: Sequence[str]) -> bool:
    """Whether the messages name every guilty device and no other, or the board file's fault.

    Of a healthy take, whether there are none.
    """
    if not take.fault:
        return not messages
    text = " ".join(messages)
    named = set(re.findall(r"\bcam\d+\b", text))
    wanted = next((words for key, words in _WORDS_OF.items() if take.fault.startswith(key)), ())
    told = bool(messages) and (not wanted or any(word in text for word in wanted))
    return told and named == set(take.guilty)


def run_faults(small: bool, rows: RowFile, only: str = "") -> list[Row]:
    """Every fault before every array, one line each: the program's words, and were they right."""
    print(_HEAD)
    out = []
    for take in faulty_takes(small):
        if only in take.fault:
            row = rows.row(f"fault {take.fault} {take.scene}", partial(_row, take))
            print(_line(row), flush=True)
            out.append(row)
    for fault in dict.fromkeys(row["fault"] for row in out):
        right = [row["right"] for row in out if row["fault"] == fault]
        print(f"{sum(right)} of {len(right)} named right: {fault}")
    return out


def run_image_faults(rows: RowFile) -> list[Row]:
    """Faults that show in images only, one line each, from small rendered takes."""
    print(_HEAD)
    out = []
    for fault in IMAGE_FAULTS:
        row = rows.row(f"image fault {fault}", partial(_image_row, fault))
        print(_line(row), flush=True)
        out.append(row)
    return out


def run_healthy(count: int, rows: RowFile) -> list[Row]:
    """Good takes of varied arrays: every one that the program complains of is a false alarm."""
    out = []
    for number, take in enumerate(healthy_takes(count)):
        row = rows.row(f"healthy {number} {take.scene}", partial(_row, take))
        out.append(row)
        if row["says"]:
            print(_line(row), flush=True)
    alarms = sum(bool(row["says"]) for row in out)
    print(f"{alarms} false alarms on {len(out)} good takes")
    return out


def _row(take: FaultyTake) -> Row:
    start = time.process_time()
    says = program_says(take)
    return {
        "fault": take.fault,
        "array": f"{take.scene.layout} of {take.scene.devices}",
        "guilty": list(take.guilty),
        "right": named_right(take, says),
        "cpu_s": round(time.process_time() - start, 1),
        "says": says,
    }


def _image_row(fault: ImageFault) -> Row:
    start = time.process_time()
    says = diagnosis(fault)
    text = " ".join(says)
    named = set(re.findall(r"\bcam\d+\b", text))
    return {
        "fault": fault.words,
        "array": "images of 4",
        "guilty": list(fault.guilty),
        "right": all(word in text for word in fault.expected) and named == set(fault.guilty),
        "cpu_s": round(time.process_time() - start, 1),
        "says": says,
    }


def _line(row: Row) -> str:
    guilty = ", ".join(row["guilty"]) or "-"
    right = "yes" if row["right"] else "NO"
    says = " // ".join(row["says"]) or "(nothing)"
    cells = (row["fault"] or "none", row["array"], guilty, right, str(row["cpu_s"]), says)
    return f"| {' | '.join(cells)} |"
