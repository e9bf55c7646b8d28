"""Deformation transfer: laws it must obey."""

import numpy as np
import pytest

from capture.errors import ShapeError
from rig.template import Template
from rig.transfer import transfer_shapes, virtual_triangles
from tests.rig.grid_face import grid_template, smooth_field


def test_onto_the_templates_own_neutral_it_gives_the_templates_shapes() -> None:
    template = grid_template()
    assert np.abs(transfer_shapes(template, template.neutral) - template.deltas).max() <= 0.02


def test_onto_a_face_twice_the_size_shapes_double() -> None:
    template = grid_template()
    once = transfer_shapes(template, template.neutral)
    twice = transfer_shapes(template, 2.0 * template.neutral)
    assert np.abs(twice - 2.0 * once).max() <= 1e-9


def test_static_vertices_stay_exactly_still() -> None:
    template = grid_template()
    actor = template.neutral + smooth_field(template.neutral, 3.0, np.random.default_rng(1))
    deltas = transfer_shapes(template, actor)
    support = template.support(1e-3)
    assert (deltas[~support] == 0.0).all()
    assert (deltas[-1] == 0.0).all()
    assert np.abs(deltas[:5] - template.deltas[:5]).max() < 2.0


def test_a_translated_actor_has_the_same_shapes() -> None:
    template = grid_template()
    actor = template.neutral + smooth_field(template.neutral, 3.0, np.random.default_rng(2))
    here, there = (transfer_shapes(template, actor + t) for t in (0.0, np.array([5.0, -40.0, 9.0])))
    assert np.abs(here - there).max() <= 1e-8


def test_each_connected_component_is_anchored_on_its_own() -> None:
    grid = grid_template(8)
    count = len(grid.neutral)
    apart = Template(
        neutral=np.concatenate([grid.neutral, grid.neutral + [300.0, 0, 0], [[0.0, 0, 0]]]),
        deltas=np.concatenate(
            [grid.deltas, np.full_like(grid.deltas, 2.0), np.zeros((6, 1, 3))], axis=1
        ),
        names=grid.names,
        polygons=np.concatenate([grid.polygons, grid.polygons + count]),
    )
    deltas = transfer_shapes(apart, apart.neutral + [1.0, 2.0, 3.0])
    assert np.isfinite(deltas).all()
    assert deltas[:, count:-1] == pytest.approx(np.full((6, count, 3), 2.0), abs=1e-9)
    assert (deltas[:, -1] == 0.0).all()


def _slit(gap_mm: float) -> Template:
    """Two strips whose facing edges meet when the lid shuts."""
    columns = np.linspace(-50, 50, 11)
    rows = [40 + gap_mm, 20 + gap_mm, gap_mm, 0, -20, -40]
    neutral = np.array([[x, y, 0.0] for y in rows for x in columns])
    quads = [
        [r * 11 + c, r * 11 + c + 1, (r + 1) * 11 + c + 1, (r + 1) * 11 + c]
        for r in (0, 1, 3, 4)
        for c in range(10)
    ]
    shut = np.zeros((1, 66, 3))
    shut[0, 22:33, 1] = -gap_mm
    shut[0, 11:22, 1] = -0.5 * gap_mm
    upper = np.arange(22, 33)
    return Template(
        neutral=neutral, deltas=shut, names=("eyeBlink",),
        polygons=np.array(quads, dtype=np.int32),
        lid_pairs=np.stack([upper, upper + 11], axis=1),
    )  # fmt: skip


def test_virtual_triangles_shut_a_wider_eye() -> None:
    template = _slit(8.0)
    actor = _slit(14.0).neutral
    bare = Template(
        neutral=template.neutral, deltas=template.deltas, names=template.names,
        polygons=template.polygons,
    )  # fmt: skip

    def gap(deltas: np.ndarray) -> float:
        posed = actor + deltas[0]
        return float(np.abs(posed[25:33, 1] - posed[36:44, 1]).max())

    assert len(virtual_triangles(template)) == 20
    assert gap(transfer_shapes(bare, actor)) > 3.0
    assert gap(transfer_shapes(template, actor)) < 0.5


def test_lips_that_touch_at_rest_part_as_far_as_the_templates() -> None:
    shut = _slit(0.0)
    opening = np.zeros((1, 66, 3))
    opening[0, 33:, 1] = -9.0
    template = Template(
        neutral=shut.neutral, deltas=opening, names=("jawOpen",), polygons=shut.polygons,
        lip_pairs=shut.lid_pairs,
    )  # fmt: skip
    actor = shut.neutral + np.outer(np.arange(66) >= 33, [0.0, -0.1, 0.0])  # nearly touching
    deltas = transfer_shapes(template, actor)
    assert len(virtual_triangles(template)) == 0
    assert np.abs(deltas[0] - opening[0]).max() < 1e-6


def test_lids_part_by_the_templates_millimetres_on_a_wider_eye() -> None:
    narrow = _slit(1.0)
    opening = np.zeros((1, 66, 3))
    opening[0, 22:33, 1] = 8.0
    opening[0, 11:22, 1] = 4.0
    template = Template(
        neutral=narrow.neutral, deltas=opening, names=("eyeWide",), polygons=narrow.polygons,
        lid_pairs=narrow.lid_pairs,
    )  # fmt: skip
    deltas = transfer_shapes(template, _slit(6.0).neutral)  # nine times its own gap would be 48
    assert np.abs(deltas[0] - opening[0]).max() < 1.0


def test_a_collapsed_triangle_of_the_template_does_not_throw_vertices() -> None:
    template = grid_template()
    squeezed = template.neutral.copy()
    squeezed[105] = squeezed[106] + 1e-4 * (squeezed[105] - squeezed[106])
    other = Template(
        neutral=squeezed, deltas=template.deltas, names=template.names, polygons=template.polygons
    )
    deltas = transfer_shapes(other, template.neutral)
    assert np.abs(deltas - template.deltas).max() < 0.5


def test_pairs_that_are_not_neighbours_are_not_joined() -> None:
    template = _slit(8.0)
    broken = Template(
        neutral=template.neutral, deltas=template.deltas, names=template.names,
        polygons=template.polygons, lid_pairs=template.lid_pairs[[0, 1, 5, 6]],
    )  # fmt: skip
    assert len(virtual_triangles(broken)) == 4


def test_refuses_another_vertex_count() -> None:
    with pytest.raises(ShapeError, match="V = 400"):
        transfer_shapes(grid_template(), np.zeros((399, 3)))
