"""The shot list: what the talent is asked for, in order, as TOML.

::

    name = "standard"                    the list's name
    title = "Range of motion"            for people

    [defaults]                           optional; of any prompt that does not say otherwise
    hold_s = 1.0

    [[prompt]]
    slate = "smile"                      of the takes, safe as a file name
    title = "Smile"
    sentence = "Smile as wide as you can."
    kind = "expression"                  board, neutral or expression
    hold_s = 1.0                         the part that must be whole, in the middle
    total_s = 2.0
    countdown_s = 3.0
    picture = "smile.png"                optional, inside the folder of the list
    tags = ["AU12"]                      optional, FACS action units and the like
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from capture.documents import key_problems, read_toml
from capture.errors import SettingsError, raise_all
from capture.names import is_plain_name, known_hint
from capture.recorder import RecordSettings
from capture.session import Shot, ShotList

KINDS = ("board", "neutral", "expression")
_REQUIRED = ("slate", "title", "sentence", "kind")
_TIMES = {"hold_s": (0.0, 60.0), "total_s": (0.1, 60.0), "countdown_s": (0.0, 30.0)}
_DEFAULTS = {"hold_s": 1.0, "total_s": 2.0, "countdown_s": 3.0}
_KEYS = (*_REQUIRED, *_TIMES, "picture", "tags")
_MOST_PROMPTS = 1000
_LONGEST = {"title": 60, "sentence": 200}
_TOP = ("name", "title", "defaults", "prompt")


@dataclass(frozen=True, kw_only=True)
class Prompt:
    """One thing the talent is asked for.

    Attributes:
        slate: of its takes, safe as a file name; unique in the list.
        title: a few words, for the card and the list.
        sentence: what the talent is told.
        kind: "board", "neutral" or "expression".
        hold_s: how long the expression is held; it lies in the middle of the take.
        total_s: how long the take is, neutral before and after included.
        countdown_s: from "go" to the start of the take.
        picture: a file that shows it, or None.
        tags: FACS action units and the like.
    """

    slate: str
    title: str
    sentence: str
    kind: str
    hold_s: float = 1.0
    total_s: float = 2.0
    countdown_s: float = 3.0
    picture: Path | None = None
    tags: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        texts = {key: getattr(self, key) for key in _REQUIRED}
        times = {key: getattr(self, key) for key in _TIMES}
        raise_all(f"prompt {self.slate!r}", _value_problems(texts, times), SettingsError)

    @property
    def before_s(self) -> float:
        """From the start of the take to the start of the hold; as long as after it."""
        return (self.total_s - self.hold_s) / 2

    def shot(self, settings: RecordSettings) -> Shot:
        """What is to be recorded: frames, and the hold in the middle of them.

        Args:
            settings: rate of the recording.
        """
        frames = max(1, round(self.total_s * settings.rate_hz))
        held = min(frames, round(self.hold_s * settings.rate_hz))
        if not held:
            return Shot(slate=self.slate, kind=self.kind, frames=frames)
        first = (frames - held) // 2
        hold = (first, first + held - 1)
        return Shot(slate=self.slate, kind=self.kind, frames=frames, hold=hold)


@dataclass(frozen=True, kw_only=True)
class PromptList:
    """All prompts of a session, in order; slates are unique.

    Attributes:
        name: of the list.
        title: for people.
        prompts: at least one.
    """

    name: str
    title: str
    prompts: tuple[Prompt, ...]

    def __post_init__(self) -> None:
        problems = _doubles([prompt.slate for prompt in self.prompts])
        if not 1 <= len(self.prompts) <= _MOST_PROMPTS:
            problems.append(f"expected 1 to {_MOST_PROMPTS} prompts, found {len(self.prompts)}")
        raise_all(f"shot list {self.name!r}", problems, SettingsError)

    @property
    def slates(self) -> tuple[str, ...]:
        """The slates, in order."""
        return tuple(prompt.slate for prompt in self.prompts)

    def shots(self, settings: RecordSettings) -> ShotList:
        """The shots of all prompts."""
        return ShotList(tuple(prompt.shot(settings) for prompt in self.prompts))


def read_shot_list(path: Path) -> PromptList:
    """Read a shot list; whatever is wrong with it is listed.

    Raises:
        SettingsError: naming the file and, for each prompt, unknown keys with the nearest known
            one, missing keys, values of the wrong type or out of range, slates that are there
            twice and pictures that are missing or outside the folder of the list.
    """
    path = Path(path)
    document = read_toml(path, SettingsError, absent="no such shot list")
    problems = key_problems(document, ("name", "prompt"), _TOP, "shot list")
    for key in ("name", "title"):
        if not isinstance(document.get(key, ""), str):
            problems.append(f"{key}: expected a text, found {document[key]!r}")
    defaults = _read_defaults(document.get("defaults", {}), problems)
    tables = document.get("prompt", [])
    if not isinstance(tables, list):
        problems.append(f"prompt: expected tables [[prompt]], found {tables!r}")
        tables = []
    prompts = [
        _read_prompt(table, f"prompt {number}", defaults, path.parent, problems)
        for number, table in enumerate(tables, start=1)
    ]
    problems += _doubles(
        [table.get("slate") if isinstance(table, Mapping) else None for table in tables]
    )
    raise_all(str(path), problems, SettingsError)
    name = document["name"]
    made = tuple(prompt for prompt in prompts if prompt is not None)
    try:
        return PromptList(name=name, title=document.get("title", name), prompts=made)
    except SettingsError as error:
        raise SettingsError(f"{path}: {error}") from error


def standard_shot_list() -> PromptList:
    """The list that comes with the project: about sixty expressions for a face rig."""
    with resources.as_file(resources.files("capture.rom").joinpath("standard.toml")) as path:
        return read_shot_list(path)


def _read_defaults(table: Any, problems: list[str]) -> dict[str, float]:
    values = dict(_DEFAULTS)
    if not isinstance(table, Mapping):
        problems.append(f"defaults: expected a table [defaults], found {table!r}")
        return values
    problems += key_problems(table, (), tuple(_TIMES), "defaults")
    for key in _TIMES:
        if key in table:
            values[key] = _number(table[key], f"defaults.{key}", values[key], problems)
    return values


def _read_prompt(
    table: Any, what: str, defaults: Mapping[str, float], folder: Path, problems: list[str]
) -> Prompt | None:
    if not isinstance(table, Mapping):
        problems.append(f"{what}: expected a table [[prompt]], found {table!r}")
        return None
    if isinstance(table.get("slate"), str):
        what = f"{what} ({table['slate']})"
    found = key_problems(table, _REQUIRED, _KEYS, what)
    for key in _REQUIRED:
        if key in table and not isinstance(table[key], str):
            found.append(f"{what}: {key}: expected a text, found {table[key]!r}")
    times = {
        key: _number(table.get(key, defaults[key]), f"{what}: {key}", defaults[key], found)
        for key in _TIMES
    }
    tags = table.get("tags", [])
    if not isinstance(tags, list) or not all(isinstance(tag, str) for tag in tags):
        found.append(f"{what}: tags: expected a list of texts, found {tags!r}")
    picture = _read_picture(table["picture"], what, folder, found) if "picture" in table else None
    if not found:
        texts = {key: table[key] for key in _REQUIRED}
        found = [f"{what}: {problem}" for problem in _value_problems(texts, times)]
        if not found:
            return Prompt(
                slate=table["slate"],
                title=table["title"],
                sentence=table["sentence"],
                kind=table["kind"],
                picture=picture,
                tags=tuple(tags),
                **times,
            )
    problems += found
    return None


def _read_picture(name: Any, what: str, folder: Path, problems: list[str]) -> Path | None:
    """The picture's path; it must lie inside the folder of the list, links followed."""
    if not isinstance(name, str) or not name or "\0" in name:
        problems.append(f"{what}: picture: expected the name of a file, found {name!r}")
        return None
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        problems.append(f"{what}: picture: {name!r} is outside the folder of the shot list")
    elif not path.is_file():
        problems.append(f"{what}: picture: {name!r} is missing in the folder of the shot list")
    return path


