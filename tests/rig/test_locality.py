"""Locality: three kinds of mask, all taken from the template."""

from dataclasses import replace

import numpy as np
import pytest

from capture.errors import InputError
from rig.evidence import Evidence
from rig.locality import Locality, distances_mm, mask_shapes
from rig.template import Template
from rig.update import UpdatePriors, update_shapes
from tests.rig.grid_face import grid_template


def _strip(gap: bool = False) -> Template:
    """Nine squares of 10 mm in a row along x, of which the first corner pair moves in y alone."""
    x, y = np.meshgrid(np.arange(10) * 10.0, [0.0, 10.0])
    neutral = np.stack([x.ravel(), y.ravel(), np.zeros(20)], axis=1)
    first = np.arange(9)
    polygons = np.stack([first, first + 1, first + 11, first + 10], axis=1).astype(np.int32)
    deltas = np.zeros((2, 20, 3))
    deltas[0, [0, 10], 1] = 5.0
    deltas[1, 5, 0] = 2.0
    deltas[1, 6, 0] = 1e-4  # dust
    kept = polygons[[i for i in range(9) if not (gap and i == 2)]]
    return Template(neutral=neutral, deltas=deltas, names=("a", "b"), polygons=kept)


def test_by_vertex_it_is_the_support_of_the_template() -> None:
    template = grid_template()
    mask = mask_shapes(template, Locality(tolerance=0.01))
    assert mask.extra_offset is None
    assert np.array_equal(mask.support, template.support(0.01))


def test_literally_each_coordinate_has_its_own_mask() -> None:
    mask = mask_shapes(_strip(), Locality(mode="literal"))
    moving = np.argwhere(mask.support).tolist()
    assert moving == [[0, 0, 1], [0, 10, 1], [1, 5, 0]]


def test_softly_the_stiffness_grows_tenfold_over_the_given_distance() -> None:
    mask = mask_shapes(_strip(), Locality(mode="soft", softening_mm=10.0, stiffness=0.5))
    assert mask.extra_offset is not None
    assert mask.extra_offset[0, :4] == pytest.approx([0.0, 5.0, 50.0, 500.0])
    assert mask.support[0, :6].tolist() == [True, True, True, True, False, False]


def test_distances_do_not_jump_over_a_slit() -> None:
    template = _strip(gap=True)
    away = distances_mm(template, template.support(1e-3), 1e3)
    assert away[0, :4] == pytest.approx([0.0, 10.0, 20.0, np.inf])
    assert away[1, 3:7] == pytest.approx([20.0, 10.0, 0.0, 10.0])


def test_a_shape_that_moves_nothing_stays_held_everywhere() -> None:
    template = grid_template()
    mask = mask_shapes(template, Locality(mode="soft"))
    assert not mask.support[-1].any()


def test_a_soft_mask_lets_the_actor_move_where_the_template_does_not() -> None:
    template = grid_template(15)
    one = Template(
        neutral=template.neutral, deltas=template.deltas[:1], names=template.names[:1],
        polygons=template.polygons,
    )  # fmt: skip
    hard = mask_shapes(one, Locality())
    soft = mask_shapes(one, Locality(mode="soft", softening_mm=40.0))
    fringe = soft.support & ~hard.support
    near = distances_mm(one, hard.support, 20.0)[0] < 20.0
    truth = one.deltas + np.where((near & ~hard.support[0])[:, None], [0.0, 0.0, 1.0], 0.0)
    weights = np.linspace(0.0, 1.0, 20)[:, None]
    offsets = np.tensordot(weights, truth, axes=1)
    evidence = Evidence(offsets, np.ones(offsets.shape[:2]), weights)
    priors = UpdatePriors(relative_mm2=0.0, tolerance=1e-11)
    targets = np.where(hard.support[:, :, None], one.deltas, 0.0)
    arguments = (one.neutral, one.mesh.triangles, targets)
    _, held = update_shapes(*arguments, hard.support, evidence, priors)
    softened = replace(priors, extra_offset=soft.extra_offset)
    _, moved = update_shapes(*arguments, soft.support, evidence, softened)
    assert (held[fringe] == 0.0).all()
    assert np.abs(moved - truth).sum() < 0.8 * np.abs(held - truth).sum()
    firm = replace(priors, extra_offset=np.where(hard.support, 0.0, 1e9))
    _, same = update_shapes(*arguments, soft.support, evidence, firm)
    assert np.abs(same - held).max() <= 1e-6


def test_says_which_modes_there_are() -> None:
    with pytest.raises(InputError, match="mode must be one of vertex, soft, literal, found hard"):
        Locality(mode="hard")
    with pytest.raises(InputError, match="softening_mm"):
        Locality(softening_mm=0.0)
