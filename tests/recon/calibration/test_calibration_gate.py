"""The gate: the right thing is said of each fault, and nothing of a good calibration."""

from __future__ import annotations

import copy
import csv
import dataclasses
import json
import math
from collections.abc import Callable
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from capture.arrays import Bools
from capture.errors import SettingsError
from recon.array_state import ArrayState
from recon.board.shape import BoardShape
from recon.calibration.board_numbers import board_numbers
from recon.calibration.corner_log import COLUMNS, WHOLE_VIEW, rejection_reasons, write_corner_log
from recon.calibration.covariance import array_covariance
from recon.calibration.gate import GateSettings, judge_calibration
from recon.calibration.gate_levels import BAD, WARN
from recon.calibration.place_words import find_gaps, image_regions, listed, toward, way_from_middle
from recon.calibration.report import (
    ReportExtras,
    calibration_report,
    scale_bar_numbers,
    summary_of,
)
from recon.calibration.scale_bar import BarLength
from recon.calibration.solver import ArraySolution, CalibrateSettings, solve_array
from recon.calibration.volume_coverage import ball_grid, volume_coverage
from tools.bench.board_scene import A4_BOARD, BoardScene, make_state, observe

GOOD = BoardScene(
    size_px=640, focal_px=1440.0, radius_mm=620.0, devices=6, poses=30, span_deg=45.0,
    outliers=0.005, hidden=0.65,
)  # fmt: skip
Report = dict[str, Any]
Edit = Callable[[ArraySolution], ArraySolution]


@cache
def solved(scene: BoardScene = GOOD) -> tuple[ArrayState, ArraySolution]:
    truth = make_state(scene)
    return truth, solve_array(observe(scene, truth), A4_BOARD.corners_mm(), CalibrateSettings())


def whole(solution: ArraySolution) -> ArraySolution:
    return solution


def without(solution: ArraySolution, keep: Bools) -> ArraySolution:
    """The same cameras as found from fewer sightings, and how well those would determine them."""
    seen, kept = solution.observations.select(keep), solution.kept[keep]
    return dataclasses.replace(
        solution, observations=seen, kept=kept, residuals=solution.residuals[keep],
        limit_px=solution.limit_px[keep],
        covariance=array_covariance(
            solution.state, seen.select(kept), solution.shape, solution.sigma_px
        ),
    )  # fmt: skip


def left_half_of_one_device(solution: ArraySolution) -> ArraySolution:
    seen = solution.observations
    return without(solution, ~((seen.device == 2) & (seen.pixels[:, 0] > 300)))


def right_half_of_the_volume(solution: ArraySolution) -> ArraySolution:
    right = solution.state.points(solution.observations)[:, 0] > -10.0
    often = np.bincount(solution.observations.corner[right & solution.kept], minlength=88) >= 6
    return without(solution, right & often[solution.observations.corner])


def one_device_out_of_step(solution: ArraySolution) -> ArraySolution:
    seen = solution.observations
    jump = np.random.default_rng(0).normal(0, 2.0, (len(seen.frames), 2))[seen.pose]
    jump[(seen.pose % 3 != 0) | (seen.device != 1)] = 0.0
    residuals = solution.residuals + jump
    kept = solution.kept & (np.linalg.norm(residuals, axis=1) <= solution.limit_px)
    return dataclasses.replace(solution, residuals=residuals, kept=kept)


def few_views_of_one_device(solution: ArraySolution) -> ArraySolution:
    seen = solution.observations
    first = np.unique(seen.pose[seen.device == 5])[:12:2]
    return without(solution, (seen.device != 5) | np.isin(seen.pose, first))


def edited(edit: Edit) -> ArraySolution:
    return edit(solved()[1])


@cache
def _report(edit: Edit = whole) -> Report:
    return calibration_report(edited(edit), A4_BOARD)


def report_of(edit: Edit = whole) -> Report:
    return copy.deepcopy(_report(edit))


