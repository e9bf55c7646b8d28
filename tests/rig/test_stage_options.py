"""The choices of the rig stage: methods, overrides, hold-out, masks, links, rigid heads."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from capture.errors import InputError, SettingsError
from rig.overrides import Override
from rig.stage import RigSettings, solve_rig
from rig.template import read_template
from rig.weight_table import WeightTable
from tests.rig.grid_face import NAMES, performance_of
from tests.rig.test_stage import Actor

QUICK = RigSettings(iterations=2)


@pytest.fixture(scope="module")
def actor() -> Actor:
    return Actor(2)


def _rms(error: np.ndarray) -> float:
    return float(np.sqrt((error**2).sum(axis=-1).mean()))


def _solve(actor: Actor, out: Path, settings: RigSettings = QUICK, **more):
    rig = solve_rig(actor.template, [actor.performance()], settings, out, **more)
    return rig, json.loads((out / "report.json").read_text())


def _known(actor: Actor) -> WeightTable:
    return WeightTable(weights=actor.weights, names=NAMES)


@pytest.mark.parametrize("method", ["hable", "menzel", "ebfr"])
def test_known_weights_by_every_method_beat_the_transfer(
    actor: Actor, tmp_path: Path, method: str
) -> None:
    truth = actor.deltas[:5]
    before, _ = _solve(actor, tmp_path / "a", RigSettings(method="transfer"), weights=_known(actor))
    after, report = _solve(actor, tmp_path / "b", RigSettings(method=method), weights=_known(actor))
    assert report["method"] == method
    assert _rms(after.deltas[:5] - truth) < 0.8 * _rms(before.deltas[:5] - truth)
    assert after.weights == pytest.approx(actor.weights)


def test_methods_that_want_weights_say_so(actor: Actor, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r'method = "menzel" wants known weights'):
        _solve(actor, tmp_path / "rig", RigSettings(method="menzel"))
    assert not (tmp_path / "rig").exists()


def test_an_override_is_obeyed_and_can_be_taken_back(actor: Actor, tmp_path: Path) -> None:
    plain, _ = _solve(actor, tmp_path)
    touched = np.zeros(400, dtype=bool)
    touched[20:60] = True
    wanted = plain.deltas[3] + [0.0, 0.0, 2.0]
    override = Override("browInnerUp", wanted, touched, strength=1000.0)
    told, report = _solve(actor, tmp_path, overrides=[override])
    assert report["overrides"] == ["browInnerUp"]
    assert np.abs(told.deltas[3] - wanted)[touched].max() < 0.3
    back, _ = _solve(actor, tmp_path)
    assert (back.deltas == plain.deltas).all()


def test_known_methods_obey_overrides_too(actor: Actor, tmp_path: Path) -> None:
    wanted = 1.5 * actor.deltas[0]
    everywhere = Override("jawOpen", wanted, np.ones(400, dtype=bool), strength=1e4)
    for method in ("hable", "menzel", "ebfr"):
        rig, _ = _solve(
            actor, tmp_path / method, RigSettings(method=method), weights=_known(actor),
            overrides=[everywhere],
        )  # fmt: skip
        moved = np.linalg.norm(actor.template.deltas[0], axis=1) > 1.0
        away = np.linalg.norm(rig.deltas[0] - wanted, axis=1)[moved]
        assert np.median(away) < 0.4, method


def test_hold_out_tries_strengths_and_keeps_the_best(actor: Actor, tmp_path: Path) -> None:
    _, report = _solve(actor, tmp_path, dataclasses.replace(QUICK, hold_out=True))
    chosen = report["hold_out"]
    best = min(chosen["trials"], key=lambda trial: trial["held_out_mm"])
    assert len(chosen["trials"]) >= 8
    assert chosen["variation"] == best["variation"]
    assert chosen["gradient_mm2"] == best["gradient_mm2"]
    worst = max(trial["held_out_mm"] for trial in chosen["trials"])
    assert best["held_out_mm"] < worst


def test_held_out_takes_are_judged_and_not_solved_on(actor: Actor, tmp_path: Path) -> None:
    other = Actor(2)
    rng = np.random.default_rng(9)
    weights = rng.uniform(0, 1, (4, 6))
    weights[:, 5] = 0.0
    other.points = actor.neutral + np.tensordot(weights, actor.deltas, axes=1)
    plain, _ = _solve(actor, tmp_path / "a")
    rig, report = _solve(actor, tmp_path / "b", held_out=[other.performance()])
    assert (rig.deltas == plain.deltas).all()
    assert report["health"]["held_out"]["ratio"] < 0.8


def test_the_transferred_template_is_a_template(actor: Actor, tmp_path: Path) -> None:
    rig, _ = _solve(actor, tmp_path)
    carried = read_template(tmp_path / "transferred.npz")
    assert carried.names == rig.names
    assert np.abs(carried.neutral - rig.neutral).max() < 1e-4
    assert np.abs(carried.deltas - rig.deltas).max() > 0.1


def test_masks_are_kept(actor: Actor, tmp_path: Path) -> None:
    hard = actor.template.support(1e-3)
    literal, _ = _solve(actor, tmp_path / "l", dataclasses.replace(QUICK, mask="literal"))
    still = np.abs(actor.template.deltas) <= 1e-3 * actor.template.extents_mm[:, None, None]
    assert (literal.deltas[still] == 0.0).all()
    soft, _ = _solve(actor, tmp_path / "s", dataclasses.replace(QUICK, mask="soft"))
    outside = np.linalg.norm(soft.deltas, axis=2)[~hard]
    inside = np.linalg.norm(soft.deltas, axis=2)[hard]
    assert 0.0 < outside.max() < 0.2 * inside.max()


@pytest.mark.parametrize(
    "change",
    [
        {"sparsity": "l1"},
        {"sparsity": "reweighted"},
        {"temporal": "joint"},
        {"symmetry": 0.5},
        {"head": "rigid"},
        {"transfer": "rbf"},
        {"rescale": False},
    ],
)
def test_every_choice_refines(actor: Actor, tmp_path: Path, change: dict) -> None:
    _, report = _solve(actor, tmp_path, dataclasses.replace(QUICK, **change))
    assert report["ratio"] < 0.7
    assert 0.0 <= report["weights_min"] <= report["weights_max"] <= 1.0


def test_exclusive_shapes_are_never_active_together(actor: Actor, tmp_path: Path) -> None:
    plain, _ = _solve(actor, tmp_path / "a")
    assert ((plain.weights[:, 1] > 0) & (plain.weights[:, 2] > 0)).any()
    settings = dataclasses.replace(QUICK, exclusive=("mouthSmile_L:mouthSmile_R",))
    rig, _ = _solve(actor, tmp_path / "b", settings)
    assert not ((rig.weights[:, 1] > 0) & (rig.weights[:, 2] > 0)).any()


def test_refuses_choices_that_do_not_fit(actor: Actor, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"exclusive.*jawLeft:jawRight"):
        RigSettings(exclusive=("jawLeft",))
    bare = Actor(2)
    bare.template = dataclasses.replace(bare.template, rigid_vertices=np.zeros(0, dtype=np.int64))
    with pytest.raises(InputError, match=r"three or more rigid_vertices, this one has 0"):
        _solve(bare, tmp_path, dataclasses.replace(QUICK, head="rigid"))


def test_refuses_hold_out_without_frames_or_for_other_methods(actor: Actor, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r'hold_out goes with method = "ma", found "ebfr"'):
        RigSettings(method="ebfr", hold_out=True)
    short = Actor(2, frames=6)
    with pytest.raises(InputError, match=r"hold_out wants frames.* found 6"):
        _solve(short, tmp_path, dataclasses.replace(QUICK, hold_out=True))


def test_overrides_that_nothing_could_obey_are_refused(actor: Actor, tmp_path: Path) -> None:
    everywhere = np.ones(400, dtype=bool)
    still = Override("still", np.ones((400, 3)), everywhere)
    with pytest.raises(InputError, match="still: moves nothing in the template"):
        _solve(actor, tmp_path, overrides=[still])
    jaw = Override("jawOpen", actor.deltas[0], everywhere)
    settings = RigSettings(method="transfer")
    with pytest.raises(InputError, match="nothing that could obey an override"):
        _solve(actor, tmp_path, settings, weights=_known(actor), overrides=[jaw])


@pytest.mark.parametrize("method", ["ma", "hable", "menzel"])
def test_an_override_opens_the_mask(actor: Actor, tmp_path: Path, method: str) -> None:
    far = np.linalg.norm(actor.template.neutral - actor.template.neutral[390], axis=1) < 25.0
    assert not actor.template.support(1e-3)[0, far].any()
    wanted = np.where(far[:, None], [0.0, 0.0, 1.0], actor.deltas[0])
    told = Override("jawOpen", wanted, far, strength=1000.0)
    mask = "soft" if method == "ma" else "vertex"
    settings = RigSettings(method=method, iterations=2, mask=mask)
    rig, _ = _solve(actor, tmp_path, settings, weights=_known(actor), overrides=[told])
    assert np.linalg.norm(rig.deltas[0] - wanted, axis=1)[far].max() < 0.3


def test_exclusive_pairs_with_an_empty_shape_are_borne(actor: Actor, tmp_path: Path) -> None:
    _solve(actor, tmp_path, dataclasses.replace(QUICK, exclusive=("still:jawOpen",)))
    with pytest.raises(SettingsError, match=r"found 'jawOpen:jawOpen'"):
        RigSettings(exclusive=("jawOpen:jawOpen",))


def test_numbers_that_are_none_count_as_unseen(actor: Actor, tmp_path: Path) -> None:
    confidence = np.ones(actor.points.shape[:2])
    confidence[3, 7] = np.nan
    points = actor.points.copy()
    points[4, 9] = np.inf
    holes = confidence.copy()
    holes[3, 7] = holes[4, 9] = 0.0
    polygons = actor.template.polygons
    dirty = solve_rig(
        actor.template, [performance_of(points, polygons, confidence)], QUICK, tmp_path / "a"
    )
    clean = solve_rig(
        actor.template, [performance_of(actor.points, polygons, holes)], QUICK, tmp_path / "b"
    )
    assert (dirty.deltas == clean.deltas).all()
    nothing = performance_of(np.full_like(points, np.nan), polygons)
    with pytest.raises(InputError, match="no vertex of any frame has confidence"):
        solve_rig(actor.template, [nothing], QUICK, tmp_path / "c")


def test_held_out_takes_are_checked_before_the_solve(actor: Actor, tmp_path: Path) -> None:
    small = performance_of(actor.points[:, :361], actor.template.polygons[:1])
    with pytest.raises(InputError, match="template has 400 vertices, held-out 1 361"):
        _solve(actor, tmp_path / "rig", held_out=[small])
    assert not (tmp_path / "rig").exists()


def test_a_report_tells_health(actor: Actor, tmp_path: Path) -> None:
    _, report = _solve(actor, tmp_path)
    assert {"gauge", "symmetry", "captures", "interference", "degenerate"} <= set(report["health"])


def test_shapes_that_nobody_exercised_stay_at_the_transferred_template(tmp_path: Path) -> None:
    actor = Actor(5)
    actor.weights[:, 3] = 0.0
    actor.points = np.einsum("fb,bva->fva", actor.weights, actor.deltas) + actor.neutral
    actor.points += np.random.default_rng(5).normal(0, 0.1, actor.points.shape)
    rig, _ = _solve(actor, tmp_path, RigSettings(iterations=4))
    carried = read_template(tmp_path / "transferred.npz")
    assert rig.weights[:, 3].max() < 0.2
    assert np.abs(rig.deltas[3] - carried.deltas[3]).max() < 0.02
    assert np.abs(rig.deltas[0] - carried.deltas[0]).max() > 0.2


def test_sizes_come_from_how_far_shapes_were_exercised(tmp_path: Path) -> None:
    """An actor with shapes of half and of one and a half times the artist's, fully exercised."""
    actor = Actor(6, frames=40)
    gains = np.array([0.6, 1.4, 0.7, 1.3, 1.0, 1.0])
    actor.deltas = actor.template.deltas * gains[:, None, None]
    actor.points = np.einsum("fb,bva->fva", actor.weights, actor.deltas) + actor.neutral
    errors = []
    for rescale in (True, False):
        rig, _ = _solve(actor, tmp_path / str(rescale), RigSettings(rescale=rescale))
        errors.append(_rms((rig.deltas - actor.deltas)[:4]))
    assert errors[0] < 0.6 * errors[1]
