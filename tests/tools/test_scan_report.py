"""The page of scans: everything in one file, faults at the top, whatever is missing left out."""

import html
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.camera_file import write_cameras
from capture.errors import TakeError
from capture.take import Take
from recon.fusion import Points
from recon.mesh import write_obj
from recon.point_file import points_scan
from recon.surface import write_ply
from recon.visiting import import_take
from tests.synthetic_stereo import draw, ring
from tests.tools import report_cases as cases
from tools.cli import main
from tools.report.charts import Labels, stacked_chart
from tools.report.inputs import scan_page
from tools.report.report import report_for_take
from tools.report.scan import write_scan_report
from tools.report.scan_charts import coverage_matrix, reason_bars
from tools.verbs.recon import read_prior

CAMERA = {
    "name": "left", "pairs": 1, "matched_share": 0.4, "neighbours_share": None,
    "deviation_px": 0.31, "deviation_mm": 0.4, "sharpness": 0.7, "clipped_share": 0.0,
    "gain": 1.0, "warnings": ["out of <focus>"],
}  # fmt: skip


@pytest.fixture
def take(tmp_path: Path) -> Take:
    return cases.make_take(tmp_path)


def told(frame: int, **more: object) -> dict[str, object]:
    return {
        "frame": frame,
        "missing": [],
        "pairs": [{"left": "left", "right": "right", "angle_deg": 17.2, "coverage": 0.43}],
        "pair_reasons": [{"KEPT": 430, "OUTSIDE": 100, "LOW_CORRELATION": 300, "NEWLY_MADE": 70}],
        "agreement_median_mm": 0.05,
        "agreement_p95_mm": 0.11,
        "matched_share": 0.43,
        "points": 1000 + frame,
        "seconds": {"match": 3.0, "mesh": 1.0},
        "rejected": {"seen_through": 12, "unconfirmed": 40},
        "cameras_report": [CAMERA],
        "warnings": [],
        **more,
    }


def scanned(take: Take, documents: dict[int, dict[str, object]]) -> None:
    """Scans of some frames, all of one ball."""
    cases.scan(take)
    folder = take.products / "recon"
    ball = (folder / "frame_0001.ply").read_bytes()
    for old in folder.iterdir():
        old.unlink()
    for frame, document in documents.items():
        (folder / f"frame_{frame:04d}.ply").write_bytes(ball)
        text = json.dumps(document)
        (folder / f"frame_{frame:04d}.json").write_text(text, encoding="utf-8")


