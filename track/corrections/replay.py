"""Corrections as tracking uses them: what concerns each frame."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from capture.arrays import Floats, Ints32
from capture.take import Take
from recon.mesh import Mesh
from track.corrections.checks import Subject
from track.corrections.curves import CurveSightings
from track.corrections.entries import (
    Anchor,
    Correction,
    Curve,
    FrameExclusion,
    Lock,
    Pin,
    ViewExclusion,
)
from track.corrections.sidecar import LockedFrame, read_book, read_locked
from track.sightings import Sightings
from track.surface_samples import SurfaceSamples

PIN_WEIGHT = 100.0
"""Of an ordinary pin against a good sample of the flow."""
CURVE_WEIGHT = 20.0
"""Of a vertex of an ordinary curve against a good sample of the flow."""
_PIN_PX, _CURVE_PX = 0.25, 0.5  # standard deviations of a hand
_NEVER_DOUBTED_PX = 1000.0  # what an artist says is no outlier, however far from the estimate
_FIXING_VIEWS = 2  # that leave a point no freedom
_HALF_FIXED = 0.5  # confidence in a point that one view or a curve speaks of
_NONE = "none"


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameCorrections:
    """What concerns one frame.

    Attributes:
        frame: which.
        sightings: pins, and curves whose pixels follow the estimate.
        excluded_views: names of cameras not to be looked at.
        locked: what the frame is and stays; nothing is solved then.
        excluded: the frame is to be interpolated between its neighbours; never so when locked.
        anchor: others may be matched to this frame.
        kinds: of all that concerns it, "pin" or "exclude_view" say, each once; none: the frame is
            as it was tracked.
    """

    frame: int
    sightings: tuple[Sightings, ...]
    excluded_views: frozenset[str]
    locked: LockedFrame | None
    excluded: bool
    anchor: bool
    kinds: tuple[str, ...]

    def assured(self, vertex_count: int) -> Floats:
        """How far pins and curves vouch for each vertex, (V,) 0..1, whatever the images say.

        1 at a vertex that is pinned in two views or more, half of that where one view pins it or a
        curve passes; a point inside a triangle shares it out among the corners.
        """
        out = np.zeros(vertex_count)
        for sighted in self.sightings:
            views = np.bincount(sighted.point, minlength=len(sighted.surface))
            sure = np.where(views >= _FIXING_VIEWS, 1.0, _HALF_FIXED)
            np.maximum.at(out, sighted.surface.corners, sure[:, None] * sighted.surface.barycentric)
        return out


class Corrections:
    """The corrections of a take, by frame; their order in the file says nothing.

    Args:
        subject: the take and mesh that they fit.
        corrections: as read; none by default.
        locked: by frame, what each locked one is.
    """

    def __init__(
        self,
        subject: Subject,
        corrections: Iterable[Correction] = (),
        locked: Mapping[int, LockedFrame] | None = None,
    ) -> None:
        self._subject, self._locked = subject, dict(locked or {})
        self._every = sorted(corrections, key=_words)

    def __len__(self) -> int:
        return len(self._every)

    @property
    def anchors(self) -> tuple[int, ...]:
        """Frames marked as anchors, ascending."""
        return tuple(sorted(what.frame for what in self._every if isinstance(what, Anchor)))

    @property
    def locked(self) -> tuple[int, ...]:
        """Locked frames, ascending."""
        return tuple(sorted(what.frame for what in self._every if isinstance(what, Lock)))

    @property
    def excluded(self) -> tuple[int, ...]:
        """Frames to be interpolated, ascending; locked ones are not."""
        frames = {
            frame
            for what in self._every
            if isinstance(what, FrameExclusion)
            for frame in range(what.first, what.last + 1)
        }
        return tuple(sorted(frames - set(self.locked)))

    def for_frame(self, frame: int) -> FrameCorrections:
        """What concerns a frame."""
        own = list(self._of(frame))
        pins = [what for what in own if isinstance(what, Pin)]
        curves = [what for what in own if isinstance(what, Curve)]
        locked = any(isinstance(what, Lock) for what in own)
        return FrameCorrections(
            frame=frame,
            sightings=(
                *(
                    _pinned([pin for pin in pins if pin.weight == weight], self._subject)
                    for weight in sorted({pin.weight for pin in pins})
                ),
                *(_drawn(curve, self._subject) for curve in curves),
            ),
            excluded_views=frozenset(
                what.camera for what in own if isinstance(what, ViewExclusion)
            ),
            locked=self._locked[frame] if locked else None,
            excluded=any(isinstance(what, FrameExclusion) for what in own) and not locked,
            anchor=any(isinstance(what, Anchor) for what in own),
            kinds=tuple(sorted({what.kind for what in own})),
        )

    def key(self, frame: int) -> str:
        """A hash of all that concerns a frame; "none" where nothing does.

        Ids, remarks and the order of entries are not in it; a range that covers the frame counts
        only as far as that frame is concerned.
        """
        words = sorted({_words(_at(what, frame)) for what in self._of(frame)})
        if not words:
            return _NONE
        return hashlib.sha256("\n".join(words).encode()).hexdigest()

    def _of(self, frame: int) -> Iterator[Correction]:
        for what in self._every:
            if isinstance(what, ViewExclusion | FrameExclusion):
                if what.first <= frame <= what.last:
                    yield what
            elif what.frame == frame:
                yield what


def read_corrections(take: Take, mesh: Mesh) -> Corrections:
    """Read TAKE/corrections.json and the locked frames beside it; a take without it has none.

    Args:
        take: it needs cameras.
        mesh: that is tracked through it; only its polygons matter.

    Raises:
        CameraError: when the take has no cameras, or they do not fit.
        TakeError: listing everything in the file that does not fit, by its place; or naming the
            locked frame whose vertices are gone or changed.
    """
    subject = Subject.of(take, mesh)
    every = [entry.what for entry in read_book(take.folder, subject).entries]
    locked = {
        what.frame: read_locked(take.folder, what, subject.vertex_count)
        for what in every
        if isinstance(what, Lock)
    }
    return Corrections(subject, every, locked)


def _words(what: Correction) -> str:
    return json.dumps({"kind": what.kind, **what.table()}, sort_keys=True)


def _at(what: Correction, frame: int) -> Correction:
    """A correction as one frame knows it: ranges end at that frame."""
    if isinstance(what, ViewExclusion):
        return ViewExclusion(camera=what.camera, first=frame, last=frame)
    if isinstance(what, FrameExclusion):
        return FrameExclusion(first=frame, last=frame)
    return what


def _pinned(pins: Sequence[Pin], subject: Subject) -> Sightings:
    """Pins of one weight."""
    cameras = tuple(sorted({name for pin in pins for name in pin.pixels}))
    seen = [
        (point, cameras.index(name), pin.pixels[name])
        for point, pin in enumerate(pins)
        for name in sorted(pin.pixels)
    ]
    return Sightings(
        surface=_surface([(pin.corners, pin.barycentric) for pin in pins], subject),
        cameras=cameras,
        point=np.array([point for point, _, _ in seen], dtype=np.int32),
        view=np.array([view for _, view, _ in seen], dtype=np.int32),
        pixel=np.array([pixel for _, _, pixel in seen]),
        information=np.tile([_PIN_PX**-2, 0.0, _PIN_PX**-2], (len(seen), 1)),
        scale_px=_NEVER_DOUBTED_PX,
        accuracy_px=0.0,
        weight=PIN_WEIGHT * pins[0].weight,
    )


def _drawn(curve: Curve, subject: Subject) -> CurveSightings:
    chain = tuple(dict.fromkeys(curve.vertices))  # a closed chain may name its first again
    count = len(chain)
    line = np.array(curve.pixels, dtype=np.float64)
    return CurveSightings(
        surface=_surface([((vertex,), (1.0,)) for vertex in chain], subject),
        cameras=(curve.camera,),
        point=np.arange(count, dtype=np.int32),
        view=np.zeros(count, dtype=np.int32),
        pixel=np.tile(line[0], (count, 1)),
        information=np.zeros((count, 3)),
        scale_px=_NEVER_DOUBTED_PX,
        accuracy_px=0.0,
        weight=CURVE_WEIGHT * curve.weight,
        line=line,
        sigma_px=_CURVE_PX,
    )


def _surface(
    points: Sequence[tuple[tuple[int, ...], tuple[float, ...]]], subject: Subject
) -> SurfaceSamples:
    """Points, each of one vertex or three and their weights, in the mesh's own triangles."""
    triangle = np.empty(len(points), dtype=np.int32)
    shares: Floats = np.zeros((len(points), 3))
    for n, (corners, weights) in enumerate(points):
        if len(corners) == 1:
            triangle[n] = subject.triangle_of_vertex[corners[0]]
        else:
            triangle[n] = subject.triangle_of_corners[frozenset(corners)]
        own: list[int] = subject.triangles[triangle[n]].tolist()
        for corner, weight in zip(corners, weights, strict=True):
            shares[n, own.index(corner)] = weight
    corners_of: Ints32 = subject.triangles[triangle]
    return SurfaceSamples(triangle=triangle, corners=corners_of, barycentric=shares)
