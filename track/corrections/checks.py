"""Whether corrections fit the take and the mesh that they are of, and each other."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from capture.arrays import Ints, Ints32
from capture.camera import CameraArray
from capture.errors import TakeError
from capture.names import known_hint
from capture.take import Take
from recon.mesh import Mesh
from track.corrections.entries import (
    Anchor,
    Correction,
    Curve,
    Entry,
    FrameExclusion,
    Lock,
    Pin,
    Pixel,
    ViewExclusion,
)

_MIN_VIEWS = 2
_MOST_WEIGHT = 1000.0
_SUM = 1e-6  # how far barycentric weights may be off a sum of 1


@dataclass(frozen=True, eq=False, kw_only=True)
class Subject:
    """What is corrected: frames, views and a mesh.

    Attributes:
        frames: the take's frame numbers, ascending.
        cameras: the take's.
        vertex_count: of the mesh.
        triangles: (T, 3) of the mesh.
        topology: the hash of its polygons.
    """

    frames: tuple[int, ...]
    cameras: CameraArray
    vertex_count: int
    triangles: Ints32
    topology: str

    @classmethod
    def of(cls, take: Take, mesh: Mesh) -> Subject:
        """A take that a mesh of these polygons is tracked through.

        Raises:
            CameraError: when the take has no cameras, or they do not fit.
            TakeError: when it has no frames.
        """
        if not take.frames:
            raise TakeError(f"{take.folder}: the take has no frames")
        return cls(
            frames=take.frames,
            cameras=take.cameras(),
            vertex_count=len(mesh.vertices),
            triangles=mesh.triangles,
            topology=hashlib.sha256(mesh.polygons.tobytes()).hexdigest(),
        )

    @cached_property
    def triangle_of_vertex(self) -> Ints:
        """(V,) the first triangle that uses each vertex; -1: none does."""
        out = np.full(self.vertex_count, -1, dtype=np.int64)
        flat = self.triangles.ravel()[::-1]
        out[flat] = (np.arange(len(flat)) // 3)[::-1]
        return out

    @cached_property
    def triangle_of_corners(self) -> dict[frozenset[int], int]:
        """The triangle of each three corners."""
        return {frozenset(corners): t for t, corners in enumerate(self.triangles.tolist())}


def entry_problems(what: Correction, subject: Subject) -> Iterator[str]:
    """Tell what of one correction does not fit the take and the mesh."""
    if isinstance(what, ViewExclusion | FrameExclusion):
        for name, frame in (("first", what.first), ("last", what.last)):
            yield from _frame_problems(name, frame, subject)
        if what.first > what.last:
            yield f"first {what.first} is after last {what.last}"
    else:
        yield from _frame_problems("frame", what.frame, subject)
    if isinstance(what, FrameExclusion) and what.first <= subject.frames[0] <= what.last:
        yield (
            f"frame {subject.frames[0]} cannot be excluded: it shows the neutral that every "
            "frame is matched to"
        )
    if isinstance(what, ViewExclusion | Curve):
        yield from _camera_problems(what.camera, subject)
    if isinstance(what, Pin):
        yield from _pin_problems(what, subject)
    elif isinstance(what, Curve):
        yield from _curve_problems(what, subject)


def together_problems(entries: Sequence[Entry], subject: Subject) -> Iterator[str]:
    """Tell which corrections contradict each other."""
    seen: dict[tuple[object, ...], int] = {}
    for entry in entries:
        said = claim(entry.what)
        if said in seen:
            yield f"entries {seen[said]} and {entry.id} say the same place twice: {entry.what}"
        if said is not None:
            seen.setdefault(said, entry.id)
    views = [entry.what for entry in entries if isinstance(entry.what, ViewExclusion)]
    spans = [entry.what for entry in entries if isinstance(entry.what, FrameExclusion)]
    for frame in subject.frames if views else ():
        gone = {view.camera for view in views if view.first <= frame <= view.last}
        left = len(set(subject.cameras.names) - gone)
        if left < _MIN_VIEWS and not any(s.first <= frame <= s.last for s in spans):
            yield (
                f"frame {frame}: {left} of {len(subject.cameras)} views are left; two are "
                "needed, or the frame must be excluded as a whole"
            )
            return


def claim(what: Correction) -> tuple[object, ...] | None:
    """What only one entry may speak of; None for a correction that others may overlap."""
    if isinstance(what, Pin):
        shares = zip(what.corners, what.barycentric, strict=True)
        return "pin", what.frame, frozenset((corner, share) for corner, share in shares if share)
    if isinstance(what, Curve):
        return "curve", what.frame, what.camera, what.chain
    if isinstance(what, Lock | Anchor):
        return what.kind, what.frame
    return None


def _frame_problems(name: str, frame: int, subject: Subject) -> Iterator[str]:
    if frame not in subject.frames:
        last = subject.frames[-1]
        yield f"{name} {frame} is not of the take, which has {subject.frames[0]}..{last}"


def _camera_problems(camera: str, subject: Subject) -> Iterator[str]:
    names = subject.cameras.names
    if camera not in names:
        yield f"no camera {camera!r}; {known_hint(camera, names)}"


def _pixel_problems(camera: str, pixel: Pixel, subject: Subject) -> Iterator[str]:
    yield from _camera_problems(camera, subject)
    if camera in subject.cameras.names:
        seen = subject.cameras.by_name(camera)
        if not (-0.5 <= pixel[0] <= seen.width - 0.5 and -0.5 <= pixel[1] <= seen.height - 0.5):
            yield (
                f"pixel {pixel[0]:g}, {pixel[1]:g} lies outside the image of {camera}, "
                f"{seen.width} x {seen.height} px"
            )


def _weight_problems(weight: float) -> Iterator[str]:
    if not 0.0 < weight <= _MOST_WEIGHT:
        yield f"weight must be above 0 and at most {_MOST_WEIGHT:g}, found {weight:g}"


def _vertex_problems(vertex: int, subject: Subject) -> Iterator[str]:
    if not 0 <= vertex < subject.vertex_count:
        yield f"no vertex {vertex}; the mesh has 0..{subject.vertex_count - 1}"
    elif subject.triangle_of_vertex[vertex] < 0:
        yield f"vertex {vertex} belongs to no polygon of the mesh"


def _pin_problems(pin: Pin, subject: Subject) -> Iterator[str]:
    if len(pin.corners) == 1:
        yield from _vertex_problems(pin.corners[0], subject)
    elif frozenset(pin.corners) not in subject.triangle_of_corners or len(set(pin.corners)) < 3:
        yield (
            f"vertices {', '.join(map(str, pin.corners))} are no triangle of the mesh (quads are "
            "split from their first corner to their third)"
        )
    shares = pin.barycentric
    if not (min(shares) >= 0.0 and abs(sum(shares) - 1.0) <= _SUM):
        yield f"barycentric must be three numbers from 0 to 1 of sum 1, found {list(shares)}"
    if not pin.pixels:
        yield "pixels: at least one camera is needed"
    for camera in sorted(pin.pixels):
        yield from _pixel_problems(camera, pin.pixels[camera], subject)
    yield from _weight_problems(pin.weight)


def _curve_problems(curve: Curve, subject: Subject) -> Iterator[str]:
    if not curve.chain.strip():
        yield "chain: a name is needed"
    if len(set(curve.vertices)) < 2:
        yield f"vertices: a chain of two or more is needed, found {len(set(curve.vertices))}"
    for vertex in dict.fromkeys(curve.vertices):
        yield from _vertex_problems(vertex, subject)
    if len(set(curve.pixels)) < 2:
        yield f"pixels: a line of two or more is needed, found {len(set(curve.pixels))}"
    if curve.camera in subject.cameras.names:
        for pixel in curve.pixels:
            yield from _pixel_problems(curve.camera, pixel, subject)
    yield from _weight_problems(curve.weight)