def told(gate: Report) -> str:
    return "\n".join(reason["words"] for reason in gate["reasons"])


def test_a_good_calibration_is_good_and_nothing_is_said_of_it() -> None:
    gate = report_of()["gate"]
    assert gate["reasons"] == []
    assert gate["verdict"] == "good"
    assert gate["more_poses"] == 0
    assert gate["headline"].startswith("Good: the calibration leaves")


@pytest.mark.slow
def test_good_takes_of_many_arrays_are_good() -> None:
    layouts = ("arc", "rows", "clusters", "pairs", "turned", "ring")
    for seed, (layout, devices) in enumerate(product(layouts, (4, 8, 12))):
        scene = dataclasses.replace(
            GOOD, layout=layout, devices=devices, seed=seed, poses=70 if layout == "ring" else 40,
            span_deg=(40.0, 50.0)[seed % 2], bow_mm=(0.0, 0.2)[seed % 2], hidden=0.3,
        )  # fmt: skip
        gate = calibration_report(solved(scene)[1], A4_BOARD)["gate"]
        assert gate["verdict"] == "good", f"{layout}, {devices} devices: {told(gate)}"


def test_a_device_covered_by_half_is_told_which_half() -> None:
    gate = report_of(left_half_of_one_device)["gate"]
    assert gate["verdict"] == "usable"
    assert {reason["device"] for reason in gate["reasons"]} == {"cam02"}
    assert "the right of its image, where it has not been" in told(gate)


def test_a_volume_covered_by_half_is_told_which_half_once() -> None:
    report = report_of(right_half_of_the_volume)
    thin = report["volume"]["thin"]
    assert len(thin) == 1
    assert thin[0].startswith(
        "nothing was shown in the left of the face volume (as the operator sees it from the "
        "cameras; to the actor's right), about 60 mm to the left"
    )
    grid = report["volume"]["corners"]
    cells = np.array([np.nan if n is None else n for n in grid]).reshape(8, 8, 8)
    assert np.nansum(cells[:, :, :3]) == 0, "x runs fastest, -x first"
    assert np.nansum(cells[:, :, 5:]) > 100
    assert report["gate"]["verdict"] == "usable"
    assert sum("face volume" in reason["words"] for reason in report["gate"]["reasons"]) >= 1


def test_a_device_out_of_step_is_named_and_no_poses_are_asked_for() -> None:
    gate = report_of(one_device_out_of_step)["gate"]
    assert gate["verdict"] == "bad"
    first = gate["reasons"][0]
    assert (first["level"], first["device"]) == ("bad", "cam01")
    assert "whole views do not fit the other devices: was it triggered" in first["words"]
    assert gate["headline"].startswith("Do not use these cameras: cam01: ")
    assert gate["more_poses"] == 0, "poses do not mend it"
    assert all(reason["device"] in (None, "cam01") for reason in gate["reasons"])


def test_a_device_with_few_views_is_told_how_many_more() -> None:
    gate = report_of(few_views_of_one_device)["gate"]
    assert gate["verdict"] == "bad"
    first = gate["reasons"][0]
    assert first["device"] == "cam05"
    assert first["words"].startswith("cam05: saw the board in 6 poses only (8 are the least")
    assert 9 <= first["more_poses"] <= 15
    assert gate["more_poses"] >= first["more_poses"]
    assert gate["headline"].startswith("Not good enough: cam05")


@pytest.mark.parametrize("edit", [whole, one_device_out_of_step])
def test_the_report_can_be_judged_again_from_its_file(edit: Edit) -> None:
    report = report_of(edit)
    text = json.dumps(report, allow_nan=False)
    assert judge_calibration(json.loads(text)) == report["gate"]
    assert json.dumps(calibration_report(edited(edit), A4_BOARD), allow_nan=False) == text


