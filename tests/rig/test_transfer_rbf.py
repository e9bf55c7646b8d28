"""The warp of space: laws it must obey."""

import numpy as np
import pytest

from capture.errors import SettingsError, ShapeError, SolveError
from rig.template import Template
from rig.transfer_rbf import WarpSettings, spread_vertices, transfer_shapes_rbf
from tests.rig.grid_face import grid_template, smooth_field

FEW = WarpSettings(centres=120)


def test_an_affine_change_of_the_face_changes_shapes_alike() -> None:
    template = grid_template()
    matrix = np.array([[1.1, 0.05, 0.0], [0.0, 0.9, 0.1], [0.02, 0.0, 1.2]])
    deltas = transfer_shapes_rbf(template, template.neutral @ matrix.T + [5.0, -3.0, 8.0], FEW)
    acting = template.support(1e-3)
    assert np.abs((deltas - template.deltas @ matrix.T)[acting]).max() < 1e-8


def test_static_vertices_stay_exactly_still() -> None:
    template = grid_template()
    actor = template.neutral + smooth_field(template.neutral, 3.0, np.random.default_rng(1))
    deltas = transfer_shapes_rbf(template, actor, FEW)
    assert (deltas[~template.support(1e-3)] == 0.0).all()
    assert (deltas[-1] == 0.0).all()
    assert 0.0 < np.abs(deltas[:5] - template.deltas[:5]).max() < 3.0


def test_with_every_vertex_a_centre_the_warp_meets_all_of_the_face() -> None:
    template = grid_template(8)
    actor = template.neutral + smooth_field(template.neutral, 3.0, np.random.default_rng(2))
    onto = template.neutral[::-1] - template.neutral  # a shape that ends on other vertices
    jump = Template(
        neutral=template.neutral, deltas=onto[None], names=("jump",), polygons=template.polygons
    )
    deltas = transfer_shapes_rbf(jump, actor, WarpSettings(centres=64))
    assert np.abs(deltas[0] - (actor[::-1] - actor)).max() < 1e-7


def test_centres_are_spread_and_none_is_chosen_twice() -> None:
    points = np.random.default_rng(0).uniform(size=(300, 3))
    doubled = np.concatenate([points, points])
    chosen = spread_vertices(doubled, 1000)
    assert len(chosen) == 300
    some = doubled[spread_vertices(doubled, 30)]
    apart = np.linalg.norm(some[:, None] - some[None], axis=2) + 10 * np.eye(30)
    assert apart.min() > 0.15
    assert len(spread_vertices(np.zeros((0, 3)), 5)) == 0


def test_a_flat_face_and_bad_settings_are_refused() -> None:
    template = grid_template(6)
    flat = Template(
        neutral=template.neutral * [1.0, 1.0, 0.0], deltas=template.deltas, names=template.names,
        polygons=template.polygons,
    )  # fmt: skip
    with pytest.raises(SolveError, match="one plane"):
        transfer_shapes_rbf(flat, template.neutral)
    with pytest.raises(ShapeError, match="V = 36"):
        transfer_shapes_rbf(template, np.zeros((35, 3)))
    with pytest.raises(SettingsError, match=r"warp\.centres = 2"):
        WarpSettings(centres=2)
