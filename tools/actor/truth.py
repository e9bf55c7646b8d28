"""The truth of a simulated face take, written where no stage looks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from capture.archive import write_archive
from capture.arrays import Ints
from capture.camera import CameraArray
from capture.camera_file import write_cameras
from tools.actor.scene import ActorScene


def write_truth(
    folder: Path,
    scene: ActorScene,
    cameras: CameraArray,
    times_ns: Ints,
    depth_frames: Sequence[int] = (),
) -> None:
    """Write what a face take truly showed.

    ::

        FOLDER/truth.npz         vertices (F,V,3) float32 world mm, faces (P,4), weights (F,B),
                                 names (B), R (F,3,3) and t (F,3) world_from_head,
                                 landmarks68 (68), face_region, surface (F,Vp,3) eyes and teeth,
                                 surface_tri (T,3) over skin then surface, rigid_vertices,
                                 lid_pairs, lip_pairs, t_ns (F)
        FOLDER/cameras.json      the true cameras
        FOLDER/depth_0000.npz    for chosen frames: camera-space Z (H,W) float32 mm by camera
                                 name, 0 where there is no actor

    Args:
        folder: the truth folder of the take.
        scene: what was played.
        cameras: the true array.
        times_ns: (F,) true times of the frames.
        depth_frames: frames whose depth maps are written.
    """
    model = scene.model
    posed = [scene.truth(int(t_ns)) for t_ns in times_ns]
    write_archive(folder / "truth.npz", {
        "vertices": np.stack([one.skin for one in posed]).astype(np.float32),
        "faces": model.neutral.polygons,
        "weights": np.stack([one.weights for one in posed]),
        "names": np.array(model.names),
        "R": np.stack([one.head.rotation for one in posed]),
        "t": np.stack([one.head.translation for one in posed]),
        "landmarks68": model.landmarks68,
        "face_region": model.face_region,
        "surface": np.stack([np.concatenate(one.parts) for one in posed]).astype(np.float32),
        "surface_tri": model.surface_triangles,
        "rigid_vertices": model.rigid_vertices,
        "lid_pairs": model.lid_pairs,
        "lip_pairs": model.lip_pairs,
        "t_ns": np.asarray(times_ns, dtype=np.int64),
    })  # fmt: skip
    write_cameras(folder / "cameras.json", cameras)
    renderer = scene.face_renderer()
    for frame in depth_frames:
        depths = {camera.name: renderer.depth(camera, posed[frame]) for camera in cameras}
        filled = {name: np.nan_to_num(depth, nan=0.0) for name, depth in depths.items()}
        write_archive(folder / f"depth_{frame:04d}.npz", filled)