def test_levels_follow_the_pixels_of_the_array() -> None:
    levels = GateSettings()
    assert levels.volume_levels_um(0.225) == pytest.approx((5.0, 20.0))
    assert levels.volume_levels_um(math.nan) == pytest.approx((5.0, 20.0))
    assert levels.volume_levels_um(0.45) == pytest.approx((10.0, 40.0))
    assert levels.volume_levels_um(50.0) == pytest.approx((25.0, 100.0))
    assert levels.volume_levels_um(0.01) == pytest.approx((2.0, 2.0))
    report = report_of()
    report["uncertainty"]["rms_um"] = 8.0
    assert judge_calibration(report)["verdict"] == "good", "0.43 mm a pixel"
    report["volume"]["pixel_mm"] = 0.225
    gate = judge_calibration(report)
    assert gate["verdict"] == "usable"
    assert "leaves 8 um of error over the face volume" in told(gate)
    assert gate["more_poses"] == 30, "(8 / 5)^2 = 2.56 times 30, but no more than twice at a time"
    report["uncertainty"]["rms_um"] = 5.5
    assert judge_calibration(report)["more_poses"] == math.ceil(30 * (1.1**2 - 1))
    report["uncertainty"]["rms_um"] = 21.0
    assert judge_calibration(report)["verdict"] == "bad"


def test_where_the_error_is_largest_is_said() -> None:
    report = report_of()
    nodes = ball_grid(1.0, 0.2, 11)
    values = report["uncertainty"]["calibration_um"]
    report["uncertainty"]["calibration_um"] = [
        None if value is None else 5.0 + 4.0 * (x + y)
        for value, (x, y, _) in zip(values, nodes.tolist(), strict=True)
    ]
    report["uncertainty"]["rms_um"] = 15.0
    assert "most in the upper right of the face volume (as the operator" in told(
        judge_calibration(report)
    )


def _set(report: Report, path: str, value: Any) -> Report:
    *keys, last = path.split(".")
    inner = report
    for key in keys:
        inner = inner[key]
    inner[last] = value
    return report


@pytest.mark.parametrize(
    ("path", "value", "verdict", "words"),
    [
        ("converged", False, "bad", "the solve stopped before it settled"),
        ("robust_sigma_px", 0.3, "usable", "corners scatter by 0.30 px"),
        ("robust_sigma_px", 0.6, "bad", "corners scatter by 0.60 px"),
        ("held_out.ratio", 1.2, "usable", "fit 1.20 times worse than those in it"),
        ("held_out.ratio", 2.0, "bad", "fit 2.00 times worse"),
        ("held_out.ratio", None, "usable", "not checked: held-out poses"),
        ("split_half.p95_px", 0.15, "usable", "differ by 0.15 px"),
        ("split_half.p95_px", 0.5, "bad", "differ by 0.50 px"),
        ("split_half", {"p95_px": None, "remark": "too few"}, "usable", "poses (too few)"),
        ("uncertainty", None, "usable", "not checked: the error over the face volume"),
        ("board.faces", [{"bow_mm": 1.4, "width_over_height": 1.0}], "usable", "bent by 1.4 mm"),
        ("board.faces", [{"width_over_height": 1.004}], "usable", "1.0040 times as wide as high"),
        ("board.shape_solved", False, "usable", "shape of the board was not solved for"),
        ("volume.shown", 0.2, "good", ""),
        ("volume.visible", 0.1, "usable", "two devices see 10 % of the face volume only"),
    ],
)
def test_each_fault_is_said_once_with_its_level(
    path: str, value: Any, verdict: str, words: str
) -> None:
    gate = judge_calibration(_set(report_of(), path, value))
    assert gate["verdict"] == verdict
    assert words in told(gate)
    assert len(gate["reasons"]) == (0 if verdict == "good" else 1)
    assert gate["reasons"] == [] or gate["reasons"][0]["level"] == (
        BAD if verdict == "bad" else WARN
    )


