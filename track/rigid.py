"""The best rigid or similarity motion between corresponding points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.arrays import Floats, check_finite, check_shape
from capture.errors import SolveError

_FLAT = 1e-9  # second spread over first, below which points lie on one line


@dataclass(frozen=True, eq=False, kw_only=True)
class Similarity:
    """A rotation, a uniform scale and a translation: `scale * rotation @ x + translation`.

    Attributes:
        rotation: (3, 3) float64 proper rotation.
        translation: (3,) float64, mm of the target space.
        scale: target mm for each source mm.
    """

    rotation: Floats
    translation: Floats
    scale: float = 1.0

    def apply(self, points: Floats) -> Floats:
        """Move points (..., 3)."""
        moved: Floats = self.scale * (points @ self.rotation.T) + self.translation
        return moved

    def after(self, first: Similarity) -> Similarity:
        """The motion that does `first` and then this one."""
        return Similarity(
            rotation=self.rotation @ first.rotation,
            translation=self.apply(first.translation),
            scale=self.scale * first.scale,
        )

    def matrix(self) -> Floats:
        """The (4, 4) homogeneous matrix."""
        out = np.eye(4)
        out[:3, :3] = self.scale * self.rotation
        out[:3, 3] = self.translation
        return out


def fit_similarity(
    source: Floats, target: Floats, weights: Floats | None = None, *, with_scale: bool = False
) -> Similarity:
    """Solve the weighted absolute orientation problem in closed form (Procrustes).

    Minimises sum_n weights_n |scale * rotation @ source_n + translation - target_n|^2.

    Args:
        source: (N, 3) points, mm.
        target: (N, 3) the same points in the target space, mm.
        weights: (N,) non-negative; None weighs all alike.
        with_scale: solve for a uniform scale too; otherwise it is 1.

    Raises:
        ShapeError: when shapes do not agree or a number is not finite.
        SolveError: when the weighted points do not span at least a plane.

    References:
        Umeyama 1991, "Least-squares estimation of transformation parameters between two point
        patterns", Eqs. 40-43.
    """
    used = np.ones(len(source)) if weights is None else weights
    check_shape(source=(source, "N 3"), target=(target, "N 3"), weights=(used, "N"))
    check_finite(source=source, target=target, weights=used)
    total = float(used.sum())
    if not total > 0.0:
        raise SolveError(f"rigid fit: expected positive weights, found a sum of {total}")
    share = (used / total)[:, None]
    source_mean, target_mean = (share * source).sum(axis=0), (share * target).sum(axis=0)
    from_mean, to_mean = source - source_mean, target - target_mean
    u, spread, vt = np.linalg.svd((share * to_mean).T @ from_mean)
    if not spread[1] > _FLAT * spread[0]:
        raise SolveError(
            f"rigid fit: {int((used > 0).sum())} points lie on one line; a rotation needs three "
            "points off a line"
        )
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    scale = 1.0
    if with_scale:
        scale = float((spread * sign).sum() / (share * from_mean**2).sum())
    return Similarity(
        rotation=rotation,
        translation=target_mean - scale * rotation @ source_mean,
        scale=scale,
    )


def nearest_rotations(matrices: Floats) -> Floats:
    """The rotation (..., 3, 3) nearest to each matrix (..., 3, 3) in the Frobenius norm."""
    u, _, vt = np.linalg.svd(matrices)
    flip = np.linalg.det(u @ vt) < 0.0
    u[..., :, 2] = np.where(flip[..., None], -u[..., :, 2], u[..., :, 2])
    rotations: Floats = u @ vt
    return rotations
