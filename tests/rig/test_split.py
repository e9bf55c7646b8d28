"""Halves sum to the whole exactly, frames stay, and merging undoes splitting."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture.errors import InputError
from rig.face_rig import FaceRig, read_rig, write_rig
from rig.health_symmetry import find_mirror
from rig.naming import read_name_map, rename
from rig.split import apply_renaming, half_names, left_share, split_delta, split_shape
from rig.template import read_template, write_template
from rig.weight_table import WeightTable, read_weights, write_weights
from tests.rig.grid_face import grid_template, random_motions
from tools.cli import main


def _rig(frames: int = 5) -> FaceRig:
    rng = np.random.default_rng(0)
    template = grid_template()
    return FaceRig(
        neutral=template.neutral,
        deltas=template.deltas,
        names=template.names,
        polygons=template.polygons,
        weights=rng.uniform(0, 1, (frames, 6)),
        head_from_rig=random_motions(frames, rng),
    )


@pytest.mark.parametrize("seed", range(4))
def test_the_halves_sum_to_the_whole_bit_for_bit(seed: int) -> None:
    rng = np.random.default_rng(seed)
    delta = rng.normal(size=(5000, 3)) * 10.0 ** rng.integers(-6, 3, (5000, 1))
    share = left_share(rng.uniform(-30, 30, 5000))
    left, right = split_delta(delta, share)
    assert (left + right == delta).all()
    assert np.abs(left - share[:, None] * delta).max() <= 1e-12


def test_the_share_is_smooth_and_mirrors_to_its_complement() -> None:
    x = np.linspace(-20, 20, 4001)
    share = left_share(x, 20.0)
    assert (share[x <= -10.0] == 0).all()
    assert (share[x >= 10.0] == 1).all()
    assert share[2000] == pytest.approx(0.5)
    assert np.abs(share + share[::-1] - 1.0).max() <= 1e-12
    slope = np.diff(share) / np.diff(x)
    assert np.abs(np.diff(slope)).max() <= 1e-3  # no kink
    with pytest.raises(InputError, match="width_mm must be above 0"):
        left_share(x, 0.0)


def test_splitting_changes_no_frame() -> None:
    rig = _rig()
    split = split_shape(rig, "cheekPuff")
    assert split.names[4:6] == ("cheekPuff_L", "cheekPuff_R")
    assert (split.weights[:, 4] == rig.weights[:, 4]).all()
    assert (split.weights[:, 5] == rig.weights[:, 4]).all()
    for frame in range(5):
        assert np.abs(split.evaluate(frame) - rig.evaluate(frame)).max() <= 1e-12


def test_halves_of_a_symmetric_shape_mirror_each_other_and_keep_to_their_side() -> None:
    template = grid_template()
    split = split_shape(template, "browInnerUp")
    left, right = split.deltas[3], split.deltas[4]
    mirror = find_mirror(template.neutral)
    assert mirror.matched.all()
    assert np.abs(mirror.reflect(left) - right).max() <= 1e-12
    assert (left[template.neutral[:, 0] < -10.0] == 0).all()  # the actor's left is +x
    assert (right[template.neutral[:, 0] > 10.0] == 0).all()


def test_the_middle_is_that_of_the_mesh_where_the_face_is_crooked() -> None:
    template = grid_template()
    mirror = find_mirror(template.neutral)
    crooked = template.neutral + np.array([4.0, 0, 0]) + 0.01 * template.neutral[:, [1, 0, 2]]
    assert np.abs(mirror.lateral_mm(crooked) - template.neutral[:, 0]).max() <= 1e-9
    shifted = find_mirror(template.neutral + np.array([4.0, 0, 0]))
    assert shifted.middle_mm == pytest.approx(4.0, abs=1e-9)
    assert (shifted.partner == mirror.partner).all()


def test_names_of_halves_follow_their_neighbours() -> None:
    assert half_names("cheekPuff", ["eyeBlink_L"]) == ("cheekPuff_L", "cheekPuff_R")
    assert half_names("cheekPuff", ["eyeBlinkLeft"]) == ("cheekPuffLeft", "cheekPuffRight")
    assert half_names("AU34", ["AU12L"]) == ("AU34L", "AU34R")
    assert half_names("x") == ("xLeft", "xRight")


def test_a_rig_goes_to_ict_names_and_back() -> None:
    rig = replace(
        _rig(),
        names=(
            "jawOpen", "mouthSmileLeft", "mouthSmileRight", "browInnerUp", "cheekPuff", "tongueOut",
        ),
    )  # fmt: skip
    renaming = rename(rig.names, read_name_map("ict"))
    there, apart = apply_renaming(rig, renaming)
    assert there.names == (
        "jawOpen", "mouthSmile_L", "mouthSmile_R", "browInnerUp_L", "browInnerUp_R",
        "cheekPuff_L", "cheekPuff_R", "tongueOut",
    )  # fmt: skip
    assert apart == {}
    back, apart = apply_renaming(there, rename(there.names, read_name_map("arkit")))
    assert back.names == rig.names
    assert (back.deltas == rig.deltas).all()
    assert (back.weights == rig.weights).all()
    assert apart == {"browInnerUp": 0.0, "cheekPuff": 0.0}


def test_merging_halves_of_different_weights_says_what_was_lost() -> None:
    table = WeightTable(
        weights=np.array([[0.2, 0.8, 0.5], [0.4, 0.4, 0.5]]),
        names=("browInnerUp_L", "browInnerUp_R", "jawOpen"),
    )
    merged, apart = apply_renaming(table, rename(table.names, read_name_map("arkit")))
    assert merged.names == ("browInnerUp", "jawOpen")
    assert merged.weights[:, 0] == pytest.approx([0.5, 0.4])
    assert apart == {"browInnerUp": pytest.approx(0.6)}


def test_what_cannot_be_split_is_refused() -> None:
    rig = _rig()
    with pytest.raises(InputError, match="no shape 'cheekPuf'; did you mean 'cheekPuff'"):
        split_shape(rig, "cheekPuf")
    with pytest.raises(InputError, match="split of cheekPuff: 'jawOpen' is a shape"):
        split_shape(rig, "cheekPuff", ("jawOpen", "b"))
    with pytest.raises(InputError, match="unknown to it: still"):
        apply_renaming(rig, rename(rig.names[:5], read_name_map("arkit")))


def test_the_verb_renames_splits_and_converts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    base = grid_template()
    names = ("jawOpen", "mouthSmile_L", "mouthSmile_R", "mouthClose", "cheekPuff_L", "browDwn_L")
    template = replace(base, names=names, lip_pairs=np.array([[150, 130], [151, 131]]))
    write_template(tmp_path / "t.npz", template)
    words = ["rename", str(tmp_path / "t.npz"), "--out", str(tmp_path / "out.npz")]
    assert main([*words, "--to", "arkit", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["from"], told["renamed"]) == ("ict", 2)
    assert told["kept"] == ["cheekPuff_L", "browDwn_L"]
    assert told["meant"] == {"browDwn_L": "did you mean 'browDown_L'?"}
    found = read_template(tmp_path / "out.npz")
    assert found.names[1:3] == ("mouthSmileLeft", "mouthSmileRight")
    assert (found.lip_pairs == template.lip_pairs).all()
    assert (found.rigid_vertices == template.rigid_vertices).all()
    assert main([*words, "--split", "mouthClose", "--mirror", str(tmp_path / "t.npz")]) == 0
    assert read_template(tmp_path / "out.npz").names[3:5] == ("mouthClose_L", "mouthClose_R")
    assert main([*words, "--mouth-close", "combined"]) == 0
    found = read_template(tmp_path / "out.npz")
    assert np.abs(found.deltas[3] - base.deltas[3] - base.deltas[0]).max() <= 1e-5
    capsys.readouterr()
    assert main(words) == 2
    assert "nothing to do; give --to, --split or --mouth-close" in capsys.readouterr().err
    assert main([*words, "--to", "arkt"]) == 2
    assert "did you mean 'arkit'" in capsys.readouterr().err


def test_the_verb_renames_rigs_and_tables(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = _rig()
    write_rig(tmp_path / "rig.npz", rig)
    words = ["rename", str(tmp_path / "rig.npz"), "--out", str(tmp_path / "out.npz")]
    assert main([*words, "--to", "arkit"]) == 0
    found = read_rig(tmp_path / "out.npz")
    assert found.names == (
        "jawOpen", "mouthSmileLeft", "mouthSmileRight", "browInnerUp", "cheekPuff", "still",
    )  # fmt: skip
    assert (found.weights == rig.weights).all()
    table = WeightTable(weights=rig.weights, names=rig.names)
    write_weights(tmp_path / "w.npz", table)
    words = ["rename", str(tmp_path / "w.npz"), "--out", str(tmp_path / "w2.npz")]
    assert main([*words, "--to", "livelink"]) == 0
    assert read_weights(tmp_path / "w2.npz").names[0] == "JawOpen"
    capsys.readouterr()
    assert main([*words, "--split", "jawOpen"]) == 2
    assert "need a rig or a template" in capsys.readouterr().err
