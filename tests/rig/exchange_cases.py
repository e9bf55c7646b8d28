"""Small rigs, performances and weights for the export tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from capture.archive import write_archive
from capture.pose import Pose
from rig.face_rig import FaceRig, write_rig
from rig.template import Template, write_template
from track.performance import Performance, write_performance

NAMES = ("jawOpen", "mouthSmile_L", "still", "left wing")


def sheet(columns: int = 7, rows: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """A curved sheet of quads and two triangles: vertices (V, 3) in mm, polygons (P, 4)."""
    x, y = np.meshgrid(np.linspace(-70, 70, columns), np.linspace(-90, 90, rows))
    z = 60.0 - 0.01 * x**2 - 0.005 * y**2
    index = np.arange(columns * rows).reshape(rows, columns)
    corners = [index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]]
    quads = np.stack([corner.ravel() for corner in corners], axis=1)
    split = np.array([[*quads[-1, :3], -1], [quads[-1, 0], *quads[-1, 2:], -1]])
    polygons = np.concatenate([quads[:-1], split]).astype(np.int32)
    return np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(np.float32).astype(float), polygons


def posed_rig(names: tuple[str, ...] = NAMES, frames: int = 5) -> FaceRig:
    """A rig of four sparse shapes - one moves nothing - with five frames of motion."""
    rng = np.random.default_rng(8)
    neutral, polygons = sheet()
    deltas = np.zeros((4, len(neutral), 3))
    deltas[0, :10] = rng.normal(0.0, 4.0, (10, 3))
    deltas[1, 20:23] = rng.normal(0.0, 4.0, (3, 3))
    deltas[1, 30] = [0.0, 1.5, 0.0]
    deltas[3, 5:25:2] = rng.normal(0.0, 4.0, (10, 3))
    axis = np.array([0.03, 0.1, -0.02])
    motion = [
        Pose.from_rotation_vector(frame * axis, 7.0 * rng.normal(size=3)).matrix()
        for frame in range(frames)
    ]
    return FaceRig(
        neutral=neutral,
        deltas=deltas.astype(np.float32).astype(float),
        names=names,
        polygons=polygons,
        weights=rng.uniform(0.0, 1.0, (frames, 4)),
        head_from_rig=np.stack(motion),
    )


def rig_file(folder: Path, names: tuple[str, ...] = NAMES) -> Path:
    """`posed_rig` on disk."""
    write_rig(folder / "rig.npz", posed_rig(names))
    return folder / "rig.npz"


def template_file(folder: Path) -> Path:
    """The same shapes as a template."""
    rig = posed_rig()
    template = Template(
        neutral=rig.neutral, deltas=rig.deltas, names=rig.names, polygons=rig.polygons
    )
    write_template(folder / "template.npz", template)
    return folder / "template.npz"


def performance_file(folder: Path) -> Path:
    """Three frames of the rig as a tracked performance, numbered 4, 6, 7."""
    rig = posed_rig()
    vertices = np.stack([rig.evaluate(frame) for frame in range(3)]).astype(np.float32)
    rng = np.random.default_rng(9)
    performance = Performance(
        vertices=vertices,
        confidence=rng.uniform(0.0, 1.0, vertices.shape[:2]).astype(np.float32),
        polygons=rig.polygons,
        frames=np.array([4, 6, 7]),
        head_from_neutral=rig.head_from_rig[:3],
        reference=np.array([-1, -1, 4]),
    )
    write_performance(folder / "performance.npz", performance)
    return folder / "performance.npz"


def weights_file(folder: Path, stamped: bool = False) -> Path:
    """Weights of three frames, 40 ms apart when stamped."""
    rng = np.random.default_rng(10)
    arrays = {"weights": rng.uniform(0.0, 1.0, (3, 4)), "names": np.array(NAMES)}
    if stamped:
        arrays["t_ns"] = 1_000_000_007 + 40_000_000 * np.arange(3)
    write_archive(folder / "weights.npz", arrays)
    return folder / "weights.npz"
