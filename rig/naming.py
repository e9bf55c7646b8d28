"""Names of shapes: maps between conventions, and which side of the face a name means.

Every map is written in ARKit's words, so that any convention translates into any other through
them. A convention may have one shape where another has a left and a right half: `rename` says what
must be split or merged, and `rig.split` does it.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Literal

from capture.documents import read_toml
from capture.errors import InputError, raise_all
from capture.names import known_hint

Side = Literal["left", "right", "middle"]

_FOLDER = Path(__file__).parent / "name_maps"
SHIPPED = ("arkit", "livelink", "ict", "facs")
"""Maps that come with the project."""
_BEYOND = ("cheekRaiserLeft", "cheekRaiserRight", "pupilDilateLeft", "pupilDilateRight")
_TABLES = ("name", "shapes", "aliases", "meanings")
_SWAPPED = {"left": "right", "right": "left", "l": "r", "r": "l", "lf": "rt", "rt": "lf"}
_SIDE = (
    re.compile(r"(?:(?<=^)|(?<=[_\-. ]))(left|right|lf|rt|l|r)(?=[_\-. ]|$)", re.IGNORECASE),
    re.compile(r"(?<=[a-z0-9])(Left|Right|L|R)$"),
)
_GAZE = re.compile(r"^(AU)?(61|62)(?=[LR]$)")  # both eyes turn left, or both right


@dataclass(frozen=True)
class NameMap:
    """What one convention calls the shapes.

    Attributes:
        name: of the convention.
        shapes: ARKit's name to this convention's one, or to those of its left and right half.
        aliases: further names that are understood, to ARKit's; never written.
        meanings: what a name (without its side) says in words.
    """

    name: str
    shapes: Mapping[str, tuple[str, ...]]
    aliases: Mapping[str, str] = field(default_factory=dict)
    meanings: Mapping[str, str] = field(default_factory=dict)

    def meaning(self, own: str) -> str:
        """What one of this convention's names says in words; "" when nothing is known."""
        bare = re.sub(r"[LRTB]$", "", own)
        return self.meanings.get(own, self.meanings.get(bare, ""))

    def find(self, name: str) -> tuple[str, Side] | None:
        """ARKit's name, and which half of it ("middle": all), of a name of this convention.

        Letter case and the separators `_`, `-`, `.` and space do not count, and a name may be
        followed by its meaning ("AU12L lip corner puller"). None when the name is not known.
        """
        return self._found.get(_folded(name))

    @cached_property
    def _found(self) -> dict[str, tuple[str, Side]]:
        found: dict[str, tuple[str, Side]] = {}
        for shape, owns in self.shapes.items():
            halves: tuple[Side, ...] = ("middle",) if len(owns) == 1 else ("left", "right")
            for own, half in zip(owns, halves, strict=True):
                found[_folded(own)] = (shape, half)
                found[_folded(own + self.meaning(own))] = (shape, half)
        for alias, shape in self.aliases.items():
            found[_folded(alias)] = (shape, "middle")
        return found


