"""The calibration page: a section for each key, none without it, escaped, small, it turns."""

from __future__ import annotations

import copy
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.tools.calibration_cases import LOG, array_of, full_report
from tests.tools.report_cases import NASTY
from tools.report import ReportInputs, write_calibration_page, write_report
from tools.report.array_view import Measure, Surroundings, array_view
from tools.report.calibration_keys import Grid, grid_of, table_of
from tools.report.calibration_page import calibration_sections
from tools.report.cell_charts import Scale, cells, front_layers, middle_slices

NAMES = ("cam00", "cam01", "cam02", "cam03")
SECTIONS = ["calibration", "layout", "uncertainty", "volume", "devices", "poses", "split_half",
            "table", "rejected", "numbers"]  # fmt: skip
_VOID = {"meta", "link", "img", "input", "br", "hr"}
_BROWSER = shutil.which("chromium") or shutil.which("chromium-browser")
_FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-sync", "--disable-background-networking", "--disable-component-update",
    "--virtual-time-budget=3000", "--window-size=1300,900",
)  # fmt: skip


class _Page(HTMLParser):
    """What a page shows; every element must be closed, ids must be told once."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.sections: list[str] = []
        self.links: list[str] = []
        self.titles: list[str] = []
        self.words: list[str] = []
        self.ids: list[str] = []
        self.untitled = 0
        self.open: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []
        assert len(self.ids) == len(set(self.ids))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        assert len(found) == len(attrs), f"{tag} tells an attribute twice"
        if "id" in found:
            self.ids.append(found["id"] or "")
        if tag == "section":
            self.sections.append(found["id"] or "")
        self.links += [found[key] or "" for key in ("src", "href") if key in found]
        if self.open and self.open[-1] == "svg" and tag != "title" and not self.titled:
            self.untitled += 1
        if tag == "svg":
            self.titled = False
        if tag not in _VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert tag not in {"section", "script", "div", "p", "td", "details"}

    def handle_data(self, data: str) -> None:
        self.words.append(data)
        if self.open[-2:] == ["svg", "title"]:
            self.titled = True
            self.titles.append(data)


def page_of(report: dict[str, Any], out: Path, names: tuple[str, ...] = NAMES) -> tuple[_Page, str]:
    text = write_calibration_page(array_of(names), report, out).read_text(encoding="utf-8")
    return _Page(text), text


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[_Page, str]:
    folder = tmp_path_factory.mktemp("page")
    (folder / LOG).write_text("device,frame\n", encoding="utf-8")
    return page_of(full_report(NAMES), folder / "cameras.html")


def test_all_sections_stand_in_order_and_nothing_is_fetched(whole: tuple[_Page, str]) -> None:
    page, text = whole
    assert page.sections == SECTIONS
    assert {link for link in page.links if not link.startswith("#")} == {LOG}
    assert not re.search(r"https?://|url\(|@import|nan\b|NaN[^.]", text.replace("isNaN", ""))
    assert page.untitled == 0, "every chart says what it is"
    assert "the camera array in 3D" in page.titles


def test_gate_stands_on_top_in_its_own_words(whole: tuple[_Page, str]) -> None:
    text = whole[1]
    head = text[text.index("<header>") : text.index("</header>")]
    assert '<div class="summary bad" id="gate">' in head
    assert "Do not shoot: cam03 is not calibrated" in head
    assert "Asked for: 7 more poses of the board." in head
    assert '<li class="bad"><b>cam03</b> moved during the take <em>6 more poses</em></li>' in head
    assert "the chin: hold the board there <em>1 more pose</em>" in head
    assert "Not good: read the red lines" not in head, "one verdict only"


def test_key_numbers_stand_beside_what_is_asked(whole: tuple[_Page, str]) -> None:
    rows = dict(re.findall(r'<th scope="row">([^<]+)</th><td class="found">(.*?)</tr>', whole[1]))
    told = {name: re.sub(r"<[^>]+>", "|", row) for name, row in rows.items()}
    assert told["mean reprojection"].startswith("0.127 px||≤ 0.25 px||✓")
    assert told["held-out ratio"].startswith("1.040||≤ 1.15||✓")
    assert told["split-half, 95 %"].startswith("0.06 px||≤ 0.1 px||✓")
    assert told["triangulation uncertainty"].startswith("2.31 \u00b5m||≤ 5 \u00b5m||✓")
    assert told["scale bar"].startswith("300.012 ± 0.006 mm||300 mm ± 0.05 %||✓")


def test_what_is_asked_is_missed_in_red(tmp_path: Path) -> None:
    report = full_report(NAMES)
    report["held_out"] = {"ratio": 1.9, "remark": ""}
    report["split_half"] = {"p95_px": None, "by_device": {}, "remark": "too few poses <to> halve"}
    report["scale_bar"]["measured_mm"] = 302.0
    text = page_of(report, tmp_path / "p.html")[1]
    assert re.search(r'1\.900</td><td class="asked">≤ 1\.15</td><td class="mark bad">✗', text)
    assert "not checked" in text
    assert text.count("too few poses &lt;to&gt; halve") >= 2
    assert re.search(r'302\.000 ± .*?<td class="mark bad">✗</td><td>.*?\+0\.667 % off', text)


@pytest.mark.parametrize(
    ("key", "gone"),
    [("uncertainty", "uncertainty"), ("volume", "volume"), ("poses", "poses"),
     ("split_half", "split_half")],
)  # fmt: skip
@pytest.mark.parametrize("null", [False, True])
def test_a_missing_or_null_key_is_not_drawn(
    key: str, gone: str, null: bool, tmp_path: Path
) -> None:
    report = full_report(NAMES)
    if null:
        report[key] = None
    else:
        del report[key]
    assert page_of(report, tmp_path / "p.html")[0].sections == [s for s in SECTIONS if s != gone]


def test_keys_inside_sections_come_and_go(tmp_path: Path) -> None:
    def has(report: dict[str, Any]) -> dict[str, bool]:
        page, text = page_of(report, tmp_path / "p.html")
        return {
            "gate": 'id="gate"' in text,
            "bar": "scale bar" in text,
            "boards": 'class="board"' in text,
            "heat": any(t.startswith("mean residual over the sensor") for t in page.titles),
            "means": 'class="mean"' in text,
            "arrows": any(t.startswith("residual vectors of") for t in page.titles),
            "sigmas": "place ±" in text,
            "tilts": "tilts left" in text,
            "log": LOG in text.split('id="rejected"')[1].split('id="numbers"')[0],
        }

    report = full_report(NAMES)
    assert all(has(report).values())
    for key in ("gate", "scale_bar", "board_places", "residual_vectors", "log"):
        report[key] = None
    for device in report["devices"]:
        device["sigmas"] = device["tilts_deg"] = None
        del device["heat"]["dx_px"]
    assert {key for key, there in has(report).items() if there} == {"heat"}
    for device in report["devices"]:
        device["heat"] = None
    assert not any(has(report).values())


def test_old_and_empty_reports_are_still_drawn(tmp_path: Path) -> None:
    old = {
        "mean_reprojection_px": 0.9,
        "held_out": {"ratio": 1.3},
        "devices": [{"name": "cam00", "mean_reprojection_px": 0.9, "coverage": [[0, 2], [5, 1]]}],
        "poses": [{"frame": 0, "mean_reprojection_px": None}],
        "warnings": ["one", "two"],
    }
    page, text = page_of(old, tmp_path / "p.html")
    assert page.sections == ["calibration", "layout", "devices", "poses", "table", "numbers"]
    assert "Not good: read the red lines first." in text
    assert "<li>two</li>" in text
    assert page_of({}, tmp_path / "e.html")[0].sections == ["calibration", "layout"]


def test_hostile_names_and_words_are_escaped(tmp_path: Path) -> None:
    names = (*NAMES[:-1], NASTY)
    report = full_report(names)
    evil = "<script>alert(1)</script>"
    report["gate"]["headline"] = report["volume"]["thin"][0] = report["warnings"][0] = evil
    report["gate"]["reasons"].append({"level": evil, "device": evil, "words": evil})
    report["split_half"]["remark"] = report["rejection"] = evil
    report["split_half"]["by_device"][evil] = 0.1
    report["devices"][0]["frames"][evil] = 3
    report["world"] = {"origin": evil}
    page, text = page_of(report, tmp_path / "p.html", names)
    assert "<script>alert" not in text
    assert "smile_<b>" not in text
    assert any(NASTY in words for words in page.words)
    scene = re.search(r'data-scene="on">(.*?)</script>', text)
    assert scene is not None
    assert "<" not in scene.group(1)
    json.loads(scene.group(1))


@pytest.mark.parametrize(
    "name", ["../rejected.csv", "/etc/passwd", "javascript:alert(1)", "none.csv", "a\\b.csv", 7]
)
def test_log_is_linked_only_beside_the_page(name: object, tmp_path: Path) -> None:
    (tmp_path / LOG).write_text("x", encoding="utf-8")
    (tmp_path / "in").mkdir()
    page, _ = page_of(full_report(NAMES) | {"log": name}, tmp_path / "in" / "p.html")
    assert [link for link in page.links if not link.startswith("#")] == []


def _paths(value: Any, depth: int = 3) -> list[tuple[Any, ...]]:
    """The places of a report, from the top: keys and the first entries of lists."""
    if depth == 0:
        return [()]
    inner: list[tuple[Any, ...]] = []
    if isinstance(value, dict):
        inner = [(key, *rest) for key, one in value.items() for rest in _paths(one, depth - 1)]
    elif isinstance(value, list) and value:
        inner = [(0, *rest) for rest in _paths(value[0], depth - 1)]
    return [(), *inner]


_REPORT = full_report(NAMES[:2], poses=3)
_JUNK = st.sampled_from(
    [None, -1, 0, 1e308, 10**400, float("nan"), True, "<x>", [], {}, [None], [[1], [1, 2]],
     [[1, 2, 3, 4]], [{"name": {}}], {"cam00": "x"}, [[None, None]]]
)  # fmt: skip


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(path=st.sampled_from([p for p in _paths(_REPORT) if p]), junk=_JUNK)
def test_odd_values_are_never_an_exception(path: tuple[Any, ...], junk: Any) -> None:
    report = copy.deepcopy(_REPORT)
    place: Any = report
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = junk
    inputs = ReportInputs(title="x", cameras=array_of(NAMES[:2]), told=report)
    body = "".join(section.body for section in calibration_sections(inputs))
    _Page(body)
    assert "<x>" not in body


def test_same_report_gives_the_same_bytes_and_sixteen_devices_fit(tmp_path: Path) -> None:
    names = tuple(f"cam{k:02d}" for k in range(16))
    report = full_report(names, poses=60)
    many = np.random.default_rng(3).uniform(0.0, 1000.0, (200, 4)).round(3).tolist()
    report["residual_vectors"] = dict.fromkeys(names, many)
    _, one = page_of(report, tmp_path / "one.html", names)
    _, other = page_of(copy.deepcopy(report), tmp_path / "two.html", names)
    assert one == other
    assert len(one.encode()) < 750_000


def test_take_report_has_the_gate_and_the_key_numbers(tmp_path: Path) -> None:
    (tmp_path / "report.json").write_text(json.dumps(full_report(NAMES)), encoding="utf-8")
    inputs = ReportInputs(
        title="take", calibration=tmp_path / "report.json", cameras=array_of(NAMES)
    )
    text = write_report(inputs, tmp_path / "r.html").read_text(encoding="utf-8")
    page = _Page(text)
    assert page.sections == ["layout", "calibration", "numbers"]
    head = text[text.index("<header>") : text.index("</header>")]
    assert "Calibration:</b> Do not shoot: cam03 is not calibrated" in head
    assert "<b>cam03</b> moved during the take" in text
    assert "triangulation uncertainty" in text
    assert 'class="arrayview"' not in text, "the full set is the calibration page's"


def test_slices_show_the_right_side_of_the_volume() -> None:
    values = np.full((3, 3, 3), 1.0)  # z, y, x
    values[1, 2, 2] = 9.0  # at +x, +y, the middle of z
    grid = Grid(values=values, origin_mm=np.full(3, -10.0), step_mm=10.0)
    scale = Scale(low=1.0, high=9.0, stops=("#111111", "#eeeeee"))
    front, side, above = (chart for chart, _ in middle_slices(grid, scale, "t"))
    path = re.search(r'd="([^"]+)" fill="#eeeeee"', front)
    assert path is not None
    x, y = re.findall(r"M([\d.]+) ([\d.]+)", path.group(1))[0]
    assert float(x) > 200.0, "+x is on the right"
    assert float(y) == 8.0, "+y is on top"
    assert "#eeeeee" not in side + above


def test_a_named_world_says_whose_axes_the_slices_have(tmp_path: Path) -> None:
    report = full_report(NAMES)
    _, text = page_of(report, tmp_path / "own.html")
    assert "not of the world" not in text
    motion = np.eye(4)
    motion[:3, 3] = [9.2, 41.8, -0.2]
    report["world_from_volume"] = motion.tolist()
    _, text = page_of(report, tmp_path / "named.html")
    assert text.count("which is at x 9, y 42, z 0 mm in the world, to the right, up") == 2
    report["world_from_volume"] = [[1, 2], [3]]
    _, text = page_of(report, tmp_path / "odd.html")
    assert "not of the world" not in text


def test_cells_tile_without_gaps_and_keep_their_colours() -> None:
    scale = Scale(low=0.0, high=2.0, stops=("#000001", "#000002", "#000003"))
    text = cells(np.array([[0.0, 1.0, 1.0], [np.nan, 5.0, -3.0]]), scale, 3.333, (0.0, 0.0))
    found = {colour: d for d, colour in re.findall(r'd="([^"]+)" fill="(#\w+)"', text)}
    assert found["#000001"] == "M0.0 0.0H3.3V3.3H0.0zM6.7 3.3H10.0V6.7H6.7z"
    assert found["#000002"] == "M3.3 0.0H10.0V3.3H3.3z", "neighbours of one colour are one"
    assert found["#000003"] == "M3.3 3.3H6.7V6.7H3.3z"
    assert len(found) == 4, "and grey for the one that is not known"


def test_empty_places_of_the_volume_are_red_only_where_all_around_is_empty() -> None:
    counts = np.full((1, 4, 3), 5.0)
    counts[0, :2] = 0.0
    counts[0, 0, 0] = np.nan
    grid = Grid(values=counts, origin_mm=np.zeros(3), step_mm=1.0)
    ((chart, _),) = front_layers(grid, Scale(low=0.0, high=5.0, stops=("#aaaaaa", "#000000")), "t")
    red = re.search(r'd="([^"]+)" fill="#f4cfcb"', chart)
    assert red is not None
    assert red.group(1).count("M") == 1, "the lowest row, but not outside the volume"


@pytest.mark.parametrize(
    "broken",
    [{"shape": [2, 2, 3]}, {"shape": [2, 2]}, {"origin_mm": [0, 0, None]}, {"step_mm": 0},
     {"v": None}, {"v": [None] * 8}],
)  # fmt: skip
def test_broken_grids_are_none(broken: dict[str, Any]) -> None:
    good = {"shape": [2, 2, 2], "origin_mm": [0, 0, 0], "step_mm": 5, "v": list(range(8))}
    grid = grid_of(good, "v", "step_mm")
    assert grid is not None
    assert grid.values[1, 0, 1] == 5.0, "x runs fastest"
    assert grid.place_mm(2, 1) == 5.0
    assert grid_of(good | broken, "v", "step_mm") is None


def test_tables_keep_null_as_nan() -> None:
    table = table_of({"t": [[1, None], [2, 3]]}, "t")
    np.testing.assert_array_equal(table, [[1.0, np.nan], [2.0, 3.0]])
    assert table_of({"t": [[1], [2, 3]]}, "t") is None


def test_static_view_fits_its_frame_and_colours_by_value() -> None:
    array = array_of(NAMES)
    measure = Measure(name="residual, px", values=np.array([0.1, 0.1, np.nan, 0.4]))
    around = Surroundings(centre=np.zeros(3), radius_mm=120.0, marked={"cam03": "bad"})
    text = array_view(array, [measure], around)
    places = np.array(re.findall(r"[ML](-?[\d.]+) (-?[\d.]+)", text), dtype=float)
    assert places.min() >= 0
    assert places[:, 0].max() <= 720
    assert places[:, 1].max() <= 460
    colours = re.findall(r'class="device[^"]*" data-item="\d+" style="--own:(#\w+)"', text)
    assert len(colours) == 4
    assert len(set(colours)) == 3, "equal values alike, the unknown grey"
    assert "#8a8f98" in colours
    assert 'class="device bad"' in text


def test_script_is_short_and_names_no_address() -> None:
    script = Path(__file__).parents[2] / "tools" / "report" / "calibration_page.js"
    text = script.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 150
    assert not re.search(r"https?:|import |fetch\(|XMLHttp|eval|innerHTML|</script", text)


def test_browser_turns_the_array_and_sorts_the_table(tmp_path: Path) -> None:
    if _BROWSER is None:
        pytest.skip("no chromium on this machine: the script of the page is not run")
    _, text = page_of(full_report(NAMES), tmp_path / "p.html")
    script = """
      const root = document.querySelector('.arrayview'), before = {}, after = {};
      const paths = (to) => root.querySelectorAll('[data-item]').forEach((g) => {
        to[g.dataset.item] = [...g.querySelectorAll('path')].map((p) => p.getAttribute('d')); });
      paths(before);
      root.view.turn(0.7, -0.9); root.view.zoom(1.2); root.view.draw(); paths(after);
      const names = [...document.querySelectorAll('table.sortable tbody')];
      const order = () => names.flatMap((b) => [...b.rows].map((r) => r.cells[0].textContent));
      const heads = [...document.querySelectorAll('table.sortable thead button')];
      const residual = heads.find((h) => h.textContent.startsWith('residual'));
      residual.click(); residual.click();
      document.title = JSON.stringify({ state: root.dataset.state, before, after, order: order(),
        view: root.view.view });"""
    static = _paths_of(text)
    driven = tmp_path / "driven.html"
    driven.write_text(text.replace("</body>", f"<script>{script}</script></body>"), "utf-8")
    done = subprocess.run(
        [str(_BROWSER), *_FLAGS, f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom",
         driven.as_uri()],
        capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    title = re.search(r"<title>(\{.*?\})</title>", done.stdout)
    assert title is not None, done.stderr[-2000:]
    told = json.loads(title.group(1))
    assert told["state"] == "ready"
    assert told["order"][0] == "cam03", "the largest residual first"
    for item, lines in static.items():
        for mine, theirs in zip(lines, told["before"][item], strict=True):
            apart = np.abs(_numbers(mine) - _numbers(theirs)).max()
            assert apart < 0.11, "the script draws what stood there without it"
    scene = json.loads(re.search(r'data-scene="on">(.*?)</script>', text).group(1))  # type: ignore[union-attr]
    assert told["view"]["yaw"] == pytest.approx(scene["view"]["yaw"] + 0.7)
    for item, lines in told["after"].items():
        expected = [_projected(line, told["view"]) for line in scene["items"][int(item)]["lines"]]
        for mine, theirs in zip(expected, lines, strict=True):
            assert np.abs(mine.ravel() - _numbers(theirs)).max() < 0.06


def _paths_of(text: str) -> dict[str, list[str]]:
    groups = re.findall(r'data-item="(\d+)"[^>]*>(.*?)</g>', text)
    return {item: re.findall(r'<path d="([^"]+)"', inner) for item, inner in groups}


def _numbers(path: str) -> np.ndarray:
    return np.array(re.findall(r"-?\d+\.?\d*", path), dtype=float)


def _projected(points: list[list[float]], view: dict[str, Any]) -> np.ndarray:
    """A pinhole that looks at the target from `away` mm, turned by yaw, then up by pitch."""
    yaw, pitch = view["yaw"], view["pitch"]
    towards = np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
    right = np.array([np.cos(yaw), 0.0, -np.sin(yaw)])
    up = np.cross(towards, right)
    seen = np.array(points) - view["target"]
    scale = view["zoom"] / (view["away"] - seen @ towards)
    return np.stack([360.0 + scale * (seen @ right), 230.0 - scale * (seen @ up)], axis=1)
