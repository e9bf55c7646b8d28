"""Reports as pages: of a session, of one take, of a calibration, of scans."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from capture.camera import CameraArray
from capture.progress import Progress, silent
from capture.session import Session
from tools.report.calibration import calibration_section
from tools.report.calibration_gate import gate_box
from tools.report.calibration_page import calibration_sections
from tools.report.inputs import ReportInputs, TakeInputs
from tools.report.overview import layout_section, numbers_section, timing_section
from tools.report.page import Section, write_page
from tools.report.quality import quality_section
from tools.report.recording import capture_section
from tools.report.shapes import rig_section
from tools.report.surfaces import overlay_section, scan_section
from tools.report.svg import escape
from tools.report.track_quality import likely_error_section

_Part = Callable[[ReportInputs], list[Section]]
_PARTS: tuple[_Part, ...] = (
    timing_section,
    layout_section,
    capture_section,
    calibration_section,
    scan_section,
    overlay_section,
    likely_error_section,
    quality_section,
    rig_section,
    numbers_section,
)


def write_report(inputs: ReportInputs, out: Path, *, progress: Progress = silent) -> Path:
    """Write one self-contained HTML page of everything that `inputs` holds.

    Args:
        inputs: what to report on; what it lacks is left out.
        out: the file.
        progress: told after each section.

    Returns:
        `out`.

    Raises:
        InputError: naming a take, rig or report that is there and damaged.
    """
    return _write(inputs, out, _PARTS, progress)


def report_for_take(
    take: Path, out: Path, *, rig: Path | None = None, progress: Progress = silent
) -> Path:
    """Report on one take, or on all takes of a session: whatever the stages have made by now.

    Of a session, takes that were taken again are left out.

    Args:
        take: the take's folder, or the session's.
        out: the file.
        rig: the folder that `likeness rig` wrote, or None.
        progress: told after each section.

    Raises:
        TakeError: when the folder is neither.
    """
    if (Path(take) / "session.json").is_file():
        session = Session.open(Path(take))
        kept = [note.folder for note in session.takes() if not note.superseded]
        takes = tuple(TakeInputs(folder=folder) for folder in kept)
        inputs = ReportInputs(title=session.name, takes=takes, rig=rig)
        return write_report(inputs, out, progress=progress)
    item = TakeInputs(folder=Path(take))
    cameras = item.folder / "cameras.json"
    inputs = ReportInputs(
        title=item.take.name,
        takes=(item,),
        calibration=cameras if cameras.is_file() else None,
        rig=rig,
    )
    return write_report(inputs, out, progress=progress)


def write_calibration_page(cameras: CameraArray, report: Mapping[str, Any], out: Path) -> Path:
    """Write the page of a calibration: the gate, the array, its uncertainty, every device.

    Args:
        cameras: the calibrated array.
        report: what the calibration says of itself; whatever it lacks is left out.
        out: the file, beside the log that the report names.
    """
    inputs = ReportInputs(title="Calibration", cameras=cameras, told=report)
    summary = gate_box(report)
    return _write(inputs, out, (calibration_sections, numbers_section), silent, summary)


def write_scan_page(take: Path, out: Path) -> Path:
    """Write the page of a take's scans: pictures, confidence, agreement between pairs."""
    item = TakeInputs(folder=Path(take))
    inputs = ReportInputs(title=f"Scans of {item.take.name}", takes=(item,))
    return _write(inputs, out, (scan_section, layout_section, numbers_section), silent)


def _write(
    inputs: ReportInputs, out: Path, parts: tuple[_Part, ...], progress: Progress, summary: str = ""
) -> Path:
    inputs = replace(inputs, out=Path(out))
    sections = []
    for done, part in enumerate(parts, start=1):
        sections += part(inputs)
        progress(done, len(parts), "report")
    write_page(inputs.title, _lead(inputs), sections, Path(out), summary=summary)
    return Path(out)


def _lead(inputs: ReportInputs) -> str:
    pieces = []
    if inputs.takes:
        names = ", ".join(item.take.name for item in inputs.takes)
        frames = sum(len(item.take.frames) for item in inputs.takes)
        count = "1 take" if len(inputs.takes) == 1 else f"{len(inputs.takes)} takes"
        pieces.append(f"{count} ({names}), {frames} frames")
    if inputs.array is not None:
        pieces.append(f"{len(inputs.array)} cameras")
    if inputs.face_rig is not None:
        pieces.append(f"a rig of {len(inputs.face_rig.names)} shapes")
    return f'<p class="lead">{escape(", ".join(pieces))}</p>' if pieces else ""