@dataclass(frozen=True)
class Renaming:
    """New names for old ones, in the old order.

    Attributes:
        old: names as they were.
        new: for each, its new name; two when it must be split into a left and a right half.
            Two old names with the same new one are halves that must be merged.
        unmapped: old names that have no counterpart; they are kept.
    """

    old: tuple[str, ...]
    new: tuple[tuple[str, ...], ...]
    unmapped: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The new names, each once, in order of first use."""
        return tuple(dict.fromkeys(name for news in self.new for name in news))

    @property
    def splits(self) -> dict[str, tuple[str, ...]]:
        """Old names that must be split, with the names of their halves."""
        return {old: news for old, news in zip(self.old, self.new, strict=True) if len(news) == 2}

    @property
    def merges(self) -> dict[str, tuple[str, ...]]:
        """New names that two old ones must be merged into, with the old ones."""
        sources: dict[str, list[str]] = {}
        for old, news in zip(self.old, self.new, strict=True):
            for name in news:
                sources.setdefault(name, []).append(old)
        return {name: tuple(olds) for name, olds in sources.items() if len(olds) > 1}


def read_name_map(source: str | Path) -> NameMap:
    """A map that comes with the project, by its name, or one in a TOML file of one's own.

    Args:
        source: one of `SHIPPED`, or the path of a file that ends in .toml.

    Raises:
        InputError: naming the file and every fault in it: an unknown table or ARKit name (with the
            nearest known one), a name given twice, an entry that is neither one name nor a left
            and a right one.
    """
    if str(source) in SHIPPED:
        return _shipped(str(source))
    if Path(source).suffix != ".toml":
        raise InputError(
            f"name map {str(source)!r}: expected {', '.join(SHIPPED)} or a file that ends "
            f"in .toml; {known_hint(source, SHIPPED)}"
        )
    return _read(Path(source))


def detect_map(names: Sequence[str]) -> NameMap:
    """The map of the project that knows most of the names as they are spelt.

    Raises:
        InputError: when none knows any of them.
    """
    maps = [read_name_map(name) for name in SHIPPED]
    exact = [{own for owns in m.shapes.values() for own in owns} for m in maps]
    known = [
        (sum(m.find(name) is not None for name in names), len(own & set(names)))
        for m, own in zip(maps, exact, strict=True)
    ]
    best = max(range(len(maps)), key=lambda i: known[i])
    if known[best][0] == 0:
        raise InputError(
            f"names: none of the {len(names)} ({', '.join(list(names)[:4])}, ...) is known to the "
            f"maps {', '.join(SHIPPED)}; write them down in a map of your own (docs/naming.md)"
        )
    return maps[best]


def find_names(
    names: Sequence[str], source: NameMap | None = None
) -> list[tuple[str, Side] | None]:
    """ARKit's name and half of each name; None where it is not known.

    Args:
        names: what shapes are called.
        source: the only convention to ask; when None all maps of the project are asked, which
            nowhere mean different shapes by one name.
    """
    maps = [read_name_map(name) for name in SHIPPED] if source is None else [source]
    return [
        next((place for name_map in maps if (place := name_map.find(name))), None) for name in names
    ]


def rename(names: Sequence[str], to: NameMap, source: NameMap | None = None) -> Renaming:
    """Translate names into another convention.

    Args:
        names: what shapes are called now.
        to: the convention wanted.
        source: the convention they are in; all of the project's are understood when None.

    Returns:
        the new names; names that either map does not know, and a half whose other half is missing
        where `to` has one whole shape, are kept and listed.

    Raises:
        InputError: when two shapes would get the same name without being halves of one.
    """
    places = find_names(names, source)
    count = Counter(place for place in places if place is not None)
    new: list[tuple[str, ...]] = []
    unmapped: list[str] = []
    for name, place in zip(names, places, strict=True):
        target = () if place is None else _target(place, to, count)
        new.append(target or (name,))
        if not target:
            unmapped.append(name)
    renaming = Renaming(tuple(names), tuple(new), tuple(unmapped))
    place_of = dict(zip(names, places, strict=True))
    clashes = []
    for name, olds in renaming.merges.items():
        halves = sorted(place[1] if (place := place_of[old]) else "" for old in olds)
        if halves != ["left", "right"] or set(olds) & set(unmapped):
            clashes.append(f"{' and '.join(olds)} would both be called {name}")
    raise_all(f"names to {to.name}", clashes)
    return renaming


def side_of(name: str) -> Side:
    """The side of the face that a name speaks of: the actor's left or right, or neither.

    Understood are Left, Right, L, R, lf and rt set apart by `_`, `-`, `.` or space anywhere in the
    name, and Left, Right, L and R at its end ("eyeBlinkLeft", "AU12L"). "jawLeft" counts as left:
    its mirror image is "jawRight".
    """
    match = _side_match(name)
    if match is None:
        return "middle"
    return "left" if match.group().lower() in ("left", "l", "lf") else "right"


def mirrored_name(name: str) -> str:
    """The name of the mirrored shape: the same for a name that has no side.

    In FACS, where units 61 and 62 turn both eyes left and right, "AU61L" mirrors to "AU62R".
    """
    match = _side_match(name)
    if match is None:
        return name
    found = match.group()
    other = _SWAPPED[found.lower()]
    spelt = other.upper() if found.isupper() else other.title() if found.istitle() else other
    swapped = name[: match.start()] + spelt + name[match.end() :]
    return _GAZE.sub(lambda m: (m[1] or "") + ("62" if m[2] == "61" else "61"), swapped)


def _side_match(name: str) -> re.Match[str] | None:
    for pattern in _SIDE:
        found = list(pattern.finditer(name))
        if found:
            return found[-1]
    return None


def _target(
    place: tuple[str, Side], to: NameMap, count: Counter[tuple[str, Side]]
) -> tuple[str, ...]:
    """The new name or names for ARKit's name and half; empty when there is none."""
    shape, half = place
    owns = to.shapes.get(shape, ())
    if half == "middle" or not owns:
        return owns
    if len(owns) == 2:
        return (owns[0 if half == "left" else 1],)
    return owns if count[shape, "left"] and count[shape, "right"] else ()


