"""The kinds of correction, as values; see docs/corrections.md for what each does."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, TypeAlias

Pixel: TypeAlias = tuple[float, float]
"""Column and row of the full image, px, integers at pixel centres."""


@dataclass(frozen=True, kw_only=True)
class Pin:
    """A point of the surface, and the pixels where views show it.

    Attributes:
        frame: at which frame.
        corners: one vertex, or the three of a triangle of the mesh.
        barycentric: a weight of each corner, sum 1.
        pixels: by camera.
        weight: of the pin against an ordinary one.
    """

    kind: ClassVar[str] = "pin"
    frame: int
    corners: tuple[int, ...]
    barycentric: tuple[float, ...]
    pixels: Mapping[str, Pixel]
    weight: float = 1.0

    @property
    def point(self) -> str:
        """The point in words."""
        if len(self.corners) == 1:
            return f"vertex {self.corners[0]}"
        shares = ", ".join(f"{share:g}" for share in self.barycentric)
        return f"point ({shares}) of triangle {'-'.join(map(str, self.corners))}"

    def table(self) -> dict[str, Any]:
        """The pin as the file has it."""
        if len(self.corners) == 1:
            where: dict[str, Any] = {"vertex": self.corners[0]}
        else:
            where = {"triangle": list(self.corners), "barycentric": list(self.barycentric)}
        pixels = {name: list(self.pixels[name]) for name in sorted(self.pixels)}
        return {"frame": self.frame, **where, "pixels": pixels, **_weight(self.weight)}

    def __str__(self) -> str:
        return f"pin at frame {self.frame}: {self.point} in {', '.join(sorted(self.pixels))}"


@dataclass(frozen=True, kw_only=True)
class Curve:
    """A chain of vertices, and the line of pixels that it lies on in one view.

    Attributes:
        frame: at which frame.
        camera: in which view.
        chain: the chain's name, "upper lip" say.
        vertices: the chain, in order.
        pixels: corners of the line, in order; its direction does not matter.
        weight: of the curve against an ordinary one.
    """

    kind: ClassVar[str] = "curve"
    frame: int
    camera: str
    chain: str
    vertices: tuple[int, ...]
    pixels: tuple[Pixel, ...]
    weight: float = 1.0

    def table(self) -> dict[str, Any]:
        """The curve as the file has it."""
        return {
            "frame": self.frame, "camera": self.camera, "chain": self.chain,
            "vertices": list(self.vertices), "pixels": [list(pixel) for pixel in self.pixels],
            **_weight(self.weight),
        }  # fmt: skip

    def __str__(self) -> str:
        return (
            f"curve at frame {self.frame}: {self.chain!r}, {len(self.vertices)} vertices, "
            f"along {len(self.pixels)} pixels in {self.camera}"
        )


@dataclass(frozen=True, kw_only=True)
class ViewExclusion:
    """A camera that is not looked at in some frames, `first` to `last`, both included."""

    kind: ClassVar[str] = "exclude_view"
    camera: str
    first: int
    last: int

    def table(self) -> dict[str, Any]:
        """The exclusion as the file has it."""
        return {"camera": self.camera, "first": self.first, "last": self.last}

    def __str__(self) -> str:
        return f"view {self.camera} excluded at {_span(self.first, self.last)}"


@dataclass(frozen=True, kw_only=True)
class FrameExclusion:
    """Frames that are not measured but interpolated, `first` to `last`, both included."""

    kind: ClassVar[str] = "exclude_frame"
    first: int
    last: int

    def table(self) -> dict[str, Any]:
        """The exclusion as the file has it."""
        return {"first": self.first, "last": self.last}

    def __str__(self) -> str:
        return f"excluded: {_span(self.first, self.last)}"


@dataclass(frozen=True, kw_only=True)
class Lock:
    """A frame whose vertices stay what they are.

    Attributes:
        frame: which.
        sha256: of the file that holds its vertices; see `track.corrections.sidecar.locked_path`.
    """

    kind: ClassVar[str] = "lock"
    frame: int
    sha256: str

    def table(self) -> dict[str, Any]:
        """The lock as the file has it."""
        return {"frame": self.frame, "sha256": self.sha256}

    def __str__(self) -> str:
        return f"frame {self.frame} locked"


@dataclass(frozen=True, kw_only=True)
class Anchor:
    """A frame that others may be matched to."""

    kind: ClassVar[str] = "anchor"
    frame: int

    def table(self) -> dict[str, Any]:
        """The anchor as the file has it."""
        return {"frame": self.frame}

    def __str__(self) -> str:
        return f"anchor at frame {self.frame}"


Correction: TypeAlias = Pin | Curve | ViewExclusion | FrameExclusion | Lock | Anchor


@dataclass(frozen=True, kw_only=True)
class Remarks:
    """Who, when and why, as given; nothing is solved by them. Empty: not said."""

    by: str = ""
    time: str = ""
    note: str = ""

    def table(self) -> dict[str, str]:
        """The remarks that were made."""
        every = {"by": self.by, "time": self.time, "note": self.note}
        return {key: text for key, text in every.items() if text}


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One correction of the file.

    Attributes:
        id: unique in the file, from 1.
        what: the correction.
        remarks: on it.
    """

    id: int
    what: Correction
    remarks: Remarks = field(default_factory=Remarks)

    def table(self) -> dict[str, Any]:
        """The entry as the file has it."""
        return {
            "id": self.id, "kind": self.what.kind, **self.what.table(), **self.remarks.table()
        }  # fmt: skip

    def __str__(self) -> str:
        said = self.remarks.table()
        extra = " (" + "; ".join(said.values()) + ")" if said else ""
        return f"{self.what}{extra}"


def _weight(weight: float) -> dict[str, float]:
    return {} if weight == 1.0 else {"weight": weight}


def _span(first: int, last: int) -> str:
    return f"frame {first}" if first == last else f"frames {first} to {last}"
