"""Names: what is safe as a file name, and what a wrong name meant."""

import pytest

from capture.names import is_plain_name, known_hint, named, unnamed


@pytest.mark.parametrize(
    ("name", "plain"),
    [("cam-07_b.2", True), ("", False), (".hidden", False), ("a/b", False), ("n" * 65, False)],
)
def test_file_names_are_letters_digits_and_few_signs(name: str, plain: bool):
    assert is_plain_name(name) is plain


def test_a_wrong_name_is_answered_by_the_nearest_or_by_all():
    known = {"voxel_mm": 1, "rounds": 2}
    assert known_hint("voxel_m", known) == "did you mean 'voxel_mm'?"
    assert known_hint("gain", known) == "known: voxel_mm, rounds"
    assert known_hint(7, known) == "known: voxel_mm, rounds"


@pytest.mark.parametrize(
    ("words", "once"),
    [
        ("is gone", "cam1: is gone"),
        ("cam1: is gone", "cam1: is gone"),
        ("Width: reads 8 (cam1: offers 4)", "cam1: Width: reads 8 (offers 4)"),
        ("xcam1: cam11: cam1 is gone", "cam1: xcam1: cam11: cam1 is gone"),
    ],
)
def test_a_name_stands_once_before_what_is_said(words: str, once: str):
    assert named("cam1", words) == once
    assert named("cam1", named("cam1", words)) == once
    assert f"cam1: {unnamed('cam1', words)}" == once
