"""The page of a rig: sections by what is there, verdicts in words, honest pictures and numbers."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from capture.errors import ShapeError
from rig.face_rig import FaceRig, write_rig
from rig.template import Template, write_template
from tests.rig.grid_face import grid_template, perform, performance_of, random_motions
from tools.report import write_rig_page
from tools.report.rig_charts import convergence, round_up, weight_map
from tools.report.rig_inputs import RigInputs, read_rig_inputs
from tools.report.rig_page import document_body
from tools.report.rig_pictures import frame_errors, key_frames
from tools.report.rig_remarks import found, rig_remarks, scales
from tools.verbs.rig import take_name
from track.performance import Performance

FRAMES = 6
NASTY = "odd</script><b>&\"'"
TURN = {"data": 9.0, "gradient": 1.0, "offset": 2.0, "rms_mm": 0.3, "worst_mm": 1.0, "total": 12.0}


def make_case(folder: Path, *, before: bool = True) -> tuple[Template, Performance]:
    """A rig whose first shape grew by half, and the frames it was solved on, without noise."""
    template = grid_template(12)
    template = replace(template, names=(*template.names[:4], NASTY, template.names[5]))
    rng = np.random.default_rng(3)
    deltas = template.deltas.copy()
    deltas[0] *= 1.6
    weights = np.zeros((FRAMES, len(template.names)))
    weights[:, :4] = rng.uniform(0.0, 1.0, (FRAMES, 4))
    weights[0], weights[5, 0] = 0.0, 1.0  # the template cannot reach 1.6 at weight 1
    motions = random_motions(FRAMES, rng)
    rig = FaceRig(
        neutral=template.neutral + [0.0, 0.0, 0.4], deltas=deltas, names=template.names,
        polygons=template.polygons, weights=weights, head_from_rig=motions,
    )  # fmt: skip
    performance = performance_of(perform(rig.neutral, deltas, weights, motions), template.polygons)
    performance.confidence[2, :20] = 0.0
    write_rig(folder / "rig.npz", rig)
    if before:
        write_template(folder / "transferred.npz", template)
    report = {
        "residual_transferred_mm": 1.0,
        "residual_refined_mm": 0.3,
        "ratio": 0.3,
        "residual_per_frame_mm": [0.1, 0.2, 0.5, 0.3, 0.2, 0.1],
        "active_shapes_mean": 3.1,
        "never_exercised": [NASTY],
        "dropped_zero_shapes": ["still"],
        "iterations": [TURN, TURN | {"data": 5.0, "total": 8.0}],
        "health": HEALTH,
    }
    (folder / "report.json").write_text(json.dumps(report), encoding="utf-8")
    return template, performance


HEALTH: dict[str, Any] = {
    "degenerate": {
        "duplicates": [{"shape": "b", "of": "a", "scale": 1.0}],
        "dependent": [{"shape": "c", "equals": "c = 0.5 a + 0.5 d"}],
        "condition": 31.5,
    },
    "contact": {
        "closed": [
            {
                "expression": ["eyeBlink_L"], "part": "lids", "gap_mean_mm": 2.4,
                "template_gap_mean_mm": 0.1,
            },
            {"expression": ["mouthClose"], "part": "lips", "gap_mean_mm": 0.2},
        ]
    },
    "scales": {"a": {"scale": 1.0, "peak": 0.2}, "b": {"scale": 2.0, "peak": 0.3}},
    "held_out": {"ratio": 0.5},
    "captures": {
        "undetermined": ["mouthSmile_L"], "shoot_next": [{"shapes": ["x", "y"], "gain": 0.3}]
    },
    "mouth_close": {"shape": "mouthClose", "convention": "seals", "template_convention": "adds"},
    "something new": {"deep": {"deeper": [1.0, 2.0, 3.0]}},
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("rig")


@pytest.fixture(scope="module")
def case(folder: Path) -> tuple[Template, Performance]:
    return make_case(folder)


@pytest.fixture(scope="module")
def inputs(folder: Path, case: tuple[Template, Performance]) -> RigInputs:
    return read_rig_inputs(folder, template=case[0], performances=[case[1]], takes=["smile"])


@pytest.fixture(scope="module")
def page(folder: Path, case: tuple[Template, Performance]) -> str:
    template, performance = case
    out = folder / "page" / "report.html"
    write_rig_page(folder, template, out, performances=[performance], takes=["smile"])
    return out.read_text(encoding="utf-8")


def test_sections_stand_in_order(page: str) -> None:
    assert re.findall(r'<section id="(\w+)"', page) == [
        "fit", "view", "shapes", "errors", "weights", "convergence", "health", "numbers",
    ]  # fmt: skip


def test_page_needs_nothing_else(page: str) -> None:
    outside = re.findall(r'(?:src|href)="(?!data:|#)([^"]*)"', page)
    assert outside == []
    assert not re.search(r"https?://|url\(|@import", page)


def test_names_are_escaped_everywhere(page: str) -> None:
    assert "<b>&\"'" not in page
    assert "odd&lt;/script&gt;" in page
    assert page.count("<script") == page.count("</script>") == 4


def test_same_rig_gives_the_same_bytes(
    page: str, folder: Path, case: tuple[Template, Performance], tmp_path: Path
) -> None:
    out = tmp_path / "again.html"
    write_rig_page(folder, case[0], out, performances=[case[1]], takes=["smile"])
    assert out.read_text(encoding="utf-8") == page


def test_verdicts_say_what_is_wrong(page: str) -> None:
    head = page[page.index("<header>") : page.index("</header>")]
    for words in (
        "residual 0.3 mm after refinement, 0.30 of the transferred",
        "3.1 of 6 act in a frame",
        "1 shape is not in these takes",
        "1 of the template move nothing and were left out: still",
        "jawOpen (1.60)",
        "1 of 1 expressions that shut in the template stay open, worst eyeBlink_L: 2.4 mm",
        "Lips:</b> shut in all 1",
        "Held-out frames:</b> the residual is 0.50 of",
        "hardly shown by these frames: mouthSmile_L; shoot next: x + y",
        "mouthClose follows seals, in the template adds",
        "b = a",
        "c = 0.5 a + 0.5 d",
        "Not good: read the red lines first.",
    ):
        assert words in head, words


def test_errors_are_those_of_the_frames(inputs: RigInputs) -> None:
    errors = frame_errors(inputs, [0, 2, 5])
    assert np.isnan(errors.after[1, :20]).all(), "what nobody saw has no error"
    assert np.nanmax(errors.after) < 1e-3, "the rig made these frames: only float32 is left"
    assert errors.before is not None
    assert np.nanmax(errors.before[2]) > 0.1, "the template before cannot reach them"
    assert errors.template_posed.shape == (3, 144, 3)


def test_key_frames_have_the_worst_and_the_peak(inputs: RigInputs) -> None:
    assert set(key_frames(inputs)) == set(range(FRAMES))
    many = replace(inputs, report=dict(inputs.report, residual_per_frame_mm=[0.0]))
    chosen = key_frames(many)
    assert chosen[int(inputs.rig.weights.sum(axis=1).argmax())] == "peak"
    assert "worst" not in chosen.values(), "a list of other frames is not trusted"


def test_scale_is_told_from_the_shapes(inputs: RigInputs) -> None:
    sizes = scales(inputs)
    assert sizes["jawOpen"] == pytest.approx(1.6, abs=1e-6)
    assert "still" not in sizes
    told = [v for v in rig_remarks(inputs) if v.subject == "Scale drifted:"]
    assert len(told) == 1
    kept = replace(inputs, before=replace(inputs.before, deltas=inputs.rig.deltas))
    assert [v.level for v in rig_remarks(kept) if v.subject == "Scale:"] == ["good"]


def test_stills_are_told_from_motion(inputs: RigInputs) -> None:
    assert not inputs.is_motion, "numbers follow each other, weights do not"
    ramp = np.linspace(0.0, 1.0, 40)[:, None] * np.array([[1.0, 0.5, 0, 0, 0, 0]])
    rig = replace(inputs.rig, weights=ramp, head_from_rig=np.tile(np.eye(4), (40, 1, 1)))
    moving = replace(inputs, rig=rig, performances=(), takes=())
    assert moving.is_motion
    assert np.allclose(np.diff(moving.times_s), 1 / 30)


def test_bare_rig_is_still_a_page(tmp_path: Path) -> None:
    make_case(tmp_path, before=False)
    (tmp_path / "report.json").unlink()
    text = write_rig_page(tmp_path, None, tmp_path / "r.html").read_text(encoding="utf-8")
    sections = re.findall(r'<section id="(\w+)"', text)
    assert sections == ["fit", "view", "shapes", "weights", "numbers"]
    assert "data-change" not in text[text.index("<body") : text.index("<style>.rigview")]
    assert 'class="verdict' not in text


@pytest.mark.parametrize("health", [None, [], "none", {}, {"closed": None, "duplicates": 3}])
def test_odd_health_breaks_nothing(inputs: RigInputs, health: object) -> None:
    odd = replace(inputs, report=dict(inputs.report, health=health))
    subjects = {verdict.subject for verdict in rig_remarks(odd)}
    assert not subjects & {"Duplicates:", "Lids do not shut:", "Dependent shapes:"}


def test_health_is_shown_whatever_it_holds() -> None:
    body = document_body(HEALTH)
    assert "<h3>something new</h3>" in body
    assert "<th>gap mean mm</th>" in body
    assert "<td>b</td>" in body
    assert found(HEALTH, "deeper") == [1.0, 2.0, 3.0]
    assert found(HEALTH, "nowhere") is None


def test_weight_map_and_convergence() -> None:
    weights = np.random.default_rng(0).uniform(size=(30, 3))
    chart = weight_map(["a", "b", "c"], weights, [(0, "one"), (12, "two")])
    assert chart.count("data:image/png;base64,") == 1
    assert ">two</text>" in chart
    told = convergence([TURN, TURN])
    assert all(words in told for words in ("E_g, data", "E_r, gradients", "E_d, offsets", "total"))
    assert "residual, mm RMS" in told
    assert convergence([]) == ""
    assert "<table>" in convergence([{"other": 3.0}])


@pytest.mark.parametrize(("value", "end"), [(0.0, 1.0), (0.21, 0.3), (1.0, 1.0), (71.0, 100.0)])
def test_scales_end_at_round_numbers(value: float, end: float) -> None:
    assert round_up(value) == end


def test_frames_of_another_solve_are_refused(
    folder: Path, case: tuple[Template, Performance]
) -> None:
    with pytest.raises(ShapeError, match=r"rig\.npz: solved on 6 frames, but .* hold 12; give"):
        read_rig_inputs(folder, performances=[case[1], case[1]])
    with pytest.raises(ShapeError, match=r"has .* \(6, 144\), the template \(6, 400\)"):
        read_rig_inputs(folder, template=grid_template())


def test_takes_are_named_after_their_place() -> None:
    assert take_name(Path("takes/smile/products/track/performance.npz")) == "smile"
    assert take_name(Path("takes/jaw.npz")) == "jaw"
