"""Charts and numbers of the report."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

from tests.tools.report_cases import ball, camera
from tools.report.charts import Labels, Series, bar_chart, line_chart, matrix_chart
from tools.report.page import flattened
from tools.report.picture import displayable, sequential
from tools.report.quality import per_frame
from tools.report.shade import Studio, cropped, enlarged, studio_camera
from tools.report.svg import number, ticks


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [(0.0, 1.0, [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]), (-3.0, 7.0, [-2.0, 0.0, 2.0, 4.0, 6.0])],
)
def test_ticks_are_round(low: float, high: float, expected: list[float]) -> None:
    np.testing.assert_allclose(ticks(low, high), expected, atol=1e-12)


def test_ticks_of_any_range_are_few_and_inside() -> None:
    rng = np.random.default_rng(2)
    for _ in range(200):
        low = float(rng.normal() * 10 ** rng.uniform(-4, 4))
        high = low + float(10 ** rng.uniform(-4, 4))
        found = ticks(low, high)
        assert 2 <= len(found) <= 11
        slack = 1e-6 * (high - low)
        assert low - slack <= found[0]
        assert found[-1] <= high + slack


@pytest.mark.parametrize(
    ("value", "shown"),
    [(0.0, "0"), (0.12345, "0.123"), (16.06, "16.1"), (1234.5, "1234"), (1e-7, "1.00e-07"),
     (math.nan, "n/a"), (-0.5, "-0.5"), (100.0, "100")],
)  # fmt: skip
def test_numbers_are_short(value: float, shown: str) -> None:
    assert number(value) == shown


def test_nan_breaks_a_line() -> None:
    line = Series(name="a", x=[0.0, 1.0, 2.0, 3.0, 4.0], y=[1.0, 2.0, math.nan, 3.0, 4.0])
    chart = line_chart([line], Labels(title="t", x="frame", y="mm"))
    path = re.search(r' d="(M[^"]*)" class="line"', chart)
    assert path is not None
    assert path.group(1).count("M") == 2
    assert "nan" not in chart


def test_lines_without_points_are_still_a_chart() -> None:
    chart = line_chart([Series(name="a", x=[], y=[])], Labels(title="t"))
    assert chart.startswith("<svg")
    assert "nan" not in chart
    assert "nan" not in bar_chart(["a", "b"], [math.nan, math.nan], Labels(title="t"))


def test_equal_neighbours_are_one_cell() -> None:
    chart = matrix_chart(
        ["a"], [["ok", "ok", "lost", "ok"]], {"ok": "#0f0", "lost": "#f00"}, Labels(title="t")
    )
    cells = re.findall(r'<rect [^>]*height="13"[^>]*fill="(#...)"', chart)
    assert cells == ["#0f0", "#f00", "#0f0"]


def test_per_frame_series_are_found_wherever_they_stand() -> None:
    report = {
        "views": 3,
        "frames": [{"frame": 0, "ncc": 0.9, "note": "x"}, {"frame": 1, "ncc": 0.8, "note": "y"}],
        "flow": {"samples": [10, 20]},
        "reprojection_px": [0.1, None],
        "constant": [1, 1],
        "long": [1, 2, 3],
    }
    found = per_frame(report, 2)
    assert list(found) == ["ncc", "reprojection_px", "flow.samples"]
    assert found["ncc"] == [0.9, 0.8]
    assert math.isnan(found["reprojection_px"][1])


def test_long_lists_are_summed_up() -> None:
    flat = flattened({"a": {"b": list(range(10))}, "c": [1, 2], "d": [{"x": 1}]})
    assert flat == {
        "a.b": "10 values, 0 to 9, mean 4.5", "c": "1, 2", "d": "1 entries"
    }  # fmt: skip


def test_dark_deep_plates_become_visible() -> None:
    plate = np.full((8, 8), 500, np.uint16)
    plate[0, 0] = 0
    shown = displayable(plate)
    assert shown.shape == (8, 8, 3)
    assert shown.dtype == np.uint8
    assert shown[4, 4].tolist() == [240, 240, 240]


def test_colours_run_from_dark_to_light_and_nan_is_grey() -> None:
    colours = sequential(np.array([0.0, 0.5, 1.0, np.nan]), 0.0, 1.0)
    light = colours @ [0.299, 0.587, 0.114]
    assert light[0] < light[1] < light[2]
    np.testing.assert_array_equal(colours[3], [0.6, 0.6, 0.6])


def test_studio_frames_and_lights_the_mesh() -> None:
    mesh = ball()
    view = studio_camera(mesh.vertices, 0.0, 80)
    picture = Studio(mesh).portrait(mesh.vertices, view)
    dark = (picture < 245).any(axis=2)
    rows, columns = np.flatnonzero(dark.any(axis=1)), np.flatnonzero(dark.any(axis=0))
    assert 2 <= columns[0] <= 6
    assert 73 <= columns[-1] <= 77
    assert abs(int(rows[0]) + int(rows[-1]) - 79) <= 1
    assert picture[30, 25].mean() > picture[60, 60].mean() + 10, "the key light is upper left"


def test_enlarged_and_cropped_cameras_see_the_same() -> None:
    whole = camera("left", -0.6)
    points = ball().vertices
    part = enlarged(cropped(whole, 10, 20, 40, 40), 2.5)
    expected = (whole.project(points) - [10, 20] + 0.5) * 2.5 - 0.5
    np.testing.assert_allclose(part.project(points), expected, atol=1e-9)
    assert (part.width, part.height) == (100, 100)


def test_hidden_vertices_are_not_drawn() -> None:
    mesh = ball()
    view = camera("front", 0.0)
    seen = Studio(mesh).visible(mesh.vertices, view)
    assert seen[mesh.vertices[:, 2] > 40].all()
    assert not seen[mesh.vertices[:, 2] < -10].any()
