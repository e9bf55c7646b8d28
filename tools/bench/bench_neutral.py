"""Neutral registration of the ICT mean head to other identities, against placement alone.

Example: python -m tools.bench.bench_neutral --seeds 3 11 12 --noise-mm 0.05
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from capture.arrays import Floats, Ints
from recon.mesh import Mesh, vertex_normals
from recon.surface import closest_points
from tools.bench.neutral_scene import arc_cameras, misplaced, scan_of
from track.neutral import NeutralSettings, fit_template
from track.rigid import Similarity

_SHARED = Path(__file__).resolve().parents[2].parent / "shared"
_ICT = _SHARED / "data" / "ict" / "ict_light.npz"
_MARKS = _SHARED / "takes" / "dev-smile" / "truth.npz"
_HEAD, _FACE, _SURFACE = (
    11248,
    6706,
    24591,
)  # vertices: head and neck, narrow face, all but eyes' wet


def ict_actor(seed: int, strength: float = 0.8) -> Floats:
    """The vertices of a random ICT identity, mm, as the take renderer of ../shared draws them."""
    with np.load(_ICT) as data:
        rng = np.random.default_rng(seed)
        weights = rng.normal(0.0, strength, 100) * np.exp(-np.arange(100) / 25.0)
        actor: Floats = 10.0 * (data["neutral"] + np.einsum("k,kij->ij", weights, data["identity"]))
    return actor


def ict_template() -> tuple[Mesh, np.ndarray[tuple[int, ...], np.dtype[np.int32]]]:
    """The mean head, quads, mm; and the triangles of the whole model but its outer eyes."""
    with np.load(_ICT) as data:
        triangles = data["tri"]
        whole = triangles[(triangles < _SURFACE).all(axis=1)].astype(np.int32)
        return Mesh(10.0 * data["neutral"][:_HEAD], data["quads"][:11144]), whole


def measure(seed: int, noise_mm: float, angle_deg: float) -> dict[str, float]:
    """Errors of one identity, mm.

    Of all the narrow face: `placed`, `corr`, `tangent`, and `face95`, the distance to the true
    surface; `surf` is that distance over what cameras see. `marks`: lips, lids, brows, nose.
    """
    template, whole = ict_template()
    actor = ict_actor(seed)
    cameras = arc_cameras(actor[:9409].mean(axis=0))
    scan = scan_of((actor, whole), cameras, noise_mm=noise_mm, seed=seed)
    start = misplaced(template, seed, angle_deg=angle_deg)
    begin = time.process_time()
    mesh, report, fit = fit_template(start, scan, cameras, NeutralSettings())
    seconds = time.process_time() - begin
    placed = np.array(report["world_from_template"])
    motion = Similarity(rotation=placed[:3, :3], translation=placed[:3, 3])
    only = motion.apply(start.vertices)
    gap = _gap(mesh.vertices, actor)
    _, _, surface = closest_points(actor, whole, mesh.vertices[:_FACE][fit.seen[:_FACE]])
    _, _, whole_face = closest_points(actor, whole, mesh.vertices[:_FACE])
    normals = vertex_normals(actor[:_HEAD], template.triangles)[:_FACE]
    along = np.einsum("vx,vx->v", mesh.vertices[:_FACE] - actor[:_FACE], normals)
    return {
        "placed": float(np.median(_gap(only, actor))),
        "corr": float(np.median(gap)),
        "corr95": float(np.quantile(gap, 0.95)),
        "tangent": float(np.median(np.sqrt(np.maximum(gap**2 - along**2, 0.0)))),
        "surf": float(np.median(surface)),
        "surf95": float(np.quantile(surface, 0.95)),
        "face95": float(np.quantile(whole_face, 0.95)),
        "marks": float(np.median(_gap(mesh.vertices, actor, _landmarks()))),
        "cpu_s": seconds,
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[3, 11, 12])
    parser.add_argument("--noise-mm", type=float, default=0.0)
    parser.add_argument("--angle-deg", type=float, default=20.0)
    options = parser.parse_args()
    rows: list[dict[str, float]] = []
    for seed in options.seeds:
        row = measure(seed, options.noise_mm, options.angle_deg)
        if not rows:
            print("seed  " + "  ".join(f"{name:>8}" for name in row))
        print(f"{seed:4d}  " + "  ".join(f"{value:8.3f}" for value in row.values()), flush=True)
        rows.append(row)
    middle = {name: float(np.median([row[name] for row in rows])) for name in rows[0]}
    print(f"{'mid':>4}  " + "  ".join(f"{value:8.3f}" for value in middle.values()))
    print(f"correspondence against placement alone: {middle['corr'] / middle['placed']:.2f}")


def _gap(vertices: Floats, actor: Floats, chosen: Ints | None = None) -> Floats:
    which = np.arange(_FACE) if chosen is None else chosen
    gap: Floats = np.linalg.norm(vertices[which] - actor[which], axis=1)
    return gap


def _landmarks() -> Ints:
    """Vertices of lips, lids, brows and nose, as a take of ../shared names them."""
    with np.load(_MARKS) as data:
        return np.asarray(data["landmarks68"], dtype=np.int64)[17:]


if __name__ == "__main__":
    main()
