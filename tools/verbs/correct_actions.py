"""The options of each action of `likeness correct`."""

from __future__ import annotations

from dataclasses import dataclass

import tyro


@dataclass(frozen=True, kw_only=True)
class AddPin:
    """Say in which pixels views show a point of the surface.

    A new pin of the same point at the same frame takes the old one's place, view by view.
    """

    frame: int
    """The frame."""
    pixel: tuple[str, ...]
    """CAMERA:COLUMN,ROW of the full image, pixel centres at integers; one or more views."""
    vertex: int | None = None
    """The vertex, counted from 0; or --triangle and --barycentric."""
    triangle: tuple[int, int, int] | None = None
    """Three vertices of a triangle of the mesh."""
    barycentric: tuple[float, float, float] | None = None
    """The point in it: a weight for each, sum 1."""
    weight: float = 1.0
    """Against an ordinary pin."""


@dataclass(frozen=True, kw_only=True)
class AddCurve:
    """Draw the line in one view that a chain of vertices lies on, a lip or a lid.

    Vertices are pulled across the line, never along it.
    """

    frame: int
    """The frame."""
    camera: str
    """The view."""
    chain: str
    """Its name, "upper lip" say."""
    pixels: tuple[str, ...]
    """COLUMN,ROW of each corner of the line, in order; closed when the first is named again."""
    vertices: tuple[int, ...] = ()
    """The chain, in order; left out: as in the curve that used this name last."""
    weight: float = 1.0
    """Against an ordinary curve."""


@dataclass(frozen=True, kw_only=True)
class ExcludeView:
    """Do not look at a camera in some frames."""

    camera: str
    """The view."""
    frames: str | None = None
    """A:B (B excluded), A:B:STEP, A, or A,B,C; all frames when left out."""


@dataclass(frozen=True, kw_only=True)
class ExcludeFrame:
    """Do not measure some frames: they are interpolated between their neighbours."""

    frames: str
    """A:B (B excluded), A:B:STEP, A, or A,B,C."""


@dataclass(frozen=True, kw_only=True)
class LockFrames:
    """Keep the vertices of some frames exactly as they are tracked now."""

    frames: str
    """A:B (B excluded), A:B:STEP, A, or A,B,C."""


@dataclass(frozen=True, kw_only=True)
class UnlockFrames:
    """Let some frames be solved again."""

    frames: str
    """A:B (B excluded), A:B:STEP, A, or A,B,C."""


@dataclass(frozen=True, kw_only=True)
class AnchorFrames:
    """Let other frames be matched to these."""

    frames: str
    """A:B (B excluded), A:B:STEP, A, or A,B,C."""


@dataclass(frozen=True, kw_only=True)
class Remove:
    """Remove corrections by their ids, as `list` shows them."""

    ids: tyro.conf.Positional[tuple[int, ...]]
    """One or more."""


@dataclass(frozen=True, kw_only=True)
class Undo:
    """Take back the last step."""


@dataclass(frozen=True, kw_only=True)
class Redo:
    """Do again the step that was undone last."""


@dataclass(frozen=True, kw_only=True)
class Listing:
    """Tell what is corrected."""
