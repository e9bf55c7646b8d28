"""The report's page: self-contained, sections by data, escaped, the same bytes twice."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from capture.camera_file import write_cameras
from capture.devices.simulated import Fault, FaultKind
from capture.errors import InputError, TakeError
from capture.recorder import RecordSettings
from capture.session import Session, Shot, record_take
from tests.capture.recording import array_of
from tests.tools import report_cases as cases
from tools.report import (
    ReportInputs,
    TakeErrors,
    TakeInputs,
    report_for_take,
    write_calibration_page,
    write_report,
    write_scan_page,
)

PRE = RecordSettings().edge_triggers
SMILE = Shot(slate="smile", kind="expression", frames=6, start_ns=5 * 10**9)
_VOID = {"meta", "img", "input", "br", "rect", "line", "path", "circle"}


class _Page(HTMLParser):
    """Collects what a page refers to, its sections and words, and that elements are closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.sections: list[str] = []
        self.references: list[str] = []
        self.words: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        if tag == "section":
            self.sections.append(found["id"] or "")
        self.references += [found[key] or "" for key in ("src", "href") if key in found]
        if tag not in _VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert tag not in {"section", "script"}

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def _errors(count: int) -> np.ndarray:
    errors = np.full((cases.FRAMES, count), 0.3)
    errors[:, :5] = np.nan  # untold
    return errors


def _read(path: Path) -> tuple[_Page, str]:
    text = path.read_text(encoding="utf-8")
    page = _Page(text)
    assert page.open == [], "every element is closed"
    return page, text


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> ReportInputs:
    folder = tmp_path_factory.mktemp("whole")
    take = cases.make_take(folder)
    performance = cases.track(take)
    count = cases.scan(take)
    errors = TakeErrors(
        track_mm=_errors(performance.vertices.shape[1]),
        scan_mm={1: np.full(count, 0.1)},
    )
    return ReportInputs(
        title=f"Session {cases.NASTY}",
        takes=(TakeInputs(folder=take.folder, errors=errors),),
        calibration=cases.calibration(folder, ["left: show it the board more often."]),
        rig=cases.rig(folder / "rig"),
        timings={"track": 3.0, "rig": 1.0},
        settings={"track": {"ncc_min": 0.5}},
    )


@pytest.fixture(scope="module")
def page(whole: ReportInputs, tmp_path_factory: pytest.TempPathFactory) -> tuple[_Page, str]:
    return _read(write_report(whole, tmp_path_factory.mktemp("page") / "report.html"))


def test_page_needs_nothing_else(page: tuple[_Page, str]) -> None:
    parsed, text = page
    outside = [r for r in parsed.references if not r.startswith(("data:image/jpeg;base64,", "#"))]
    assert outside == []
    assert not re.search(r"https?://|url\(|@import", text)
    assert {r[1:] for r in parsed.references if r.startswith("#")} == set(parsed.sections)


def test_all_sections_stand_in_order(page: tuple[_Page, str]) -> None:
    assert page[0].sections == [
        "timings",
        "layout",
        "capture",
        "calibration",
        "scans",
        "tracking",
        "quality",
        "rig",
        "numbers",
    ]


def test_verdicts_stand_at_the_top(page: tuple[_Page, str]) -> None:
    text = page[1]
    head = text[text.index("<header>") : text.index("</header>")]
    assert "Usable, with remarks" in head
    assert "All 4 frame sets of 2 devices are complete" in head
    assert "held-out ratio 1.30" in head
    assert "left: show it the board more often." in head
    assert "RMS 0.3 mm from the truth" in head
    assert "median 0.100 mm from the true surface, 100 % within 0.5 mm" in head
    assert "residual 0.4 mm after refinement, 0.40 of the transferred" in head


def test_names_are_escaped(page: tuple[_Page, str]) -> None:
    parsed, text = page
    assert "<b>&\"'" not in text
    assert any(cases.NASTY in words for words in parsed.words), "shown as it is"


def test_every_shape_and_view_is_pictured(page: tuple[_Page, str]) -> None:
    alts = re.findall(r'alt="([^"]*)"', page[1])
    assert len([alt for alt in alts if alt.startswith("shape ")]) == 3
    assert {"left, frame 0", "mesh over left, frame 0", "right, frame 3"} <= set(alts)
    assert "distance to the true surface" in alts


def test_same_inputs_give_the_same_bytes(
    whole: ReportInputs, page: tuple[_Page, str], tmp_path: Path
) -> None:
    again = write_report(whole, tmp_path / "again.html")
    assert again.read_text(encoding="utf-8") == page[1]


