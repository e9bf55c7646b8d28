"""Names: maps between conventions lose nothing, errors say what is wrong, sides are read right."""

from pathlib import Path

import pytest

from capture.errors import InputError
from rig.naming import SHIPPED, detect_map, mirrored_name, read_name_map, rename, side_of

ARKIT = read_name_map("arkit")
ARKIT_NAMES = tuple(own for owns in ARKIT.shapes.values() for own in owns)
ICT_NAMES = tuple(own for owns in read_name_map("ict").shapes.values() for own in owns)


def _write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "studio.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_the_shipped_maps_are_of_the_sizes_that_their_owners_publish() -> None:
    assert len(ARKIT_NAMES) == 52
    assert len(read_name_map("livelink").shapes) == 52
    assert len(ICT_NAMES) == 57  # 51 of ARKit's, two of them halved, and four more
    assert set(read_name_map("facs").shapes) < set(ARKIT.shapes)


def test_ict_to_arkit_merges_the_two_that_arkit_has_whole_and_keeps_what_it_lacks() -> None:
    renaming = rename(ICT_NAMES, ARKIT)
    assert renaming.merges == {
        "browInnerUp": ("browInnerUp_L", "browInnerUp_R"),
        "cheekPuff": ("cheekPuff_L", "cheekPuff_R"),
    }
    assert renaming.unmapped == (
        "cheekRaiser_L", "cheekRaiser_R", "PupilDilate_L", "PupilDilate_R",
    )  # fmt: skip
    assert set(ARKIT_NAMES) - set(renaming.names) == {"tongueOut"}


def test_arkit_to_ict_splits_the_two() -> None:
    renaming = rename(ARKIT_NAMES, read_name_map("ict"))
    assert renaming.splits["browInnerUp"] == ("browInnerUp_L", "browInnerUp_R")
    assert renaming.unmapped == ("tongueOut",)
    assert len(renaming.names) == 54


@pytest.mark.parametrize("name", ["livelink", "ict", "facs"])
def test_there_and_back_is_the_same(name: str) -> None:
    away = rename(ARKIT_NAMES, read_name_map(name))
    back = rename(away.names, ARKIT, read_name_map(name))
    assert set(back.names) == set(ARKIT_NAMES)
    assert set(back.unmapped) == set(away.unmapped)


def test_spelling_does_not_count_but_is_mended() -> None:
    assert rename(["EyeBlinkLeft", "jaw_open"], ARKIT).names == ("eyeBlinkLeft", "jawOpen")


def test_facs_is_read_with_its_meaning_and_without_sides_where_it_is_whole() -> None:
    facs = read_name_map("facs")
    assert facs.find("AU12L lip corner puller") == ("mouthSmileLeft", "middle")
    assert facs.find("au12_r") == ("mouthSmileRight", "middle")
    assert facs.find("AU1") == ("browInnerUp", "middle")
    assert facs.find("AU1L") == ("browInnerUp", "left")
    assert facs.meaning("AU12L") == "lip corner puller"
    assert facs.meaning("AU28B") == "lip suck"
    assert all(facs.meaning(own) for owns in facs.shapes.values() for own in owns)


def test_the_convention_is_recognised() -> None:
    for name in SHIPPED:
        owns = [own for owns in read_name_map(name).shapes.values() for own in owns]
        assert detect_map(owns).name == name
    with pytest.raises(InputError, match=r"none of the 2 \(a, b, \.\.\.\) is known"):
        detect_map(["a", "b"])


def test_no_name_means_different_shapes_in_two_conventions() -> None:
    maps = [read_name_map(name) for name in SHIPPED]
    for own in [own for m in maps for owns in m.shapes.values() for own in owns]:
        assert len({found for m in maps if (found := m.find(own)) is not None}) == 1
    mixed = ["eyeBlink_L", "MouthSmileLeft", "AU26 jaw drop"]
    assert rename(mixed, ARKIT).names == ("eyeBlinkLeft", "mouthSmileLeft", "jawOpen")


def test_a_half_without_its_other_half_is_kept() -> None:
    renaming = rename(["browInnerUp_L", "jawOpen", "eyeBlink_L"], ARKIT, read_name_map("ict"))
    assert renaming.unmapped == ("browInnerUp_L",)
    assert renaming.names == ("browInnerUp_L", "jawOpen", "eyeBlinkLeft")