def test_a_wrong_square_size_shows_in_the_scale_bar() -> None:
    bar = BarLength(length_mm=200.0, measured_mm=202.0, sigma_mm=0.02, frames=9)
    report = calibration_report(
        solved()[1], A4_BOARD, extras=ReportExtras(scale_bar=scale_bar_numbers(bar))
    )
    first = report["gate"]["reasons"][0]
    assert first["level"] == "bad"
    assert "measures 202.00 mm in 9 frames where its file says 200.00 mm" in first["words"]
    assert "0.9901 times what the board file says" in first["words"]
    unsure = dataclasses.replace(bar, sigma_mm=1.0)
    report["scale_bar"] = scale_bar_numbers(unsure)
    assert judge_calibration(report)["verdict"] == "good", "within three standard deviations"
    unknown = scale_bar_numbers(dataclasses.replace(bar, sigma_mm=math.nan, frames=1))
    assert unknown is not None
    assert unknown["sigma_mm"] is None
    assert judge_calibration(dict(report, scale_bar=unknown))["verdict"] == "bad"
    unseen = dataclasses.replace(bar, measured_mm=math.nan, frames=0)
    assert scale_bar_numbers(unseen) is None


def test_equal_reasons_are_merged_over_devices() -> None:
    report = report_of()
    for device, views in zip(report["devices"], (20, 12, 20, 12, 9, 20), strict=True):
        device["views"] = views
        device["tilt_gaps"] = ["left"] if views < 15 else []
    gate = judge_calibration(report)
    assert len(gate["reasons"]) == 1
    assert gate["reasons"][0]["words"] == (
        "cam01, cam03 and cam04: saw the board in 9 to 12 poses only (15 are good): "
        "3 to 6 more poses with the board tilted to the left"
    )
    assert gate["reasons"][0]["device"] is None
    assert gate["more_poses"] == 6, "aimed at them together"


def test_reasons_stay_few_and_the_worst_come_first() -> None:
    report = report_of()
    one = report["devices"][0]
    report["devices"] = []
    for index in range(40):
        device = dict(copy.deepcopy(one), name=f"cam{index:02d}", views=5 + index % 9)
        device["tilt_gaps"] = ["left", "right", "up", "down"][: index % 5]
        device["image_gaps"] = [[1, 0], [-1, 1], [0, -1]][: index % 4]
        if index % 3 == 0:
            device["fx_sigma_px"] = 0.004 * device["fx_px"]
        report["devices"].append(device)
    report["converged"] = False
    report["volume"]["thin"] = [f"nothing was shown in {k}" for k in range(14)]
    report["volume"]["thin_poses"] = [2] * 14
    gate = judge_calibration(report)
    assert len(gate["reasons"]) == 12
    levels = [reason["level"] for reason in gate["reasons"]]
    assert levels == sorted(levels), "bad before warn"
    assert gate["reasons"][0]["words"].startswith("the solve stopped")
    assert gate["reasons"][-1]["words"].startswith("and ")
    assert gate["more_poses"] <= 60


def test_a_report_of_an_older_version_is_judged_by_what_it_holds() -> None:
    report = report_of()
    old = {
        key: report[key]
        for key in (
            "mean_reprojection_px",
            "robust_sigma_px",
            "converged",
            "poses_used",
            "held_out",
        )
    }
    new = ("sigmas", "tilts_deg", "heat", "image_gaps", "tilt_gaps")
    old["devices"] = [
        {key: value for key, value in device.items() if key not in new}
        for device in report["devices"]
    ]
    gate = judge_calibration(old)
    assert gate["verdict"] == "usable"
    assert told(gate).startswith("not checked: the error over the face volume and solves from")


def test_an_array_whose_covariance_is_unknown_is_bad_as_a_whole() -> None:
    report = calibration_report(dataclasses.replace(solved()[1], covariance=None), A4_BOARD)
    assert report["uncertainty"] is None
    assert all(device["sigmas"] is None for device in report["devices"])
    gate = report["gate"]
    assert gate["verdict"] == "bad"
    assert [reason["device"] for reason in gate["reasons"]] == [None, None]
    assert gate["reasons"][0]["words"].startswith("these poses do not determine lenses")
    report["devices"][3]["fx_sigma_px"] = 0.1
    gate = judge_calibration(report)
    assert "cam00: the focal length could not be determined: 8 more poses" in told(gate)
    assert "cam03" not in told(gate)