class _Page(HTMLParser):
    """Sections, pictures and what the page would load from elsewhere."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.sections: list[str] = []
        self.pictures: list[str] = []
        self.outside: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        if tag == "section":
            self.sections.append(values.get("id") or "")
        if tag == "img":
            self.pictures.append(values.get("alt") or "")
        for key in ("src", "href"):
            address = values.get(key) or "#"
            if not address.startswith(("#", "data:")):
                self.outside.append(address)


def test_a_page_shows_every_frame_and_needs_nothing_else(take: Take, tmp_path: Path):
    scanned(take, {frame: told(frame) for frame in (0, 2)})
    out = tmp_path / "page.html"
    assert write_scan_report(take, [0, 2], out) == []
    text = out.read_text(encoding="utf-8")
    page = _Page(text)
    assert page.sections == ["frames", "frame-0000", "frame-0002"]
    assert page.outside == []
    for words in ("scan from its right", "scan from the front", "scan from its left"):
        assert page.pictures.count(words) == 2
    assert page.pictures.count("confidence") == 2
    assert {"depth of left", "depth of right"} <= set(page.pictures)
    assert "left and right: 43 % at 17.2 degrees" in text
    assert "newly made" in text
    assert "seen through" in text
    assert "out of &lt;focus&gt;" in text
    assert "<focus>" not in text
    assert "agree to 0.05 mm" in text


def test_warnings_stand_at_the_top_once_with_their_frames(take: Take, tmp_path: Path):
    documents = {}
    for frame in range(3):
        words = [f"left: 3{frame} % less fine detail: <b>focus</b>"] if frame else []
        documents[frame] = told(frame, warnings=[*words, "right: no image of this frame"])
    scanned(take, documents)
    out = tmp_path / "page.html"
    warnings = write_scan_report(take, [0, 1, 2, 3], out)
    assert warnings == [
        "right: no image of this frame (frames 0, 1, 2)",
        "left: 31 % less fine detail: <b>focus</b> (frames 1, 2)",
    ]
    text = out.read_text(encoding="utf-8")
    top = html.unescape(re.sub(r"<[^>]*>", " ", text.partition("<section")[0]))
    assert "no scan was made of it" in top
    assert "Frame 3:" in top
    for words in warnings:
        assert words in top


def test_the_report_of_the_take_tells_what_its_scans_warn_of(take: Take, tmp_path: Path):
    blurred, lost = "left: {} % less fine detail", "right: no image of this frame"
    scanned(
        take,
        {
            0: told(0),
            1: told(1, warnings=[blurred.format(31)]),
            2: told(2, warnings=[lost, blurred.format(32)]),
        },
    )
    out = tmp_path / "pages" / "take.html"
    out.parent.mkdir()

    def page() -> tuple[_Page, str]:
        text = report_for_take(take.folder, out).read_text(encoding="utf-8")
        return _Page(text), html.unescape(re.sub(r"<[^>]*>", " ", text))

    parsed, words = page()
    assert parsed.outside == []  # there is no page of the scans yet
    assert "2 kinds of warnings in 2 of 3 frames, most in frame 2" in words
    assert "first of all: left: 31 % less fine detail" in words
    assert words.index("first of all") < words.index("Most in frame 2: 2.")
    assert re.search(r"left: 31 % less fine detail\s+2\s+1\s", words)
    assert re.search(r"no image of this frame\s+1\s+2\s", words)
    assert "the scans warn" in words

    write_scan_report(take, [0, 1, 2], scan_page(take))
    (link,) = page()[0].outside
    assert (out.parent / link).resolve() == scan_page(take).resolve()

    scanned(take, {0: told(0)})
    assert "kinds of warnings" not in page()[1]
    assert "the scans warn" not in page()[1]


def test_of_many_frames_some_are_shown_and_all_are_told(take: Take, tmp_path: Path):
    frames = list(range(9))
    dark = {5: ["left: dark"]}
    scanned(take, {frame: told(frame, warnings=dark.get(frame, [])) for frame in frames})
    out = tmp_path / "page.html"
    assert write_scan_report(take, frames, out) == ["left: dark (frame 5)"]
    page = _Page(out.read_text(encoding="utf-8"))
    assert "frame-0005" in page.sections
    assert 3 <= len(page.sections) <= 7
    text = out.read_text(encoding="utf-8")
    assert "agreement of pairs, mm" in text
    assert "1008" in text


def test_points_and_old_numbers_are_shown_too(take: Take, tmp_path: Path):
    ball = cases.ball()
    points = Points(
        ball.vertices.astype(np.float32), ball.normals().astype(np.float32),
        np.ones(len(ball.vertices), np.float32), np.full(len(ball.vertices), 3, np.int32),
        1.0, (0.01, 0.02),
    )  # fmt: skip
    write_ply(take.products / "recon" / "points_0001.ply", points_scan(points))
    out = tmp_path / "page.html"
    assert write_scan_report(take, [1], out) == []
    page = _Page(out.read_text(encoding="utf-8"))
    assert page.pictures == [
        "scan from its right", "scan from the front", "scan from its left", "confidence",
    ]  # fmt: skip


def test_a_take_without_scans_says_so(take: Take, tmp_path: Path):
    out = tmp_path / "page.html"
    assert write_scan_report(take, [0, 1], out) == []
    text = out.read_text(encoding="utf-8")
    assert "Nothing was reconstructed" in text
    assert text.count("no scan was made of it") >= 2


def test_charts_survive_names_they_do_not_know():
    chart = coverage_matrix(["a"], [{"left": "a", "right": "gone", "coverage": 0.5}])
    assert "gone" not in chart
    assert "<rect" in stacked_chart(
        ["a"], [[1.0, 3.0]], {"x": "#fff", "y": "#000"}, Labels(title="t")
    )
    assert "25 %" in stacked_chart(
        ["a"], [[1.0, 3.0]], {"x": "#fff", "y": "#000"}, Labels(title="t")
    )
    assert "svg" in reason_bars(["a", "b"], [{"left": "a", "right": "c"}], [{"OUTSIDE": 4}])


def test_a_prior_is_a_performance_or_a_mesh(take: Take, tmp_path: Path):
    performance = cases.track(take)
    prior = read_prior(take.products / "track" / "performance.npz")
    np.testing.assert_array_equal(prior.vertices, performance.vertices)
    mesh = prior.at(2, 5.0)
    assert mesh is not None
    np.testing.assert_array_equal(mesh.vertices, performance.vertices[2])
    write_obj(tmp_path / "one.obj", cases.ball())
    one = read_prior(tmp_path / "one.obj").at(17, 5.0)
    assert one is not None
    np.testing.assert_allclose(one.vertices, cases.ball().vertices, atol=1e-4)
    ball = cases.ball()
    write_obj(tmp_path / "metres.obj", ball.with_vertices(0.001 * ball.vertices))
    with pytest.raises(TakeError, match=r"metres\.obj: .* in world mm, found a mesh 0\.178"):
        read_prior(tmp_path / "metres.obj")
    with pytest.raises(TakeError, match=r"face\.ply: expected the performance\.npz"):
        read_prior(tmp_path / "face.ply")


def test_the_verb_keeps_the_good_frames_and_shows_them(tmp_path: Path, capfd):
    array = ring((-9.0, 9.0), (-9.0, 9.0))
    for camera in array:
        folder = tmp_path / "visit" / camera.name
        folder.mkdir(parents=True)
        image = np.rint(65535 * draw(camera)).astype(np.uint16)
        cv2.imwrite(str(folder / "0000.png"), image)
        cv2.imwrite(str(folder / "0001.png"), np.full_like(image, 7))
    write_cameras(tmp_path / "visit" / "cameras.json", array)
    import_take(tmp_path / "visit", tmp_path / "take")
    options = ["--depth-mm", "90", "--extent-mm", "110", "--depth-maps"]
    assert main(["recon", str(tmp_path / "take"), *options]) == 1
    told = capfd.readouterr().err
    assert "1 of 2 frames failed, the others are done" in told
    assert "frame 1: nothing found" in told
    folder = tmp_path / "take" / "products" / "recon"
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "Frame 1:" in page
    assert "scan from the front" in page
    assert sorted(path.name for path in folder.iterdir()) == [
        "depth", "frame_0000.json", "frame_0000.ply", "frame_0000.ply.record.json", "report.html",
    ]  # fmt: skip
    assert main(["recon", str(tmp_path / "take"), "--frames", "0", "--json", *options]) == 0
    report = json.loads(capfd.readouterr().out)
    assert report["page"].endswith("report.html")
    assert report["warnings"] == []
    assert main(["recon", str(tmp_path / "take"), "--prior", "face.ply"]) == 2
    assert "expected the performance.npz" in capfd.readouterr().err