def _folded(name: str) -> str:
    return re.sub(r"[_\-. ]", "", name).casefold()


@cache
def _shipped(name: str) -> NameMap:
    return _read(_FOLDER / f"{name}.toml")


@cache
def _vocabulary() -> tuple[str, ...]:
    return (*read_toml(_FOLDER / "arkit.toml")["shapes"], *_BEYOND)


def _read(path: Path) -> NameMap:
    document = read_toml(path)
    problems = [
        f"unknown key {key!r}; {known_hint(key, _TABLES)}" for key in document if key not in _TABLES
    ]
    name = document.get("name", path.stem)
    if not isinstance(name, str) or not name:
        problems.append(f"name: expected a text, found {name!r}")
    tables = {key: document.get(key, {}) for key in _TABLES[1:]}
    for key, table in tables.items():
        if not isinstance(table, dict):
            problems.append(f"{key}: expected a table, found {table!r}")
            tables[key] = {}
    if not tables["shapes"]:
        problems.append("shapes: expected a table of at least one ARKit name, found none")
    shapes = _shapes(tables["shapes"], problems)
    aliases = _texts("aliases", tables["aliases"], problems)
    for alias, shape in aliases.items():
        if shape not in _vocabulary():
            problems.append(f"aliases.{alias}: {shape!r}: {known_hint(shape, _vocabulary())}")
    meanings = _texts("meanings", tables["meanings"], problems)
    owns = [own for entry in shapes.values() for own in entry] + list(aliases)
    for folded, times in Counter(map(_folded, owns)).items():
        if times > 1:
            same = [own for own in owns if _folded(own) == folded]
            problems.append(f"names that are read alike: {', '.join(same)}")
    raise_all(str(path), problems)
    return NameMap(str(name), shapes, aliases, meanings)


def _shapes(table: Mapping[str, Any], problems: list[str]) -> dict[str, tuple[str, ...]]:
    shapes: dict[str, tuple[str, ...]] = {}
    for key, value in table.items():
        if key not in _vocabulary():
            problems.append(
                f"shapes: {key!r} is not an ARKit name; {known_hint(key, _vocabulary())}"
            )
        entry = value if isinstance(value, list) else [value]
        if len(entry) not in (1, 2) or not all(isinstance(own, str) and own for own in entry):
            problems.append(f"shapes.{key}: expected a name, or [left, right], found {value!r}")
        else:
            shapes[key] = tuple(entry)
    return shapes


def _texts(title: str, table: Mapping[str, Any], problems: list[str]) -> dict[str, str]:
    for key, value in table.items():
        if not isinstance(value, str):
            problems.append(f"{title}.{key}: expected a text, found {value!r}")
    return {key: value for key, value in table.items() if isinstance(value, str)}