def test_levels_the_wrong_way_round_are_refused() -> None:
    with pytest.raises(SettingsError, match="usable_um: must not be stricter than good_um"):
        GateSettings(usable_um=1.0)
    with pytest.raises(SettingsError, match="usable_views"):
        GateSettings(usable_views=20)


@pytest.mark.parametrize("axes", [2, 3])
def test_gaps_name_what_was_cut_away(axes: int) -> None:
    grid = ball_grid(1.0, 0.2, 11)
    places = np.unique(grid[np.linalg.norm(grid, axis=1) <= 1.0][:, :axes], axis=0)
    for signs in np.array(np.meshgrid(*[(-1, 0, 1)] * axes)).reshape(axes, -1).T:
        if not signs.any():
            continue
        cut = (places * signs > 0)[:, signs != 0].all(axis=1)
        gaps = find_gaps(places, ~cut, least=0.4)
        assert [gap.signs for gap in gaps] == [tuple(signs.tolist())]
        assert toward(gaps[0].middle) == tuple(signs.tolist())
    assert find_gaps(places, np.ones(len(places), np.bool_), least=0.4) == []
    nothing = find_gaps(places, np.zeros(len(places), np.bool_), least=0.4)
    assert [gap.signs for gap in nothing] == [()]
    hollow = find_gaps(places, np.abs(places).max(axis=1) > 0.5, least=0.4)
    assert [gap.signs for gap in hollow] == [(0,) * axes]
    assert find_gaps(places[:0], np.zeros(0, np.bool_), least=0.4) == []


def test_words_of_places() -> None:
    assert image_regions([(-1, 0), (1, -1), (0, 0), (0, 1)]) == (
        "the left, the lower right, the middle and the top of its image"
    )
    assert image_regions([()]) == "all parts of its image"
    assert way_from_middle(np.array([-58.0, 71.0, 4.0]), 120.0) == (
        "about 70 mm up and 60 mm to the left, counted from its middle"
    )
    assert way_from_middle(np.array([0.0, 0.0, -60.0]), 120.0) == (
        "about 60 mm away from the cameras, counted from its middle"
    )
    assert way_from_middle(np.zeros(3), 120.0) == ""
    assert listed(["a", "b", "c", "d"], 3) == "a, b and 2 more"


def test_a_larger_volume_is_thin_around() -> None:
    volume = volume_coverage(solved()[1], 400.0)
    assert volume["edge_mm"] == 100.0
    assert volume["visible"] < 0.5, "what no two devices see is not asked for"
    assert sum(1 for n in volume["corners"] if n is None) == 8**3 - 280


def test_the_map_of_uncertainty_lies_where_it_says() -> None:
    _, solution = solved()
    grid = _report()["uncertainty"]
    nodes = ball_grid(120.0, 24.0, 11)
    np.testing.assert_allclose(grid["origin_mm"], nodes[0])
    outside = np.linalg.norm(nodes, axis=1) > 120.001
    assert [value is None for value in grid["calibration_um"]] == outside.tolist()
    assert solution.covariance is not None
    inside = np.flatnonzero(~outside)
    noise = solution.covariance.noise_sigma(nodes[inside])
    alone = np.array([grid["calibration_um"][k] for k in inside])
    both = np.array([grid["with_noise_um"][k] for k in inside])
    expected = np.sqrt(alone**2 + 1e6 * np.trace(noise, axis1=1, axis2=2))
    np.testing.assert_allclose(both, expected, rtol=1e-3)
    assert grid["rms_um"] == pytest.approx(np.sqrt((alone**2).mean()), rel=1e-3)


