"""Files of templates, rigs and weights: round trips and refusals."""

from pathlib import Path

import numpy as np
import pytest

from capture.errors import InputError, ShapeError
from rig.face_rig import FaceRig, read_rig, write_rig
from rig.template import Template, read_template, write_template
from rig.weight_table import WeightTable, read_weights, write_weights
from tests.rig.grid_face import grid_template


def _arrays() -> dict[str, np.ndarray]:
    template = grid_template(6)
    return {
        "neutral": template.neutral,
        "deltas": template.deltas,
        "names": np.array(template.names),
        "polygons": template.polygons,
    }


def test_round_trip_keeps_everything(tmp_path: Path) -> None:
    template = grid_template()
    write_template(tmp_path / "t.npz", template)
    again = read_template(tmp_path / "t.npz")
    assert again.names == template.names
    assert np.abs(again.deltas - template.deltas).max() <= 1e-5
    assert (again.polygons == template.polygons).all()
    assert (again.rigid_vertices == template.rigid_vertices).all()
    assert again.lid_pairs.shape == (0, 2)


def test_the_same_template_gives_the_same_bytes(tmp_path: Path) -> None:
    write_template(tmp_path / "a.npz", grid_template())
    write_template(tmp_path / "b.npz", grid_template())
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_triangles_are_padded(tmp_path: Path) -> None:
    arrays = _arrays() | {"polygons": np.array([[0, 1, 7]])}
    np.savez(tmp_path / "t.npz", **arrays)
    assert read_template(tmp_path / "t.npz").polygons.tolist() == [[0, 1, 7, -1]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"names": np.array(["a", "b", "a", "c", "d", "b"])}, "found twice: a, b"),
        ({"names": np.array(["a", "b"])}, "names"),
        ({"names": np.arange(6)}, "names must hold text"),
        ({"neutral": _arrays()["neutral"] / 10}, "centimetres: multiply neutral and deltas by 10"),
        ({"neutral": _arrays()["neutral"] / 1000}, "metres: multiply neutral and deltas by 1000"),
        ({"neutral": _arrays()["neutral"][:35]}, "V = 35"),
        ({"polygons": np.array([[0, 1, 2, 36]])}, r"polygons: vertex ids must lie in 0\.\.35"),
        ({"lip_pairs": np.array([[0, 99]])}, "lip_pairs: vertex ids"),
        ({"rigid_vertices": np.array([-1])}, "rigid_vertices: vertex ids"),
        ({"deltas": np.full((6, 36, 3), np.nan)}, "deltas holds 648 numbers that are not finite"),
    ],
)
def test_refuses_a_template_that_does_not_fit(
    tmp_path: Path, change: dict[str, np.ndarray], message: str
) -> None:
    path = tmp_path / "t.npz"
    np.savez(path, **(_arrays() | change))
    with pytest.raises(InputError, match=message) as caught:
        read_template(path)
    assert "t.npz" in str(caught.value)


def test_never_unpickles(tmp_path: Path) -> None:
    np.savez(tmp_path / "t.npz", **(_arrays() | {"names": np.array(["a"] * 6, dtype=object)}))
    with pytest.raises(ShapeError, match="names cannot be read"):
        read_template(tmp_path / "t.npz")


def test_missing_keys_are_named(tmp_path: Path) -> None:
    np.savez(tmp_path / "t.npz", neutral=np.zeros((3, 3)))
    with pytest.raises(InputError, match="missing deltas, names, polygons"):
        read_template(tmp_path / "t.npz")


def test_support_ignores_dust() -> None:
    template = grid_template(6)
    dusty = Template(
        neutral=template.neutral, deltas=template.deltas + 1e-6, names=template.names,
        polygons=template.polygons,
    )  # fmt: skip
    assert dusty.moves().tolist() == [True] * 5 + [False]
    assert (dusty.support(1e-3)[:5] == template.support(1e-3)[:5]).all()


def test_rig_round_trip_and_its_equation(tmp_path: Path) -> None:
    template = grid_template(6)
    rng = np.random.default_rng(0)
    motion = np.eye(4)
    motion[:3, 3] = 1.0, 2.0, 3.0
    rig = FaceRig(
        neutral=template.neutral, deltas=template.deltas, names=template.names,
        polygons=template.polygons, weights=rng.uniform(0, 1, (2, 6)),
        head_from_rig=np.stack([np.eye(4), motion]),
    )  # fmt: skip
    write_rig(tmp_path / "rig.npz", rig)
    again = read_rig(tmp_path / "rig.npz")
    expected = rig.neutral + np.einsum("b,bva->va", rig.weights[1], rig.deltas) + [1, 2, 3]
    assert again.evaluate(1) == pytest.approx(expected, abs=1e-4)
    with pytest.raises(ShapeError, match=r"frames 0\.\.1"):
        rig.evaluate(2)


def test_weights_round_trip_and_order(tmp_path: Path) -> None:
    table = WeightTable(
        weights=np.array([[0.1, 0.2], [0.3, 0.4]]), names=("b", "a"), t_ns=np.array([0, 40])
    )
    write_weights(tmp_path / "w.npz", table)
    again = read_weights(tmp_path / "w.npz")
    assert again.columns(("a", "b", "c")).tolist() == [[0.2, 0.1, 0.0], [0.4, 0.3, 0.0]]
    assert again.t_ns is not None
    assert again.t_ns.tolist() == [0, 40]
    with pytest.raises(InputError, match="not shapes of the template: b"):
        again.columns(("a",))
