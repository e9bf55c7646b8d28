import numpy as np

from capture.arrays import Floats, Ints32
from tests.track.face_scene import TEMPLATE, head
from track.contact import find_contacts


def folded(gap_mm: float) -> tuple[Floats, Ints32]:
    """A strip folded into a long U whose arms face each other at gap_mm; 30 rows of 8."""
    rows = np.arange(30)
    along = np.where(rows < 15, rows, 29 - rows) * 2.0
    height = np.where(rows < 15, 0.0, gap_mm)
    across = np.arange(8) * 2.0
    vertices = np.stack(
        [np.repeat(along, 8), np.tile(across, 30), np.repeat(height, 8)], axis=1
    ).astype(np.float64)
    index = np.arange(240).reshape(30, 8)
    a, b = index[:-1, :-1].ravel(), index[1:, :-1].ravel()
    c, d = index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return vertices, triangles.astype(np.int32)


def test_arms_of_a_fold_touch_and_its_bend_does_not() -> None:
    vertices, triangles = folded(0.5)
    contacts = find_contacts(vertices, triangles)
    first, second = contacts.pairs.T
    assert np.array_equal(np.sort(contacts.pairs, axis=1), contacts.pairs)
    assert np.allclose(np.linalg.norm(contacts.gaps, axis=1), 0.5)
    assert np.array_equal(first % 8, second % 8)  # each with the vertex opposite
    assert np.array_equal(first // 8, 29 - second // 8)
    assert set((first // 8).tolist()) == set(range(11))  # not the four rows next to the bend


def test_parted_arms_and_a_plain_head_do_not_touch() -> None:
    assert len(find_contacts(*folded(2.0)).pairs) == 0
    mesh = head(TEMPLATE)
    assert len(find_contacts(mesh.vertices, mesh.triangles).pairs) == 0


def test_targets_close_the_gap_about_the_middle() -> None:
    vertices, triangles = folded(0.5)
    contacts = find_contacts(vertices, triangles)
    pulled = vertices + np.random.default_rng(0).normal(0.0, 1.0, vertices.shape)
    targets = contacts.targets(pulled)
    assert np.allclose(targets[:, 1] - targets[:, 0], contacts.gaps)
    assert np.allclose(targets.mean(axis=1), pulled[contacts.pairs].mean(axis=1))
