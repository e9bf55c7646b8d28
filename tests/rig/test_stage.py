"""The rig stage end to end on the grid face: residuals, masks, reports, refusals."""

import json
from pathlib import Path

import numpy as np
import pytest

from capture.errors import InputError, SettingsError
from rig.face_rig import read_rig
from rig.stage import RigSettings, check_match, solve_rig
from rig.weight_table import WeightTable
from tests.rig.grid_face import (
    NAMES,
    grid_template,
    perform,
    performance_of,
    random_motions,
    smooth_field,
)

SETTINGS = RigSettings(iterations=4)


class Actor:
    """A hidden rig that differs from the template, and frames of it."""

    def __init__(self, seed: int, frames: int = 24, noise_mm: float = 0.1) -> None:
        rng = np.random.default_rng(seed)
        self.template = grid_template()
        self.neutral = self.template.neutral + smooth_field(self.template.neutral, 3.0, rng)
        gains = rng.uniform(0.8, 1.2, 6)[:, None, None]
        size = np.linalg.norm(self.template.deltas, axis=2, keepdims=True)
        bent = np.array([smooth_field(self.neutral, 0.3, rng) for _ in range(6)])
        self.deltas = gains * (self.template.deltas + size * bent)
        self.weights = rng.uniform(0, 1, (frames, 6)) * (rng.uniform(size=(frames, 6)) < 0.5)
        self.weights[:, 5] = 0.0
        self.weights[0] = 0.0
        self.motions = random_motions(frames, rng)
        self.points = perform(self.neutral, self.deltas, self.weights, self.motions)
        self.points += rng.normal(0, noise_mm, self.points.shape)
        self.points += [smooth_field(self.neutral, noise_mm, rng) for _ in self.points]

    def performance(self, confidence: np.ndarray | None = None):
        return performance_of(self.points, self.template.polygons, confidence)


@pytest.fixture(scope="module")
def actor() -> Actor:
    return Actor(1)


@pytest.fixture(scope="module")
def solved(actor: Actor, tmp_path_factory: pytest.TempPathFactory):
    out = tmp_path_factory.mktemp("rig")
    return solve_rig(actor.template, [actor.performance()], SETTINGS, out), out


def _rms(error: np.ndarray) -> float:
    return float(np.sqrt((error**2).sum(axis=-1).mean()))


def test_refinement_halves_the_residual(solved) -> None:
    report = json.loads((solved[1] / "report.json").read_text())
    assert report["ratio"] <= 0.5
    assert report["residual_refined_mm"] <= 0.5 * report["residual_transferred_mm"]
    assert report["weights_min"] >= 0.0
    assert report["weights_max"] <= 1.0
    assert report["iterations"][-1]["total"] <= report["iterations"][0]["total"]


def test_the_report_agrees_with_the_rig_it_describes(actor: Actor, solved) -> None:
    rig, out = solved
    report = json.loads((out / "report.json").read_text())
    posed = np.array(list(rig.frames()))
    assert _rms(posed - actor.points) == pytest.approx(report["residual_refined_mm"], abs=1e-3)


def test_shapes_and_weights_come_nearer_the_truth(actor: Actor, solved) -> None:
    rig, _ = solved
    exercised = actor.weights.max(axis=0) > 0.5
    before = _rms((actor.template.deltas - actor.deltas)[exercised])
    assert _rms((rig.deltas - actor.deltas)[exercised]) < 0.8 * before
    assert np.sqrt(((rig.weights - actor.weights) ** 2).mean()) < 0.12


def test_shapes_keep_their_places(actor: Actor, solved) -> None:
    rig, _ = solved
    assert (rig.deltas[~actor.template.support(1e-3)] == 0.0).all()


def test_a_shape_that_moves_nothing_is_kept_and_named(actor: Actor, solved) -> None:
    rig, out = solved
    report = json.loads((out / "report.json").read_text())
    assert rig.names == NAMES
    assert report["dropped_zero_shapes"] == ["still"]
    assert (rig.deltas[5] == 0.0).all()
    assert (rig.weights[:, 5] == 0.0).all()


def test_what_is_written_is_what_is_returned(solved) -> None:
    rig, out = solved
    again = read_rig(out / "rig.npz")
    assert again.names == rig.names
    assert np.abs(again.deltas - rig.deltas).max() <= 1e-5
    assert (again.weights == rig.weights).all()


def test_the_same_input_gives_the_same_bytes(actor: Actor, tmp_path: Path) -> None:
    quick = RigSettings(iterations=2)
    for name in "ab":
        solve_rig(actor.template, [actor.performance()], quick, tmp_path / name)
    assert (tmp_path / "a/rig.npz").read_bytes() == (tmp_path / "b/rig.npz").read_bytes()


