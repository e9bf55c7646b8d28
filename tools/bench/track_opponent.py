"""What tracking has to beat: pyramidal Lucas-Kanade from the first frame, a hundred lines.

    python -m tools.bench.track_opponent TAKE PERFORMANCE.npz

TAKE is a visiting take with cameras.json and neutral.obj. Each vertex that a view sees at the first
frame is followed by `cv2.calcOpticalFlowPyrLK` from the first frame to every other one, beginning
where the last frame had it; a match that does not return to its start is dropped. Vertices are
triangulated from all views robustly, and one Laplacian solve a frame, reweighted where vertices
leave it, carries the rest. Windows, limits and stiffness are a compromise of about 25 settings
tried on takes/dev-smile and the photographed head (`tools.bench.moving_head`): none was best on
both. Of our tracking it uses the triangulation, the solver and the visibility.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.arrays import Bools, Floats, Floats32, Ints32
from capture.camera import Camera
from capture.take import Take
from recon.images import mono
from recon.mesh import Mesh, read_obj
from recon.visiting import import_take
from track.laplacian import Constraints, LaplacianDeformer, Stiffness
from track.lift import Observations, merged, triangulate
from track.performance import Performance, write_performance
from track.raster import Rasterizer
from track.reference import facing_normals, visible_samples
from track.surface_samples import sample_surface

Picture = NDArray[np.uint8]
_WINDOW, _LEVELS = (13, 13), 3
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)
_RETURN_PX = 0.3
_COSINE = 0.35
_ROUNDS = 3  # of linearising the projection
_SCALE_PX, _PRIOR_MM = 0.7, 5.0
_BENDING_MM = 3.0
_TRUST = np.array([0.0, 0.01, 0.2, 1.0])  # by how many views agree on a vertex; more are as three
_REWEIGHTED, _AWAY_MM = (
    3,
    0.3,
)  # solves, and the distance at which a vertex has lost most of its say


@dataclass(frozen=True, eq=False)
class _View:
    """What one view showed of the neutral."""

    camera: Camera
    picture: Picture
    vertices: Ints32
    pixels: Floats32


class Opponent:
    """Follows a mesh from the first frame's pictures.

    Args:
        neutral: on the skin at the first frame.
        cameras: by device name.
        pictures: of the first frame, by device name.
    """

    def __init__(
        self, neutral: Mesh, cameras: Mapping[str, Camera], pictures: Mapping[str, Picture]
    ) -> None:
        vertices, triangles = neutral.vertices, neutral.triangles
        samples = sample_surface(vertices, triangles, 1e9)  # the vertices alone
        normals = facing_normals(vertices, triangles)
        raster = Rasterizer(triangles, len(vertices))
        self._views: dict[str, _View] = {}
        for name, picture in pictures.items():
            drawn = raster.render(cameras[name], vertices)
            seen = visible_samples(samples, vertices, normals, cameras[name], drawn, _COSINE)
            own = samples.corners[seen, samples.barycentric[seen].argmax(axis=1)]
            pixels = cameras[name].project(vertices[own]).astype(np.float32)
            self._views[name] = _View(cameras[name], picture, own.astype(np.int32), pixels)
        self._deformer = LaplacianDeformer(vertices, triangles, Stiffness(bending_mm=_BENDING_MM))
        self._pool = ThreadPoolExecutor(2)

    def follow(self, last: Floats, pictures: Mapping[str, Picture]) -> tuple[Floats, Floats]:
        """The mesh (V, 3) in a frame, and confidence (V,), beginning from the last frame's mesh."""
        names = [name for name in self._views if name in pictures]

        def matched(name: str) -> tuple[Floats, Bools]:
            return _tracked(self._views[name], last, pictures[name])

        found = dict(zip(names, self._pool.map(matched, names), strict=True))
        points, weights = last.copy(), np.zeros(len(last))
        for _ in range(_ROUNDS):
            parts = [_observed(self._views[name], points, *found[name]) for name in names]
            lifted = triangulate(merged(parts), len(last), _SCALE_PX, _PRIOR_MM)
            points = points + lifted.motion
            weights = _TRUST[np.minimum(lifted.views, 3)]
        return self._solved(last, points, weights), weights

    def _solved(self, last: Floats, points: Floats, weights: Floats) -> Floats:
        """The mesh through points (V, 3), those that leave it weighing less and less."""
        used = np.flatnonzero(weights)
        if len(used) < 12:
            return last
        out, now = last, weights[used]
        for _ in range(_REWEIGHTED):
            constraints = Constraints(
                corners=np.repeat(used[:, None], 3, axis=1),
                barycentric=np.tile([1.0, 0.0, 0.0], (len(used), 1)),
                targets=points[used],
                weights=now,
            )
            out = self._deformer.solve(constraints, start=out)
            away = np.linalg.norm(out[used] - points[used], axis=1)
            now = weights[used] / (1.0 + (away / _AWAY_MM) ** 2) ** 2
        return out