@pytest.mark.parametrize(
    ("names", "pair"),
    [
        (("eyeBlinkLeft", "EyeBlinkLeft"), "eyeBlinkLeft and EyeBlinkLeft"),
        (("AU26", "AU27", "AU12L"), "AU26 and AU27"),
    ],
)
def test_two_shapes_that_would_get_one_name_are_refused(names: tuple[str, ...], pair: str) -> None:
    with pytest.raises(InputError, match=f"{pair} would both be called"):
        rename(names, ARKIT)


def test_an_unmapped_name_that_is_in_the_way_is_refused() -> None:
    with pytest.raises(InputError, match="would both be called eyeBlinkLeft"):
        rename(["eyeBlink_L", "eyeBlinkLeft"], ARKIT, read_name_map("ict"))


def test_a_map_of_ones_own(tmp_path: Path) -> None:
    path = _write(
        tmp_path,
        'name = "studio"\n[shapes]\neyeBlinkLeft = "L_blink"\n'
        'browInnerUp = ["L_browIn", "R_browIn"]\n[aliases]\nblinkL = "eyeBlinkLeft"\n',
    )
    studio = read_name_map(path)
    assert studio.name == "studio"
    assert rename(["eyeBlinkLeft", "browInnerUp"], studio).names == (
        "L_blink", "L_browIn", "R_browIn",
    )  # fmt: skip
    assert rename(["blinkL"], ARKIT, studio).names == ("eyeBlinkLeft",)


def test_every_fault_of_a_map_is_told_at_once(tmp_path: Path) -> None:
    path = _write(
        tmp_path,
        'shape = 1\n[shapes]\neyeBlinkLef = "a"\njawOpen = ["x", "y", "z"]\nmouthLeft = "b_c"\n'
        'mouthRight = "B c"\n[aliases]\nq = "jawOpn"\n',
    )
    with pytest.raises(InputError) as caught:
        read_name_map(path)
    text = str(caught.value)
    assert "studio.toml: 5 problems" in text
    assert "unknown key 'shape'; did you mean 'shapes'?" in text
    assert "'eyeBlinkLef' is not an ARKit name; did you mean 'eyeBlinkLeft'?" in text
    assert "shapes.jawOpen: expected a name, or [left, right]" in text
    assert "names that are read alike: b_c, B c" in text
    assert "aliases.q: 'jawOpn': did you mean 'jawOpen'?" in text


def test_an_unknown_map_is_refused_with_the_nearest() -> None:
    with pytest.raises(InputError, match="did you mean 'arkit'"):
        read_name_map("arkitt")


def test_a_map_without_shapes_and_a_file_that_is_none(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="at least one ARKit name, found none"):
        read_name_map(_write(tmp_path, ""))
    with pytest.raises(InputError, match="not readable as TOML"):
        read_name_map(_write(tmp_path, "a = = 1"))


@pytest.mark.parametrize(
    ("name", "side", "mirrored"),
    [
        ("eyeBlink_L", "left", "eyeBlink_R"),
        ("eyeBlinkLeft", "left", "eyeBlinkRight"),
        ("EyeBlinkRight", "right", "EyeBlinkLeft"),
        ("AU12R", "right", "AU12L"),
        ("AU61L", "left", "AU62R"),
        ("AU62R", "right", "AU61L"),
        ("jawLeft", "left", "jawRight"),
        ("l_blink", "left", "r_blink"),
        ("CTRL_L_eye_blink", "left", "CTRL_R_eye_blink"),
        ("lf.brow", "left", "rt.brow"),
        ("Left Brow", "left", "Right Brow"),
        ("browDownR", "right", "browDownL"),
        ("browInnerUp", "middle", "browInnerUp"),
        ("mouthRollUpper", "middle", "mouthRollUpper"),
        ("AU28B", "middle", "AU28B"),
        ("ROLL", "middle", "ROLL"),
        ("upright", "middle", "upright"),
    ],
)
def test_sides(name: str, side: str, mirrored: str) -> None:
    assert side_of(name) == side
    assert mirrored_name(name) == mirrored
    assert mirrored_name(mirrored) == name


def test_mirroring_is_its_own_inverse_and_stays_within_each_convention() -> None:
    for convention in SHIPPED:
        owns = {own for owns in read_name_map(convention).shapes.values() for own in owns}
        assert {mirrored_name(own) for own in owns} == owns
        assert all(mirrored_name(mirrored_name(own)) == own for own in owns)


def test_mirrored_names_mean_mirrored_shapes_in_every_convention() -> None:
    for convention in ("livelink", "ict", "facs"):
        name_map = read_name_map(convention)
        for shape, owns in name_map.shapes.items():
            if len(owns) == 1:
                found = name_map.find(mirrored_name(owns[0]))
                assert found == (mirrored_name(shape), "middle")