def test_an_unchanged_solve_is_skipped_and_a_changed_one_is_not(
    actor: Actor, tmp_path: Path
) -> None:
    quick = RigSettings(iterations=1)
    solve_rig(actor.template, [actor.performance()], quick, tmp_path)
    stamp = (tmp_path / "rig.npz").stat().st_mtime_ns
    solve_rig(actor.template, [actor.performance()], quick, tmp_path)
    assert (tmp_path / "rig.npz").stat().st_mtime_ns == stamp
    other = RigSettings(iterations=1, offset=0.2)
    solve_rig(actor.template, [actor.performance()], other, tmp_path)
    assert (tmp_path / "rig.npz").stat().st_mtime_ns != stamp


def test_a_rigid_move_of_the_world_moves_only_the_head(actor: Actor, tmp_path: Path) -> None:
    quick = RigSettings(iterations=2)
    move = random_motions(1, np.random.default_rng(8))[0]
    first = solve_rig(actor.template, [actor.performance()], quick, tmp_path / "a")
    moved = actor.points @ move[:3, :3].T + move[:3, 3]
    second = solve_rig(
        actor.template, [performance_of(moved, actor.template.polygons)], quick, tmp_path / "b"
    )
    assert np.abs(first.deltas - second.deltas).max() <= 0.02
    assert np.abs(move @ first.head_from_rig - second.head_from_rig).max() <= 0.02


def test_vertices_without_confidence_are_ignored(actor: Actor, tmp_path: Path) -> None:
    confidence = np.ones(actor.points.shape[:2])
    confidence[:, 100:130] = 0.0
    wild = actor.points.copy()
    wild[:, 100:130] += 500.0
    quick = RigSettings(iterations=2)
    polygons = actor.template.polygons
    clean = solve_rig(
        actor.template, [performance_of(actor.points, polygons, confidence)], quick, tmp_path / "a"
    )
    dirty = solve_rig(
        actor.template, [performance_of(wild, polygons, confidence)], quick, tmp_path / "b"
    )
    assert (clean.neutral == dirty.neutral).all()
    assert (clean.deltas == dirty.deltas).all()


def test_known_weights_are_kept_and_matched_by_name(actor: Actor, tmp_path: Path) -> None:
    order = [3, 0, 5, 4, 1, 2]
    table = WeightTable(weights=actor.weights[:, order], names=tuple(NAMES[k] for k in order))
    rig = solve_rig(actor.template, [actor.performance()], SETTINGS, tmp_path, weights=table)
    assert rig.weights == pytest.approx(actor.weights)
    exercised = actor.weights.max(axis=0) > 0.5
    before = _rms((actor.template.deltas - actor.deltas)[exercised])
    assert _rms((rig.deltas - actor.deltas)[exercised]) < 0.4 * before


def test_two_performances_make_one_rig(actor: Actor, tmp_path: Path) -> None:
    polygons = actor.template.polygons
    parts = [performance_of(part, polygons) for part in (actor.points[:9], actor.points[9:])]
    rig = solve_rig(actor.template, parts, RigSettings(iterations=1), tmp_path)
    assert rig.weights.shape == (24, 6)


def test_the_neutral_is_found_when_the_take_does_not_begin_with_it(
    actor: Actor, tmp_path: Path
) -> None:
    turned = performance_of(actor.points[::-1], actor.template.polygons)
    solve_rig(actor.template, [turned], RigSettings(iterations=1), tmp_path)
    frame = json.loads((tmp_path / "report.json").read_text())["neutral_frame"]
    assert actor.weights[::-1][frame].max() < 0.2


def test_refuses_another_vertex_count(actor: Actor, tmp_path: Path) -> None:
    small = grid_template(19)
    with pytest.raises(InputError, match="template has 361 vertices, performance 1 400"):
        solve_rig(small, [actor.performance()], SETTINGS, tmp_path / "rig")
    with pytest.raises(InputError, match=r"template has 361 vertices, take\.npz 400"):
        check_match(small, [actor.performance()], ["take.npz"])
    assert not (tmp_path / "rig").exists()


def test_refuses_what_it_cannot_solve(actor: Actor, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="at least one performance"):
        solve_rig(actor.template, [], SETTINGS, tmp_path)
    blind = actor.performance(np.zeros(actor.points.shape[:2]))
    with pytest.raises(InputError, match="no vertex of any frame has confidence"):
        solve_rig(actor.template, [blind], SETTINGS, tmp_path)
    short = WeightTable(weights=np.zeros((3, 6)), names=NAMES)
    with pytest.raises(InputError, match="3 rows for 24 frames"):
        solve_rig(actor.template, [actor.performance()], SETTINGS, tmp_path, weights=short)
    other = WeightTable(weights=np.zeros((24, 1)), names=("tongueOut",))
    with pytest.raises(InputError, match="tongueOut"):
        solve_rig(actor.template, [actor.performance()], SETTINGS, tmp_path, weights=other)
    with pytest.raises(InputError, match=r"neutral_frame 99: .* frames 0\.\.23"):
        solve_rig(actor.template, [actor.performance()], RigSettings(neutral_frame=99), tmp_path)


def test_settings_out_of_range_are_named() -> None:
    with pytest.raises(SettingsError, match=r"offset = 0.*: must be at least 1e-06"):
        RigSettings(offset=0.0)
