"""Artist overrides: files that are refused, rows that are made, and what a solve makes of them."""

from pathlib import Path

import numpy as np
import pytest

from capture.errors import InputError
from recon.mesh import Mesh, write_obj
from rig.face_rig import FaceRig, write_rig
from rig.overrides import (
    Override,
    check_overrides,
    overridden,
    override_evidence,
    read_overrides,
)
from tests.rig.grid_face import grid_template

TEMPLATE = grid_template()


def _folder(tmp_path: Path, lift_mm: float = 2.0) -> np.ndarray:
    """A base rig and a sculpt of jawOpen in which the first 30 vertices were pulled."""
    rig = FaceRig(
        neutral=TEMPLATE.neutral, deltas=TEMPLATE.deltas, names=TEMPLATE.names,
        polygons=TEMPLATE.polygons, weights=np.zeros((0, 6)), head_from_rig=np.zeros((0, 4, 4)),
    )  # fmt: skip
    write_rig(tmp_path / "rig.npz", rig)
    sculpt = TEMPLATE.neutral + TEMPLATE.deltas[0]
    sculpt[:30, 2] += lift_mm
    write_obj(tmp_path / "jaw.obj", Mesh(sculpt, TEMPLATE.polygons))
    return sculpt - TEMPLATE.neutral


def _write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "overrides.toml"
    path.write_text(text)
    return path


def _told(tmp_path: Path, shape: str = "jawOpen", mesh: str = "jaw.obj", more: str = "") -> Path:
    return _write(
        tmp_path,
        f'base = "rig.npz"\n[[override]]\nshape = "{shape}"\nmesh = "{mesh}"\n{more}\n',
    )


def test_only_what_was_sculpted_is_told(tmp_path: Path) -> None:
    delta = _folder(tmp_path)
    (found,) = read_overrides(_told(tmp_path))
    assert found.name == "jawOpen"
    assert found.strength == 10.0
    assert np.flatnonzero(found.touched).tolist() == list(range(30))
    assert np.abs(found.delta - delta)[:30].max() < 1e-4


def test_everywhere_tells_all(tmp_path: Path) -> None:
    _folder(tmp_path)
    (found,) = read_overrides(_told(tmp_path, more="everywhere = true\nstrength = 3"))
    assert found.touched.all()
    assert found.strength == 3.0


@pytest.mark.parametrize(
    ("shape", "mesh", "more", "words"),
    [
        ("jawOpn", "jaw.obj", "", "no shape 'jawOpn'.*jawOpen"),
        ("jawOpen", "../jaw.obj", "", "leaves the folder"),
        ("jawOpen", "jaw.obj", "strenght = 2", "strenght: unknown.*strength"),
        ("jawOpen", "jaw.obj", "strength = 0", "strength = 0.0: must be at least"),
        ("jawOpen", "small.obj", "", "361 vertices, the base rig 400"),
        ("jawOpen", "same.obj", "", "no change"),
    ],
)
def test_refuses(tmp_path: Path, shape: str, mesh: str, more: str, words: str) -> None:
    _folder(tmp_path)
    small = grid_template(19)
    write_obj(tmp_path / "small.obj", Mesh(small.neutral, small.polygons))
    same = Mesh(TEMPLATE.neutral + TEMPLATE.deltas[0], TEMPLATE.polygons)
    write_obj(tmp_path / "same.obj", same)
    with pytest.raises(InputError, match=words):
        read_overrides(_told(tmp_path, shape, mesh, more))


def test_refuses_a_file_without_entries(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"one or more \[\[override\]\]"):
        read_overrides(_write(tmp_path, 'base = "rig.npz"\n'))
    with pytest.raises(InputError, match="bse: unknown"):
        read_overrides(_write(tmp_path, 'bse = "rig.npz"\n'))


def test_refuses_to_write_over_the_base(tmp_path: Path) -> None:
    _folder(tmp_path)
    assert len(read_overrides(_told(tmp_path), tmp_path / "other")) == 1
    with pytest.raises(InputError, match="write to another folder"):
        read_overrides(_told(tmp_path), tmp_path)


def test_each_row_shows_one_shape_alone() -> None:
    touched = np.zeros(400, dtype=bool)
    touched[:30] = True
    override = Override("browInnerUp", np.ones((400, 3)), touched, strength=4.0)
    rows = override_evidence([override], TEMPLATE.names)
    assert rows.factors.tolist() == [[0, 0, 0, 0, 1, 0, 0]]
    assert rows.confidence[0, 0] == 2.0
    assert rows.confidence[0, 30] == 0.0
    assert (rows.offsets[0, 30:] == 0.0).all()


def test_an_override_moves_what_was_touched_and_moved() -> None:
    delta = np.zeros((400, 3))
    delta[:5] = 1.0
    touched = np.zeros(400, dtype=bool)
    touched[3:8] = True
    moved = overridden([Override("jawOpen", delta, touched)], TEMPLATE.names, 400)
    assert np.argwhere(moved).tolist() == [[0, 3], [0, 4]]


def test_refuses_shapes_and_counts_that_do_not_fit() -> None:
    wrong = Override("jaw", np.zeros((7, 3)), np.ones(7, dtype=bool))
    with pytest.raises(InputError, match=r"(?s)jaw: the template has no such.*7 vertices"):
        check_overrides([wrong], TEMPLATE.names, TEMPLATE.moves(), 400)
    still = Override("still", np.ones((400, 3)), np.ones(400, dtype=bool))
    with pytest.raises(InputError, match="still: moves nothing in the template"):
        check_overrides([still], TEMPLATE.names, TEMPLATE.moves(), 400)
    with pytest.raises(InputError, match="strength must be above 0"):
        Override("jawOpen", np.zeros((4, 3)), np.ones(4, dtype=bool), strength=0.0)