def _number(value: Any, what: str, instead: float, problems: list[str]) -> float:
    if isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    problems.append(f"{what}: expected a number of seconds, found {value!r}")
    return instead


def _value_problems(texts: Mapping[str, str], times: Mapping[str, float]) -> list[str]:
    problems = []
    if not is_plain_name(texts["slate"]):
        problems.append(f"slate must be letters, digits, '-', '_' or '.', found {texts['slate']!r}")
    for key, longest in _LONGEST.items():
        text = texts[key]
        if not text.strip() or len(text) > longest or not text.isprintable():
            problems.append(
                f"{key} must be one line of 1 to {longest} letters, found {len(text)}: {text!r}"
            )
    if texts["kind"] not in KINDS:
        problems.append(f"kind {texts['kind']!r} is unknown; {known_hint(texts['kind'], KINDS)}")
    for key, (low, high) in _TIMES.items():
        if not low <= times[key] <= high:
            problems.append(f"{key} must be {low:g} to {high:g} seconds, found {times[key]:g}")
    if times["hold_s"] > times["total_s"]:
        problems.append(
            f"hold_s must fit into total_s = {times['total_s']:g}, found {times['hold_s']:g}"
        )
    return problems


def _doubles(slates: list[Any]) -> list[str]:
    """Slates that are there twice, capitals or not: some disks do not tell them apart."""
    where: dict[str, list[int]] = {}
    for number, slate in enumerate(slates, start=1):
        if isinstance(slate, str):
            where.setdefault(slate.casefold(), []).append(number)
    return [
        f"prompts {' and '.join(map(str, numbers))} have one slate, {slates[numbers[0] - 1]!r}; "
        "each slate must be there once"
        for numbers in where.values()
        if len(numbers) > 1
    ]
