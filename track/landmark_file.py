"""Hand marks on an actor, from a JSON file: vertices of a mesh and where they are in the world."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from capture.arrays import Floats, Ints
from capture.camera import CameraArray
from capture.documents import read_json
from capture.errors import TakeError, raise_all

_LEAST_SPREAD = np.sin(np.radians(0.5))  # between two rays that are to be met
_KEYS = {"space", "points", "views"}


@dataclass(frozen=True, eq=False, kw_only=True)
class Landmarks:
    """Vertices of a mesh whose places are known.

    Attributes:
        vertices: (N,) vertex indices, ascending, each once.
        positions: (N, 3) world mm.
        miss_mm: (N,) how far the rays of a mark pass by its position, rms; 0 for points given.
    """

    vertices: Ints
    positions: Floats
    miss_mm: Floats


def read_landmarks(path: Path, vertex_count: int, cameras: CameraArray) -> Landmarks:
    """Read hand marks: world points, and pixels in two views or more, which are triangulated.

    ::

        {"space": "world",
         "points": [{"vertex": 812, "position_mm": [1.5, 20.0, 98.2]}],
         "views": [{"vertex": 345, "camera": "cam03", "pixel": [511.2, 388.0]}]}

    Either list may be absent. Pixels are (column, row), integers at pixel centres.

    Args:
        path: the file.
        vertex_count: vertices of the mesh that the marks belong to.
        cameras: the take's.

    Raises:
        TakeError: listing every mark that does not fit, by its place in the file.
    """
    document = _read(path)
    problems: list[str] = [
        f'unknown key "{key}"; a landmarks file has space, points, views'
        for key in document
        if key not in _KEYS
    ]
    if document.get("space", "world") != "world":
        problems.append(f'space: only "world" is known, found {document["space"]!r}')
    found: dict[int, tuple[Floats, float]] = {}
    for place, mark in _entries(document, "points", problems):
        vertex = _vertex(mark, vertex_count, place, problems)
        position = _numbers(mark, "position_mm", 3, place, problems)
        if vertex is not None and position is not None:
            found[vertex] = (position, 0.0)
    rays: dict[int, list[tuple[Floats, Floats]]] = {}
    for place, mark in _entries(document, "views", problems):
        vertex = _vertex(mark, vertex_count, place, problems)
        pixel = _numbers(mark, "pixel", 2, place, problems)
        camera = mark.get("camera")
        if camera not in cameras.names:
            known = ", ".join(cameras.names)
            problems.append(f"{place}: no camera {camera!r}; the take has {known}")
        elif vertex is not None and pixel is not None:
            seen = cameras.by_name(str(camera))
            rays.setdefault(vertex, []).append((seen.centre, seen.rays(pixel[None])[0]))
    for vertex, lines in sorted(rays.items()):
        if len(lines) < 2:
            problems.append(f"views: vertex {vertex} is marked in one view; two or more are needed")
        elif _spread(lines) < _LEAST_SPREAD:
            problems.append(
                f"views: vertex {vertex}: its rays are parallel; mark it in another view"
            )
        elif vertex not in found:
            found[vertex] = _meet(lines)
    if not problems and not found:
        problems.append("no marks: expected points or views")
    raise_all(f"{path}", problems, TakeError)
    order = sorted(found)
    return Landmarks(
        vertices=np.array(order, dtype=np.int64),
        positions=np.array([found[vertex][0] for vertex in order]),
        miss_mm=np.array([found[vertex][1] for vertex in order]),
    )


def _read(path: Path) -> dict[str, Any]:
    document = read_json(path, TakeError, absent="no such landmarks file")
    if not isinstance(document, dict):
        raise TakeError(
            f"{path}: expected an object with points or views, found a {type(document).__name__}"
        )
    return document


def _entries(
    document: dict[str, Any], key: str, problems: list[str]
) -> list[tuple[str, dict[str, Any]]]:
    marks = document.get(key, [])
    if not isinstance(marks, list) or not all(isinstance(mark, dict) for mark in marks):
        problems.append(f"{key}: expected a list of objects")
        return []
    return [(f"{key}[{index}]", mark) for index, mark in enumerate(marks)]


def _vertex(mark: dict[str, Any], count: int, place: str, problems: list[str]) -> int | None:
    vertex = mark.get("vertex")
    if isinstance(vertex, int) and not isinstance(vertex, bool) and 0 <= vertex < count:
        return vertex
    problems.append(f"{place}: vertex must be a whole number in 0..{count - 1}, found {vertex!r}")
    return None


def _numbers(
    mark: dict[str, Any], key: str, count: int, place: str, problems: list[str]
) -> Floats | None:
    value = mark.get(key)
    try:
        numbers = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        numbers = np.zeros(0)
    if numbers.shape == (count,) and np.isfinite(numbers).all():
        return numbers
    problems.append(f"{place}: {key} must be {count} finite numbers, found {value!r}")
    return None


def _spread(lines: list[tuple[Floats, Floats]]) -> float:
    """The sine of the widest angle between the first line (origin, direction) and the others."""
    units = np.array([direction / np.linalg.norm(direction) for _, direction in lines])
    return float(np.linalg.norm(np.cross(units[:1], units), axis=1).max())


def _meet(lines: list[tuple[Floats, Floats]]) -> tuple[Floats, float]:
    """The point nearest to all lines (origin, direction), and its rms distance from them."""
    across = []
    for _, direction in lines:
        unit = direction / np.linalg.norm(direction)
        across.append(np.eye(3) - np.outer(unit, unit))
    system = np.sum(across, axis=0)
    right = np.sum([part @ origin for part, (origin, _) in zip(across, lines, strict=True)], axis=0)
    point: Floats = np.linalg.solve(system, right)
    gaps = [part @ (point - origin) for part, (origin, _) in zip(across, lines, strict=True)]
    return point, float(np.sqrt(np.mean([gap @ gap for gap in gaps])))
