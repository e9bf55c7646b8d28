"""The section of likely errors: strip, worst frames, words, CSV; absent where nothing is told."""

from __future__ import annotations

import base64
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

from capture.take import Take
from tests.tools import report_cases as cases
from tools.report import ReportInputs, TakeInputs, write_report
from tools.report.track_quality import likely_error_section, worst_rows
from tools.report.track_strip import StripRow, strip_chart
from track.quality import TrackQuality, write_quality

LIKELY = (0.0, 0.2, 2.4, None)  # mm, by frame; nothing is told of the last
WHY = f"lower lip: few views agree ({cases.NASTY})"


def judged(take: Take) -> None:
    """Quality beside a tracked take of four frames: the third is bad, the fourth is lost."""
    performance = cases.track(take)
    shape = performance.vertices.shape[:2]
    blank = np.full(shape, np.nan, np.float32)
    likely = np.zeros(shape, np.float32)
    likely[2] = np.linspace(0.0, 3.0, shape[1])
    likely[3] = 9.0
    marks = np.full(shape, 2, np.uint8)
    marks[:, ::4] = 0
    quality = TrackQuality(
        frames=performance.frames, reprojection_px=blank, correlation=blank,
        views_used=np.zeros(shape, np.float32), scan_distance_mm=blank, jitter_mm=blank,
        likely_error_mm=likely, marks=marks, reference=performance.reference,
        round_trip_mm=blank[:, 0],
    )  # fmt: skip
    folder = take.products / "track"
    write_quality(folder / "quality.npz", quality)
    why: list[list[str]] = [[], [], [WHY], ["nothing was measured"]]
    rows = [
        {
            "frame": k, "likely_error_mm": LIKELY[k], "likely_median_mm": 0.05, "ncc": 0.9,
            "flagged": k >= 2, "why": why[k],
        }
        for k in range(cases.FRAMES)
    ]  # fmt: skip
    report = {"frames": rows, "view_remarks": ["right is about 1.0 frames late"]}
    (folder / "report.json").write_text(json.dumps(report), encoding="utf-8")
    (folder / "anchors.json").write_text("{}", encoding="utf-8")  # not the report
    (folder / "quality.csv").write_text("frame,likely_error_mm\n0,0.0\n", encoding="utf-8")


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> ReportInputs:
    take = cases.make_take(tmp_path_factory.mktemp("judged"))
    judged(take)
    return ReportInputs(title="judged", takes=(TakeInputs(folder=take.folder),))


def test_flags_are_told_in_words_and_judged(inputs: ReportInputs) -> None:
    (section,) = likely_error_section(inputs)
    assert section.anchor == "likely"
    (verdict,) = section.verdicts
    assert verdict.level == "bad"
    assert "2 of 4 frames flagged, the first is 2: lower lip: few views agree" in verdict.words
    assert "2.4 mm at the worst (2)" in verdict.words
    assert "<li>right is about 1.0 frames late</li>" in section.body
    assert cases.NASTY not in section.body
    assert "smile_&lt;b&gt;" in section.body


def test_worst_frames_are_pictured_over_plates_and_upright(inputs: ReportInputs) -> None:
    body = likely_error_section(inputs)[0].body
    pictured = re.findall(r"Likely error, frame (\d+) over", body)
    assert pictured[0] == "2"
    assert set(pictured) <= {"1", "2"}  # the first is the neutral; of the last nothing is told
    errors = body[: body.index("<h4>Texture stability</h4>")]
    assert errors.count("data:image/jpeg") == 4 * len(pictured)


def test_texture_is_watched_in_words_numbers_and_pictures(inputs: ReportInputs) -> None:
    body = likely_error_section(inputs)[0].body
    texture = body[body.index("<h4>Texture stability</h4>") :]
    assert "<th>median, px</th>" in texture
    assert re.findall(r"Residual flow, frame (\d+) in", texture.split("<figcaption>", 1)[1])


def test_all_figures_can_be_taken_away(inputs: ReportInputs, tmp_path: Path) -> None:
    text = write_report(inputs, tmp_path / "r.html").read_text(encoding="utf-8")
    found = re.search(r'href="data:text/csv;base64,([^"]+)" download="([^"]+)"', text)
    assert found is not None
    assert base64.b64decode(found.group(1)) == b"frame,likely_error_mm\n0,0.0\n"
    assert found.group(2) == "take_quality.csv"
    assert not re.search(r"https?://|url\(|@import", text)
    again = write_report(inputs, tmp_path / "s.html").read_text(encoding="utf-8")
    assert again == text


def test_older_takes_have_no_such_section(tmp_path: Path) -> None:
    take = cases.make_take(tmp_path)
    cases.track(take)
    assert (
        likely_error_section(ReportInputs(title="old", takes=(TakeInputs(folder=take.folder),)))
        == []
    )


def test_flagged_frames_come_first_then_the_worst() -> None:
    rows = [
        {"likely_error_mm": 0.0}, {"likely_error_mm": 3.0},
        {"likely_error_mm": 1.2, "flagged": True},
        {"likely_error_mm": None, "flagged": True}, {"likely_error_mm": 0.5},
    ]  # fmt: skip
    assert worst_rows(rows, 3) == [2, 1, 4]


def test_strip_colours_run_from_good_to_bad_and_gaps_are_grey() -> None:
    row = StripRow(name="ncc", values=[1.0, 0.7, 0.2, math.nan], good=1.0, bad=0.7)
    chart = strip_chart([row], [5, 6, 7, 8], [False, True, False, False], "strip")
    fills = re.findall(r'fill="(#[0-9a-f]{6})"', chart)
    assert fills[0] == "#f6f4f0"
    assert fills[1] == fills[2] == "#600c28"
    assert fills[3] == "#c9cdd3"
    assert chart.count("<path") == 1
    assert "frame 8: ncc none" in chart
