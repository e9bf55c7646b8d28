"""Degenerate shapes are found and named, from shapes made so."""

import time

import numpy as np
import pytest

from capture.arrays import Floats
from rig.degenerate import Degeneracy, find_degenerate
from tests.rig.grid_face import NAMES, grid_template


def _find(deltas: Floats, names: tuple[str, ...]) -> Degeneracy:
    return find_degenerate(deltas, names, grid_template().neutral)


def _with(*extra: tuple[str, Floats]) -> Degeneracy:
    template = grid_template()
    deltas = np.concatenate([template.deltas[:5], *(d[None] for _, d in extra)])
    return _find(deltas, (*NAMES[:5], *(name for name, _ in extra)))


def test_a_sound_set_has_nothing_to_tell() -> None:
    found = _with()
    assert (found.zero, found.not_shapes, found.duplicates, found.dependent) == ((), {}, (), ())
    flat = grid_template().deltas[:5].reshape(5, -1)
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    values = np.linalg.svd(flat, compute_uv=False)
    assert found.condition == pytest.approx(values[0] / values[-1], rel=1e-9)


def test_a_zero_shape_is_named() -> None:
    template = grid_template()
    assert _find(template.deltas, template.names).zero == ("still",)


@pytest.mark.parametrize("scale", [1.0, -1.0, 0.37])
def test_a_doubled_shape_is_named_with_its_scale(scale: float) -> None:
    jaw = grid_template().deltas[0]
    found = _with(("copy", (scale * jaw).astype(np.float32).astype(np.float64)))
    (pair,) = found.duplicates
    assert (pair.shape, pair.of) == ("copy", "jawOpen")
    assert pair.scale == pytest.approx(scale, rel=1e-5)
    assert found.dependent == ()
    assert found.condition > 1e6


def test_a_combination_is_named_with_its_factors() -> None:
    d = grid_template().deltas
    found = _with(("mouthClose", 0.5 * d[1] + 0.5 * d[2] - 0.25 * d[0]))
    (one,) = found.dependent
    names = {one.shape, *(name for name, _ in one.parts)}
    assert names == {"mouthClose", "mouthSmile_L", "mouthSmile_R", "jawOpen"}
    shapes = dict(zip((*NAMES[:5],), d[:5], strict=True)) | {
        "mouthClose": 0.5 * d[1] + 0.5 * d[2] - 0.25 * d[0]
    }
    made = sum(factor * shapes[name] for name, factor in one.parts)
    assert np.abs(made - shapes[one.shape]).max() <= 1e-9
    assert one.rest <= 1e-6


def test_a_combination_reads_as_a_sum() -> None:
    d = grid_template().deltas
    found = _with(("a", d[1] + d[2]))
    told = found.as_report()["dependent"][0]
    assert told["equals"] in (
        "a = 1 mouthSmile_L + 1 mouthSmile_R",
        "a = 1 mouthSmile_R + 1 mouthSmile_L",
        "mouthSmile_L = 1 a - 1 mouthSmile_R",
        "mouthSmile_L = - 1 mouthSmile_R + 1 a",
        "mouthSmile_R = 1 a - 1 mouthSmile_L",
        "mouthSmile_R = - 1 mouthSmile_L + 1 a",
    )


def test_a_departure_larger_than_the_tolerance_is_no_dependence() -> None:
    d = grid_template().deltas
    odd = np.random.default_rng(0).normal(size=d[0].shape)
    made = d[1] + d[2]
    size = np.linalg.norm(made) / np.linalg.norm(odd)
    assert _with(("a", made + 1e-5 * size * odd)).dependent
    assert not _with(("a", made + 1e-2 * size * odd)).dependent


def test_whole_meshes_and_head_motions_are_not_shapes() -> None:
    template = grid_template()
    n, jaw = template.neutral, template.deltas[0]
    found = _with(
        ("A", n),
        ("B", n + jaw),
        ("C", -n),
        ("D", np.broadcast_to([3.0, 0.0, 4.0], n.shape)),
        ("E", n + [0.0, 100.0, 0.0]),
    )
    assert set(found.not_shapes) == set("ABCDE")
    assert found.not_shapes["A"].startswith("the neutral imported as a shape")
    assert found.not_shapes["B"].startswith("a mesh where a displacement belongs")
    assert found.not_shapes["C"].startswith("minus the neutral")
    assert found.not_shapes["D"].startswith("moves every vertex alike, by 5 mm")
    assert found.not_shapes["E"].startswith("the neutral imported")
    assert found.duplicates == ()
    assert found.condition < 100


def test_a_still_shape_called_neutral_is_told_as_the_neutral() -> None:
    found = _with(("Neutral", np.zeros((400, 3))))
    assert found.zero == ("Neutral",)
    assert "imported as a shape" in found.not_shapes["Neutral"]


def test_a_rig_of_full_size_takes_less_than_a_second_of_cpu() -> None:
    rng = np.random.default_rng(0)
    deltas, neutral = rng.normal(size=(57, 6700, 3)), rng.normal(size=(6700, 3))
    names = [f"s{k}" for k in range(57)]
    spent = []
    for _ in range(3):  # the least of three: BLAS threads spin where cores are shared
        start = time.thread_time()
        found = find_degenerate(deltas, names, neutral)
        spent.append(time.thread_time() - start)
    assert min(spent) < 1.0  # 0.05 to 0.1 s on one thread
    assert found.condition < 1.3


def test_a_rig_without_any_usable_shape_is_told_of() -> None:
    rng = np.random.default_rng(3)
    neutral = rng.normal(size=(40, 3)) * 60.0
    names = ("a", "b")
    empty = find_degenerate(np.zeros((2, 40, 3)), names, neutral).as_report()
    assert empty["zero"] == ["a", "b"]
    whole = find_degenerate(neutral + rng.normal(size=(2, 40, 3)), names, neutral).as_report()
    assert set(whole["not_shapes"]) == {"a", "b"}