def test_tilts_are_those_of_the_true_boards() -> None:
    truth, solution = solved()
    for index, device in enumerate(_report()["devices"]):
        used = solution.kept & (solution.observations.device == index)
        rotation = truth.cameras[index].camera_from_world.rotation
        turns = []
        for pose in np.unique(solution.observations.pose[used]):
            x, y, z = -(rotation @ truth.array_from_board[pose].rotation)[:, 2]
            turns.append(np.degrees([np.arctan2(x, -z), np.arctan2(-y, -z)]))
        right, up = np.array(turns).T
        expected = {"left": -right.min(), "right": right.max(), "up": up.max(), "down": -up.min()}
        for way, angle in device["tilts_deg"].items():
            assert angle == pytest.approx(max(expected[way], 0.0), abs=0.2)


def test_device_numbers_agree_with_each_other() -> None:
    _, solution = solved()
    for index, device in enumerate(_report()["devices"]):
        counts = np.array(device["coverage"])
        for key in ("size_px", "dx_px", "dy_px"):
            heat = np.array(
                [[np.nan if v is None else v for v in row] for row in device["heat"][key]]
            )
            np.testing.assert_array_equal(np.isnan(heat), counts == 0)
            if key == "size_px":
                mean = np.nansum(heat * counts) / counts.sum()
                assert mean == pytest.approx(device["mean_reprojection_px"], rel=1e-3)
        assert device["sigmas"]["fx_px"] == pytest.approx(device["fx_sigma_px"])
        assert 0.1 < math.hypot(*device["sigmas"]["place_um"]) < 200.0
        assert solution.observations.device_names[index] == device["name"]
    assert "heat" not in summary_of(_report())["devices"][0]
    assert "heat" in _report()["devices"][0]


def test_the_log_holds_every_rejected_corner(tmp_path: Path) -> None:
    solution = edited(one_device_out_of_step)
    path = tmp_path / "rejected.csv"
    write_corner_log(path, solution)
    first = path.read_bytes()
    write_corner_log(path, solution)
    assert path.read_bytes() == first
    with path.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert tuple(rows[0]) == COLUMNS
    assert len(rows) == int((~solution.kept).sum())
    assert all(float(row["size_px"]) >= float(row["limit_px"]) for row in rows)
    assert sum(row["device"] == "cam01" for row in rows) > 0.8 * len(rows)
    summary = report_of(one_device_out_of_step)["rejected"]
    assert sum(entry["rejected"] for entry in summary["devices"].values()) == len(rows)
    assert sum(entry["rejected"] for entry in summary["frames"]) == len(rows)
    assert summary["reasons"][WHOLE_VIEW] == sum(row["reason"] == WHOLE_VIEW for row in rows)
    assert summary["devices"]["cam01"]["whole_views"] >= 3
    assert rejection_reasons(solution).count("") == int(solution.kept.sum())


def test_each_face_has_its_own_flatness() -> None:
    _, solution = solved()
    corners = solution.state.corners.copy()
    face = (np.arange(len(corners)) >= 44).astype(np.int64)
    second = corners[face == 1]
    corners[face == 1, 2] += 0.4 * np.abs(np.linspace(-1, 1, len(second)))
    nominal = A4_BOARD.corners_mm()
    shape = BoardShape(
        corners=nominal, face=face, flat=nominal[:, :2], placed=np.ones(2, dtype=np.bool_)
    )
    state = dataclasses.replace(solution.state, corners=corners)
    two = dataclasses.replace(solution, state=state, shape=shape)
    board = board_numbers(two, ["front", "back"])
    assert [entry["name"] for entry in board["faces"]] == ["front", "back"]
    assert board["faces"][0]["bow_mm"] < 0.05
    assert board["faces"][1]["bow_mm"] > 0.3
    assert board["bow_mm"] == board["faces"][1]["bow_mm"]
    assert sum(entry["corners"] for entry in board["faces"]) == board["corners"] == len(corners)
