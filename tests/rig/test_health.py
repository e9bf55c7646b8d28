"""Health: each figure from a rig whose fault is known, and the whole report as JSON."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture.arrays import Floats
from capture.errors import InputError
from rig.face_rig import FaceRig, write_rig
from rig.fit import Observations
from rig.health import detail_lost, held_out_error, rig_health
from rig.health_contact import closing_expressions, contact_report, measure_gap
from rig.health_symmetry import asymmetry, find_mirror, symmetry_report
from rig.health_weights import (
    activity,
    gauge_report,
    interference_report,
    jitter_report,
    overlaps,
)
from rig.mouth_close import convert_mouth_close, find_mouth_shapes, guess_convention
from rig.template import Template, write_template
from rig.weights import WeightPriors
from tests.rig.grid_face import grid_template, perform, performance_of, random_motions
from tools.cli import main
from track.performance import write_performance

FREE = WeightPriors(sparsity_mm2=0.0, evidence=0.0, smoothness=0.0, debias=False)
SIDE = 20


def _rig(frames: int = 12, seed: int = 0) -> FaceRig:
    rng = np.random.default_rng(seed)
    template = grid_template()
    weights = rng.uniform(0, 1, (frames, 6)) * (rng.uniform(size=(frames, 6)) < 0.5)
    weights[:, 5] = 0.0
    return FaceRig(
        neutral=template.neutral,
        deltas=template.deltas,
        names=template.names,
        polygons=template.polygons,
        weights=weights,
        head_from_rig=random_motions(frames, rng),
    )


def _observed(rig: FaceRig, noise_mm: float = 0.0, seed: int = 1) -> Observations:
    points = perform(rig.neutral, rig.deltas, rig.weights, rig.head_from_rig)
    points = points + np.random.default_rng(seed).normal(0, noise_mm, points.shape)
    contiguous = np.ones(len(points), dtype=bool)
    contiguous[0] = False
    return Observations(points, np.ones(points.shape[:2]), contiguous)


def _mouth() -> tuple[Template, Floats, Floats]:
    """The grid with a mouth (rows 6, 7) and eyes (rows 14, 15): pairs 11.6 mm apart in y."""
    base = grid_template()
    columns = np.arange(6, 14)
    lips = np.stack([7 * SIDE + columns, 6 * SIDE + columns], axis=1)
    lids = np.stack([15 * SIDE + columns, 14 * SIDE + columns], axis=1)
    down = np.array([0.0, -1.0, 0.0])
    jaw, close, blink = np.zeros((3, SIDE * SIDE, 3))
    below = base.neutral[:, 1] <= base.neutral[lips[0, 1], 1] + 1e-6
    jaw[below] = 9.0 * down
    apart = base.neutral[lips[:, 0]] - base.neutral[lips[:, 1]]
    close[lips[:, 1]] = apart - jaw[lips[:, 1]]
    blink[lids[:, 0]] = base.neutral[lids[:, 1]] - base.neutral[lids[:, 0]]
    template = Template(
        neutral=base.neutral,
        deltas=np.stack([jaw, close, blink]),
        names=("jawOpen", "mouthClose", "eyeBlink_L"),
        polygons=base.polygons,
        lid_pairs=lids,
        lip_pairs=lips,
    )
    return template, jaw, close


def test_held_out_error_is_nothing_for_the_true_shapes_and_told_for_others() -> None:
    rig = _rig()
    wrong = rig.deltas.copy()
    wrong[0] = wrong[0][:, [1, 0, 2]]
    told = held_out_error(rig, _observed(_rig(seed=7)), FREE, wrong)
    assert told["rmse_mm"] <= 1e-6
    assert told["template"]["rmse_mm"] > 0.1
    assert told["ratio"] <= 1e-5
    assert told["frames"] == 12


def test_held_out_error_finds_one_wrong_vertex_and_ignores_what_was_not_seen() -> None:
    rig = _rig()
    seen = _observed(rig)
    points, confidence = seen.points.copy(), seen.confidence.copy()
    points[3, 17] += [0.0, 0.0, 2.0]
    points[5, 40] += 500.0
    confidence[5, 40] = 0.0
    told = held_out_error(rig, replace(seen, points=points, confidence=confidence), FREE)
    assert (told["worst_frame"], told["worst_vertex"]) == (3, 17)
    assert told["max_mm"] == pytest.approx(2.0, abs=0.05)
    assert told["template"] is None
    assert max(told["per_frame_max_mm"]) == told["max_mm"]


def test_detail_lost_is_the_noise_that_was_added() -> None:
    rig = _rig(40)
    told = detail_lost(rig, _observed(rig, noise_mm=0.2))
    assert told["rmse_mm"] == pytest.approx(0.2 * np.sqrt(3), rel=0.02)


def test_activity_counts() -> None:
    weights = np.array([[0.0, 1.0, 0.005], [0.5, 1.0, 0.0], [0.0, 0.3, 0.05], [0.0, 0.0, 0.0]])
    told = activity(weights, ("a", "b", "c"))
    assert told["active_mean"] == pytest.approx(5 / 4)
    assert told["active_max"] == 2
    assert told["never_exercised"] == ["c"]
    assert told["at_zero_share"] == pytest.approx(6 / 12)
    assert told["at_one_share"] == pytest.approx(2 / 12)
    assert told["outside_bounds"] == 0


def test_a_shape_that_grew_while_its_weights_shrank_is_told() -> None:
    rig = _rig(40)
    deltas, weights = rig.deltas.copy(), rig.weights.copy()
    deltas[1] *= 2.0
    weights[:, 1] /= 2.0
    told = gauge_report(deltas, rig.deltas, weights, rig.names)
    assert told["drifted"] == ["mouthSmile_L"]
    assert told["weak"] == ["mouthSmile_L"]
    one = told["shapes"]["mouthSmile_L"]
    assert one["scale"] == pytest.approx(2.0)
    assert one["cosine"] == pytest.approx(1.0)
    assert one["amplitude"] == pytest.approx(rig.weights[:, 1].max())
    assert one["log_peak_weight"] == pytest.approx(np.log(weights[:, 1].max()))
    assert told["shapes"]["still"]["scale"] is None
    assert told["shapes"]["still"]["log_peak_weight"] is None


def test_overlap_and_cross_activation_are_told_apart() -> None:
    template = grid_template()
    deltas = template.deltas.copy()
    deltas[1] += deltas[0]  # the left smile took over the jaw's work
    cosines = overlaps(deltas)
    flat = deltas.reshape(6, -1)
    literal = flat[0] @ flat[1] / np.linalg.norm(flat[0]) / np.linalg.norm(flat[1])
    assert cosines[0, 1] == pytest.approx(literal)
    assert (cosines[5] == 0).all()
    rng = np.random.default_rng(0)
    weights = rng.uniform(size=(50, 6))
    weights[:, 3] = weights[:, 1]  # smile and brows always together
    told = interference_report(cosines, overlaps(template.deltas), weights, template.names)
    assert told["overlapping"][0]["shapes"] == ["jawOpen", "mouthSmile_L"]
    assert told["overlapping"][0]["template_cosine"] < told["overlapping"][0]["cosine"] - 0.2
    assert told["cross_activated"] == [
        {"shapes": ["mouthSmile_L", "browInnerUp"], "correlation": pytest.approx(1.0)}
    ]


def test_jitter_is_zero_for_a_steady_rise_and_that_of_the_noise_otherwise() -> None:
    template = grid_template()
    ramp = np.linspace(0, 0.9, 300)[:, None] * np.ones((1, 6))
    contiguous = np.ones(300, dtype=bool)
    contiguous[[0, 100, 102]] = False
    steady = jitter_report(ramp, template.deltas, contiguous, template.names)
    assert steady["weights_rms"] <= 1e-12
    assert [(t["first_frame"], t["frames"]) for t in steady["takes"]] == [(0, 100), (102, 198)]
    noise = np.random.default_rng(0).normal(0, 0.01, ramp.shape)
    rough = jitter_report(ramp + noise, template.deltas, contiguous, template.names)
    assert rough["weights_rms"] == pytest.approx(0.01 * np.sqrt(6), rel=0.05)
    faces = np.tensordot(noise, template.deltas, axes=1)
    bend = faces[:-2] - 2 * faces[1:-1] + faces[2:]
    used = np.r_[0:98, 102:298]
    assert rough["vertices_rms_mm"] == pytest.approx(
        np.sqrt((bend[used] ** 2).sum(axis=2).mean()), rel=1e-9
    )
    stills = jitter_report(ramp, template.deltas, np.zeros(300, dtype=bool), template.names)
    assert stills["weights_rms"] is None
    assert stills["takes"] == []


def test_gaps_and_penetration_of_pairs() -> None:
    before = np.array([[0, 5.0, 0], [0, 0, 0], [9, 5, 0], [9, 0, 0]])
    after = before + np.array([[0, -4.0, 0], [0, 0, 0], [0, -7, 0], [0, 0, 0]])
    gap = measure_gap(after, before, np.array([[0, 1], [2, 3]]))
    assert (gap.mean_mm, gap.max_mm, gap.penetration_mm) == (1.5, 2.0, 2.0)


def test_closing_expressions_are_found_and_an_open_blink_is_told() -> None:
    template, _, _ = _mouth()
    found = [(c.part, c.before, c.after) for c in closing_expressions(template)]
    assert found == [("lids", (), (2,)), ("lips", (0,), (0, 1))]
    deltas = template.deltas.copy()
    deltas[2] *= 0.8
    told = contact_report(template.neutral, deltas, template)
    blink, mouth = told["closed"]
    assert blink["expression"] == ["eyeBlink_L"]
    assert blink["gap_before_mm"] == pytest.approx(blink["template_gap_before_mm"])
    assert blink["gap_mean_mm"] == pytest.approx(0.2 * blink["gap_before_mm"])
    assert blink["template_gap_max_mm"] <= 1e-9
    assert mouth["expression"] == ["jawOpen", "mouthClose"]
    assert mouth["gap_max_mm"] <= 1e-9
    deltas[2] *= 1.5
    told = contact_report(template.neutral, deltas, template)["closed"][0]
    assert told["penetration_mm"] == pytest.approx(told["gap_max_mm"])


def test_a_blink_by_name_is_measured_where_rims_inside_the_skin_never_touch() -> None:
    template, _, _ = _mouth()
    deltas = template.deltas.copy()
    deltas[2] *= 0.5
    assert [c.part for c in closing_expressions(replace(template, deltas=deltas))] == [
        "lids", "lips",
    ]  # fmt: skip
    unnamed = replace(template, deltas=deltas, names=("jawOpen", "mouthClose", "squeeze"))
    assert [c.part for c in closing_expressions(unnamed)] == ["lips"]


def test_a_shape_that_parts_sealed_lips_is_told() -> None:
    template, _, _ = _mouth()
    deltas = template.deltas.copy()
    deltas[2][template.lip_pairs[:, 0]] += [0.0, 2.0, 0.0]
    (one,) = contact_report(template.neutral, deltas, template)["opened"]
    assert one["shape"] == "eyeBlink_L"
    assert one["opens_mm"] == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize("paired", [True, False])
def test_the_mouth_close_convention_is_guessed_and_converted_exactly(paired: bool) -> None:
    template, jaw, close = _mouth()
    pairs = template.lip_pairs if paired else None
    assert find_mouth_shapes(template.names) == (0, 1)
    assert guess_convention(template.neutral, jaw, close, pairs) == "corrective"
    assert guess_convention(template.neutral, jaw, close + jaw, pairs) == "combined"
    assert guess_convention(template.neutral, jaw, 0 * jaw, pairs) is None
    rig = FaceRig(
        neutral=template.neutral, deltas=template.deltas, names=template.names,
        polygons=template.polygons,
        weights=np.array([[0.9, 0.4, 0.1], [0.5, 0.5, 0], [0.2, 0.6, 0]]),
        head_from_rig=np.tile(np.eye(4), (3, 1, 1)),
    )  # fmt: skip
    there = convert_mouth_close(rig, "combined")
    assert isinstance(there.thing, FaceRig)
    assert (there.clipped_frames, there.worst_clip) == (1, pytest.approx(0.4))
    for frame in (0, 1):
        away = there.thing.evaluate(frame) - rig.evaluate(frame)
        assert np.abs(away).max() <= 1e-12
    back = convert_mouth_close(there.thing, "corrective").thing
    assert np.abs(back.deltas - rig.deltas).max() <= 1e-12
    assert isinstance(back, FaceRig)
    assert np.abs(back.weights[:2] - rig.weights[:2]).max() <= 1e-12
    combined = convert_mouth_close(template, "combined").thing
    assert isinstance(combined, Template)
    assert ((0,), (1,)) in [(c.before, c.after) for c in closing_expressions(combined)]


def test_mouth_shapes_that_are_not_there_are_asked_for() -> None:
    template, _, _ = _mouth()
    odd = replace(template, names=("a", "b", "c"))
    with pytest.raises(InputError, match="give their names"):
        convert_mouth_close(odd, "combined")
    with pytest.raises(InputError, match="no shape 'd'"):
        convert_mouth_close(odd, "combined", jaw="a", close="d")
    assert np.abs(convert_mouth_close(odd, "combined", "a", "b").thing.deltas[1]).max() > 0


def test_symmetry_of_mirrored_shapes() -> None:
    template = grid_template()
    mirror = find_mirror(template.neutral)
    told = symmetry_report(template.deltas, template.names, mirror)
    assert told["matched_share"] == 1.0
    assert told["pairs"][0]["left"] == "mouthSmile_L"
    assert told["pairs"][0]["template_asymmetry"] is None
    left = template.deltas[1]
    image = mirror.reflect(left)
    assert asymmetry(left, image, mirror) == pytest.approx(0.0, abs=1e-12)
    assert asymmetry(left, -image, mirror) == pytest.approx(2.0)
    assert asymmetry(left, 0.5 * image, mirror) == pytest.approx(0.5 / np.sqrt(0.625))
    assert asymmetry(0 * left, 0 * left, mirror) is None


def test_symmetry_is_not_judged_where_the_mesh_has_no_mirror() -> None:
    rng = np.random.default_rng(0)
    mirror = find_mirror(rng.uniform(-100, 100, (300, 3)))
    told = symmetry_report(rng.normal(size=(2, 300, 3)), ("a_L", "a_R"), mirror)
    assert told["matched_share"] < 0.1
    assert told["pairs"] == []


def test_the_whole_report_is_json_with_its_keys_and_the_same_twice() -> None:
    rig, template = _rig(30), grid_template()
    held_out = _observed(_rig(6, seed=9), 0.1)
    reports = [
        json.dumps(rig_health(rig, template, seen=_observed(rig, 0.1), held_out=held_out))
        for _ in range(2)
    ]
    assert reports[0] == reports[1]
    report = json.loads(reports[0])
    assert list(report) == [
        "version", "frames", "shapes", "degenerate", "held_out", "activity", "gauge", "contact",
        "symmetry", "interference", "jitter", "captures", "mouth_close",
    ]  # fmt: skip
    assert report["degenerate"]["zero"] == ["still"]
    assert report["gauge"]["drifted"] == []
    assert report["captures"]["undetermined"] == []
    assert "still" not in report["captures"]["uncertainty"]
    assert len(report["captures"]["leverage"]) == 30
    assert report["captures"]["noise_mm"] == pytest.approx(0.1 * np.sqrt(3), rel=0.05)
    assert report["mouth_close"] is None


def test_a_rig_alone_has_a_report_as_well() -> None:
    rig = replace(_rig(), weights=np.zeros((0, 6)), head_from_rig=np.zeros((0, 4, 4)))
    report = rig_health(rig)
    json.dumps(report, allow_nan=False)
    assert report["contact"] is None
    assert report["held_out"] is None
    assert report["captures"]["undetermined"] == list(rig.names[:5])
    assert len(report["captures"]["shoot_next"]) == 5


def test_what_does_not_fit_is_refused_with_both_sides() -> None:
    rig, template = _rig(), grid_template()
    with pytest.raises(InputError, match="not in both: other, still"):
        rig_health(rig, replace(template, names=(*template.names[:5], "other")))
    with pytest.raises(InputError, match="in another order"):
        rig_health(rig, replace(template, names=template.names[::-1]))
    with pytest.raises(InputError, match="solved on 12 frames, the performances hold 11"):
        rig_health(rig, seen=_observed(_rig(11)))
    with pytest.raises(InputError, match="the rig has 400 vertices, the template 100"):
        rig_health(rig, replace(grid_template(10), names=template.names))


def test_the_verb_tells_a_summary_and_writes_the_whole(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig, template = _rig(), grid_template()
    write_rig(tmp_path / "rig.npz", rig)
    write_template(tmp_path / "template.npz", template)
    seen = performance_of(_observed(rig).points, rig.polygons)
    write_performance(tmp_path / "seen.npz", seen)
    words = [
        "health", str(tmp_path), "--template", str(tmp_path / "template.npz"),
        "--performance", str(tmp_path / "seen.npz"), "--held-out", str(tmp_path / "seen.npz"),
        "--out", str(tmp_path / "health.json"),
    ]  # fmt: skip
    assert main(words) == 0
    told = capsys.readouterr().err
    assert "shapes without effect: still" in told
    assert "held-out error: 0.0" in told
    assert main([*words, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((tmp_path / "health.json").read_text(encoding="utf-8"))
    assert main(["health", str(tmp_path / "seen.npz")]) == 2
    assert "expected a rig or a template, found Performance" in capsys.readouterr().err
