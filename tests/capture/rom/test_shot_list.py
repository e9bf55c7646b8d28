"""Shot lists: the standard one, prompts as shots, and what is told of a list that does not fit."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from capture.errors import SettingsError
from capture.recorder import RecordSettings
from capture.rom.shot_list import Prompt, PromptList, read_shot_list, standard_shot_list
from capture.session import Shot

SMILE = """
[[prompt]]
slate = "smile"
title = "Smile"
sentence = "Smile as wide as you can."
kind = "expression"
"""


def written(tmp_path: Path, text: str, name: str = 'name = "mine"\n') -> Path:
    path = tmp_path / "list.toml"
    path.write_text(name + text, encoding="utf-8")
    return path


def refused(tmp_path: Path, text: str, name: str = 'name = "mine"\n') -> str:
    with pytest.raises(SettingsError) as caught:
        read_shot_list(written(tmp_path, text, name))
    return str(caught.value)


def test_the_standard_list_covers_the_face_and_starts_with_the_board_and_the_neutral() -> None:
    prompts = standard_shot_list().prompts
    assert [prompt.kind for prompt in prompts[:2]] == ["board", "neutral"]
    assert 60 <= sum(prompt.kind == "expression" for prompt in prompts) <= 70
    tags = {tag for prompt in prompts for tag in prompt.tags}
    assert {
        *(f"AU{n}" for n in (1, 2, 4, 5, 6, 7, 9, 10, 12, 14, 15, 16, 17, 18, 19, 20, 22, 24, 25)),
        *(f"AU{n}" for n in (26, 27, 28, 29, 34, 35, 38, 43, 61, 62, 63, 64)),
        *(f"AU{n}{side}" for n in (1, 10, 12, 30, 34, 46) for side in "LR"),
    } <= tags
    assert sum("viseme" in prompt.tags for prompt in prompts) == 12
    assert len({prompt.title for prompt in prompts}) == len(prompts)
    for prompt in prompts:
        assert prompt.sentence.endswith((".", ".'"))
        assert prompt.sentence[0].isupper()


def test_a_left_prompt_has_a_right_one_with_the_mirrored_sentence() -> None:
    prompts = {prompt.slate: prompt for prompt in standard_shot_list().prompts}
    sided = [slate for slate in prompts if slate.endswith("_left")]
    assert len(sided) == 8
    for slate in sided:
        other = prompts[slate.removesuffix("_left") + "_right"]
        words = re.split(r"\b(left|right)\b", prompts[slate].sentence)
        mirrored = [{"left": "right", "right": "left"}.get(word, word) for word in words]
        assert "".join(mirrored) == other.sentence


@pytest.mark.parametrize("pre_roll", [0, 2, 30])
@pytest.mark.parametrize("hold_s", [0.0, 0.5, 1.0, 2.0])
def test_the_hold_is_counted_from_the_key(pre_roll: int, hold_s: float) -> None:
    prompt = Prompt(
        slate="smile", title="Smile", sentence="Smile.", kind="expression", hold_s=hold_s,
        total_s=2.0,
    )  # fmt: skip
    settings = RecordSettings(rate_hz=75, pre_roll=pre_roll, post_roll=4)
    shot = prompt.shot(settings)
    assert (shot.slate, shot.kind, shot.frames) == ("smile", "expression", 150)
    held = [  # frame k is exposed k periods after the key
        k
        for k in range(150)
        if prompt.before_s * 75 - 0.75 <= k <= (prompt.before_s + hold_s) * 75 - 0.75
    ]
    if not hold_s:
        assert shot.hold is None
        return
    assert shot.hold is not None
    assert shot.hold[1] == held[-1]
    assert abs(shot.hold[0] - held[0]) <= 1


def test_a_list_gives_the_shots_of_all_its_prompts(tmp_path: Path) -> None:
    text = "[defaults]\nhold_s = 0.5\ntotal_s = 1.0\n" + SMILE + 'tags = ["AU12"]\n'
    (tmp_path / "frown.png").write_bytes(b"")
    text += SMILE.replace("smile", "frown") + 'total_s = 2\npicture = "frown.png"\n'
    made = read_shot_list(written(tmp_path, text))
    assert (made.name, made.title, made.slates) == ("mine", "mine", ("smile", "frown"))
    assert made.prompts[0].tags == ("AU12",)
    assert made.prompts[1].picture == tmp_path / "frown.png"
    shots = made.shots(RecordSettings(rate_hz=10, pre_roll=0)).shots
    assert shots == (
        Shot(slate="smile", kind="expression", frames=10, hold=(2, 6)),
        Shot(slate="frown", kind="expression", frames=20, hold=(7, 11)),
    )


def test_all_problems_of_a_list_are_told_at_once(tmp_path: Path) -> None:
    bad = (
        '[defaults]\nhold = 1.0\n' + SMILE + "countdwn_s = 3\n"
        + SMILE.replace("expression", "grimace") + "total_s = 0\n"
        + '[[prompt]]\nslate = "a/b"\ntitle = 3\nkind = "board"\n'
    )  # fmt: skip
    text = refused(tmp_path, bad)
    assert "list.toml: 8 problems" in text
    assert "defaults: unknown key 'hold'; did you mean 'hold_s'?" in text
    assert "prompt 1 (smile): unknown key 'countdwn_s'; did you mean 'countdown_s'?" in text
    assert "prompt 2 (smile): kind 'grimace' is unknown; known: board, neutral, expression" in text
    assert "prompt 2 (smile): total_s must be 0.1 to 60 seconds, found 0" in text
    assert "prompt 3 (a/b): missing key 'sentence'" in text
    assert "prompt 3 (a/b): title: expected a text, found 3" in text
    assert "prompts 1 and 2 have one slate, 'smile'; each slate must be there once" in text


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "missing key 'prompt'"),
        ("prompt = []\n", "expected 1 to 1000 prompts, found 0"),
        ("prompt = 3\n", "prompt: expected tables [[prompt]], found 3"),
        (SMILE.replace('"smile"', '"../smile"'), "slate must be letters"),
        (SMILE + "hold_s = 3.0\n", "hold_s must fit into total_s = 2, found 3"),
        (SMILE + "hold_s = nan\n", "hold_s must be 0 to 60 seconds, found nan"),
        (SMILE + 'hold_s = "1"\n', "hold_s: expected a number of seconds, found '1'"),
        (SMILE + "tags = [1]\n", "tags: expected a list of texts, found [1]"),
        (SMILE + 'picture = "a.png"\n', "picture: 'a.png' is missing in the folder"),
        (SMILE + 'picture = "../a.png"\n', "picture: '../a.png' is outside the folder"),
        (SMILE + 'picture = "/etc/passwd"\n', "picture: '/etc/passwd' is outside the folder"),
        (SMILE + SMILE.replace("smile", "SMILE"), "have one slate"),
        (SMILE.replace("Smile as", r"\u001b[2J"), "sentence must be one line"),
        ("[promt]\n", "unknown key 'promt'; did you mean 'prompt'?"),
    ],
)
def test_the_likeliest_mistakes_are_told(tmp_path: Path, text: str, words: str) -> None:
    assert words in refused(tmp_path, text)


def test_a_picture_behind_a_link_out_of_the_folder_is_refused(tmp_path: Path) -> None:
    inside = tmp_path / "list"
    inside.mkdir()
    (tmp_path / "secret.png").write_bytes(b"")
    (inside / "smile.png").symlink_to(tmp_path / "secret.png")
    assert "is outside the folder" in refused(inside, SMILE + 'picture = "smile.png"\n')


def test_a_list_that_is_no_list_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="no such shot list"):
        read_shot_list(tmp_path / "none.toml")
    assert "not readable as TOML" in refused(tmp_path, "[[prompt]\n")
    with pytest.raises(SettingsError, match="shot list 'x': expected 1 to 1000 prompts, found 0"):
        PromptList(name="x", title="X", prompts=())


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    st.recursive(
        st.sampled_from(['"x"', "1", "-1", "true", "nan", "[]", "{}", '"../x"', "1e400"]),
        lambda inner: st.lists(inner, max_size=2).map(lambda items: f"[{', '.join(items)}]"),
    ),
    st.sampled_from(
        ["name", "title", "defaults", "prompt", "slate", "sentence", "kind", "hold_s", "total_s",
         "countdown_s", "picture", "tags"]
    ),
)  # fmt: skip
def test_any_value_at_any_key_is_read_or_told(tmp_path: Path, value: str, key: str) -> None:
    top = key in ("name", "title", "defaults", "prompt")
    text = f"{key} = {value}\n" if top else SMILE + f"{key} = {value}\n"
    path = written(tmp_path, text + ("" if not top or key == "prompt" else SMILE), "")
    if key != "name":
        path.write_text('name = "mine"\n' + path.read_text(encoding="utf-8"), encoding="utf-8")
    try:
        made = read_shot_list(path)
    except SettingsError as error:
        told = str(error)
    else:
        told = f"{path}: {len(made.prompts)} prompts"
    assert told.startswith(str(path))