def follow_take(take: Take, neutral: Mesh) -> Performance:
    """Follow the neutral through all frames of a take that has cameras."""
    cameras = {camera.name: camera for camera in take.cameras()}
    first, *rest = take.frames
    opponent = Opponent(neutral, cameras, _pictures(take, first))
    frames = [(neutral.vertices, np.ones(len(neutral.vertices)))]
    for frame in rest:
        frames.append(opponent.follow(frames[-1][0], _pictures(take, frame)))
    return Performance(
        vertices=np.stack([vertices for vertices, _ in frames]).astype(np.float32),
        confidence=np.stack([confidence for _, confidence in frames]).astype(np.float32),
        polygons=neutral.polygons,
        frames=np.array(take.frames, dtype=np.int64),
        head_from_neutral=np.tile(np.eye(4), (len(frames), 1, 1)),
        reference=np.full(len(frames), -1, dtype=np.int64),
    )


def lucas_kanade(
    one: Picture, other: Picture, pixels: Floats32, guess: Floats32
) -> tuple[Floats32, Bools]:
    """Where pixels (M, 2) of one picture are in another, from a guess, and which were found."""
    found, good, _ = cv2.calcOpticalFlowPyrLK(
        one, other, pixels, guess.copy(), winSize=_WINDOW, maxLevel=_LEVELS, criteria=_STOP,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return np.asarray(found, np.float32), np.asarray(good).ravel() == 1


def main(arguments: Sequence[str] | None = None) -> None:
    """Follow one visiting take and write the performance."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("take", type=Path, help="a visiting take with neutral.obj")
    parser.add_argument("performance", type=Path, help="file to write")
    options = parser.parse_args(arguments)
    with TemporaryDirectory() as folder:
        take = import_take(options.take, Path(folder) / "take")
        write_performance(options.performance, follow_take(take, read_obj(take.neutral())))


def _pictures(take: Take, frame: int) -> dict[str, Picture]:
    names = [name for name in take.device_names if take.present(name, frame)]
    return {name: np.rint(255.0 * mono(take.image(name, frame))).astype(np.uint8) for name in names}


def _tracked(view: _View, last: Floats, picture: Picture) -> tuple[Floats, Bools]:
    """Where LK finds the view's vertices (M, 2), and whether each is to be believed."""
    guess = view.camera.project(last[view.vertices]).astype(np.float32)
    guess = np.where(np.isfinite(guess), guess, view.pixels)
    found, good = lucas_kanade(view.picture, picture, view.pixels, guess)
    back, returned = lucas_kanade(picture, view.picture, found, view.pixels)
    miss = np.linalg.norm(back - view.pixels, axis=1)
    believed: Bools = good & returned & (miss < _RETURN_PX)
    return found.astype(np.float64), believed


def _observed(view: _View, points: Floats, found: Floats, believed: Bools) -> Observations:
    which = view.vertices[believed]
    return Observations(
        sample=which,
        offset=found[believed] - view.camera.project(points[which]),
        jacobian=view.camera.project_jacobian(points[which]),
        information=np.tile([1.0, 0.0, 1.0], (len(which), 1)),
    )


if __name__ == "__main__":
    main()