def test_bare_take_shows_what_there_is(tmp_path: Path) -> None:
    take = cases.make_take(tmp_path, cameras=False, neutral=False)
    parsed, text = _read(report_for_take(take.folder, tmp_path / "r.html"))
    assert parsed.sections == ["capture"]
    assert "Good: nothing here asks for a retake." in text


def test_take_with_cameras_shows_the_array(tmp_path: Path) -> None:
    take = cases.make_take(tmp_path)
    parsed, text = _read(report_for_take(take.folder, tmp_path / "r.html"))
    assert parsed.sections == ["layout", "capture", "tracking"]
    assert "the neutral, not yet tracked" in text
    assert "confidence" not in text


def test_whole_calibration_report_is_found_beside_the_cameras(tmp_path: Path) -> None:
    take = cases.make_take(tmp_path)
    full = json.loads(cases.calibration(tmp_path, []).read_text(encoding="utf-8"))
    short = {key: full[key] for key in ("mean_reprojection_px", "held_out", "devices")}
    write_cameras(tmp_path / "cameras.json", take.cameras(), short)
    inputs = ReportInputs(title="x", calibration=tmp_path / "cameras.json")
    assert inputs.calibration_report == full
    other = dict(full, mean_reprojection_px=9.0)
    (tmp_path / "report.json").write_text(json.dumps(other), encoding="utf-8")
    inputs = ReportInputs(title="x", calibration=tmp_path / "cameras.json")
    assert inputs.calibration_report == short, "of another calibration"


def test_session_leaves_out_takes_that_were_taken_again(tmp_path: Path) -> None:
    session = Session.create(tmp_path / "s", name="tuesday")
    faults = {"cam02": [Fault(FaultKind.LOSE_FRAME, k) for k in range(PRE + 1, PRE + 5)]}
    record_take(session, SMILE, array_of(faults=faults), RecordSettings())
    _, text = _read(report_for_take(session.folder, tmp_path / "r.html"))
    assert "Not good: read the red lines first." in text
    record_take(session, SMILE, array_of(), RecordSettings())
    parsed, text = _read(report_for_take(session.folder, tmp_path / "r.html"))
    assert parsed.sections == ["capture"]
    assert "<h1>tuesday</h1>" in text
    assert "smile_001" not in text
    assert "Capture of smile_002:" in text
    assert "Good: nothing here asks for a retake." in text
    assert "clock drift, ppm" in text


def test_nothing_at_all_is_still_a_page(tmp_path: Path) -> None:
    parsed, text = _read(write_report(ReportInputs(title="empty"), tmp_path / "r.html"))
    assert parsed.sections == []
    assert "<h1>empty</h1>" in text


def test_calibration_and_scan_pages(tmp_path: Path) -> None:
    take = cases.make_take(tmp_path)
    cases.scan(take)
    report = {"mean_reprojection_px": 0.9, "warnings": ["one", "two"]}
    parsed, text = _read(write_calibration_page(take.cameras(), report, tmp_path / "c.html"))
    assert parsed.sections == ["calibration", "layout", "numbers"]
    assert "Not good: read the red lines first." in text
    assert "<li>two</li>" in text
    parsed, text = _read(write_scan_page(take.folder, tmp_path / "s.html"))
    assert parsed.sections == ["scans", "layout", "numbers"]
    assert "pairs of views agree to 0.05 mm" in text


def test_weights_outside_the_box_are_red(whole: ReportInputs, tmp_path: Path) -> None:
    folder = cases.rig(tmp_path / "rig")
    with np.load(folder / "rig.npz") as archive:
        arrays = dict(archive)
    arrays["weights"][2, 0] = 1.5
    np.savez(folder / "rig.npz", **arrays)
    _, text = _read(write_report(ReportInputs(title="x", rig=folder), tmp_path / "r.html"))
    assert "weights run from 0 to 1.5, outside 0 to 1" in text
    assert "Not good" in text


def test_damage_is_told_and_nothing_is_left(tmp_path: Path) -> None:
    folder = cases.rig(tmp_path / "rig")
    (folder / "report.json").write_text("[1]", encoding="utf-8")
    with pytest.raises(InputError, match=r"report\.json: expected a JSON object, found list"):
        write_report(ReportInputs(title="x", rig=folder), tmp_path / "out" / "r.html")
    assert not (tmp_path / "out").exists()
    with pytest.raises(TakeError, match="no such folder"):
        report_for_take(tmp_path / "none", tmp_path / "r.html")
