"""A visiting take of a photographed head that moves its face, with truth.

    python -m tools.bench.moving_head OUT --shared ../shared [--frames 24] [--size 1024]
        [--expr mouthSmile_L:0.8,browInnerUp_L:1] [--motion 1] [--seed 5] [--relief 1]

Lee Perry-Smith's scan under its photograph (`tools.bench.scan_takes`), moved by expressions of the
ICT face: its mean head is registered to the scan from hand marks, and each place of the scan takes
the motion of the nearest skin that looks the same way, smoothed along the surface over some
millimetres. So its lips part, over the inside of the mouth that the scan has; its eyes are closed.
Expressions come and go by sin^2 and the head moves as in `render_take.py`.

OUT gets cameras.json, `<camera>/0000.png` ..., neutral.obj and truth.npz with vertices (F, V, 3),
faces and face_region, so that score_track.py works on it. The mesh is the scan's own outer one,
before the ears and down the neck, with its long edges halved: every vertex lies on the drawn
surface in every frame, so its place is known exactly.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from capture.archive import read_archive, write_archive
from capture.arrays import Floats, Floats32, Ints, Ints32
from capture.camera import CameraArray
from capture.camera_file import write_cameras
from capture.errors import TakeError, WorkError
from capture.pose import Pose
from capture.progress import Progress, silent
from recon.mesh import Mesh, vertex_normals, write_obj
from recon.surface import Scan
from tools.bench.scan_takes import Head, face_region, load_head, photographs, studio
from track.landmark_file import Landmarks
from track.neutral import NeutralSettings, fit_template
from track.rigid import fit_similarity
from track.surface_match import MatchSurface
from track.visibility import around, count_views

DEFAULT = "mouthSmile_L:0.9,mouthSmile_R:0.7,cheekPuff_L:0.7,browInnerUp_L:0.9,noseSneer_R:0.8"
_HEAD, _HEAD_POLYGONS, _NARROW = 11248, 11144, 6706  # of the ICT head: vertices, quads, face
_MARKS = {  # ICT vertex: where the scan shows it, world mm, by eye from a frontal view
    268: (-60.0, 32.4, 13.5), 2044: (-16.5, 40.0, 39.9),  # brows, ends
    3615: (4.7, 39.6, 43.8), 2509: (54.4, 34.7, 15.1),  # the left one's
    4857: (-4.3, -7.4, 65.8), 1147: (-1.4, -16.0, 53.2),  # nose: tip, base
    1507: (-49.9, 22.5, 18.7), 1528: (-15.5, 26.5, 28.2),  # right eye: corners
    3742: (13.7, 27.8, 27.6), 3721: (48.6, 24.0, 17.2),  # left eye
    5708: (-20.1, -42.0, 40.6), 0: (-1.2, -33.8, 53.9),  # mouth: right corner, upper lip
    6213: (21.7, -42.1, 40.2), 5957: (-1.1, -46.2, 51.6),  # left corner, lower lip
}  # fmt: skip
_NEAR_MM, _FAR_MM = 8.0, 30.0  # whole motion up to here from the ICT skin, none from there on
_ALIKE = 0.4  # least cosine between the scan's normal and that of the skin it follows
_NORMAL_MM, _SMOOTH_MM = 12.0, 3.0
_RINGS = 2
_EDGE_MM = 6.0  # longer edges of the tracked mesh are halved
_SLIVER_MM2 = 0.01
_MARGIN_MM = np.array([1.0, 25.0, 20.0])  # the tracked mesh goes beyond the face by this
_TURN, _SHIFT_MM = np.array([0.05, 0.07, 0.03]), np.array([2.0, 1.5, -2.0])  # as render_take.py


@dataclass(frozen=True, eq=False)
class TrackedMesh:
    """A mesh that rides on a surface.

    Attributes:
        weights: (V, P) csr: each vertex from the surface's P places.
        triangles: (T, 3) int32.
        face: indices of the vertices on the face.
    """

    weights: sparse.csr_matrix
    triangles: Ints32
    face: Ints


def expressions(words: str) -> dict[str, float]:
    """Amounts by name, of `name:amount,name:amount`.

    Raises:
        TakeError: when the words are something else.
    """
    out: dict[str, float] = {}
    for word in filter(None, words.split(",")):
        name, _, amount = word.partition(":")
        try:
            out[name] = float(amount)
        except ValueError as error:
            raise TakeError(f"--expr: expected name:amount, found {word!r}") from error
    return out


def registered(template: Mesh, places: Floats, triangles: Ints32, cameras: CameraArray) -> Floats:
    """The ICT head (V, 3) laid onto the scan, world mm, from hand marks."""
    order = sorted(_MARKS)
    marks = Landmarks(
        vertices=np.array(order),
        positions=np.array([_MARKS[vertex] for vertex in order]),
        miss_mm=np.zeros(len(order)),
    )
    normals = np.nan_to_num(vertex_normals(places, triangles)).astype(np.float32)
    scan = Scan(places.astype(np.float32), triangles, normals, np.ones(len(places), np.float32))
    return fit_template(template, scan, cameras, NeutralSettings(), marks)[0].vertices


def carried_motion(laid: Mesh, deltas: Floats, places: Floats, triangles: Ints32) -> Floats:
    """The motion (P, 3) of a surface that follows a mesh beside it.

    Args:
        laid: the mesh that leads, on the surface.
        deltas: (V, 3) how its vertices move, mm.
        places: (P, 3) of the surface.
        triangles: (T, 3) between them.
    """
    normals = np.nan_to_num(vertex_normals(places, triangles))
    surface = MatchSurface(laid.vertices, laid.triangles, normal_mm=_NORMAL_MM)
    met = surface.match(places, normals)
    moved = np.einsum("nk,nkx->nx", met.barycentric, deltas[met.corners])
    far = np.clip((met.distance_mm - _NEAR_MM) / (_FAR_MM - _NEAR_MM), 0.0, 1.0)
    fade = 1.0 - far * far * (3.0 - 2.0 * far)
    told = np.where((met.cosine > _ALIKE) | (far >= 1.0), 1.0, 1e-3)
    stiff, mass = _cotangents(places, triangles)
    trust = mass * told
    system = sparse.csc_matrix(sparse.diags(trust) + _SMOOTH_MM**2 * stiff)
    smooth: Floats = splu(system).solve((trust * fade)[:, None] * moved)
    return smooth


def head_motion_at(phase: float, strength: float) -> Pose:
    """The head's motion about its middle at a phase 0..1 of the take, that of `render_take.py`."""
    swing = np.sin(np.pi * phase)
    wave = np.array([swing, np.sin(2.0 * np.pi * phase), swing])
    return Pose.from_rotation_vector(_TURN * strength * wave, _SHIFT_MM * strength * swing)


def tracked_mesh(places: Floats, triangles: Ints32) -> TrackedMesh:
    """The outer surface of (P, 3), (T, 3) before the ears, with all of its long edges halved."""
    face = face_region(places)
    low, high = places[face].min(axis=0), places[face].max(axis=0)
    inside = (places > low - _MARGIN_MM).all(axis=1) & (places < high + _MARGIN_MM).all(axis=1)
    outer = count_views(places, triangles, around(places)) > 0
    for _ in range(_RINGS):  # the rims of what is open only while the face moves
        outer[triangles[outer[triangles].any(axis=1)]] = True
    inside &= outer
    kept = _joined_on(places, triangles[inside[triangles].all(axis=1)])
    used, compact = np.unique(kept, return_inverse=True)
    faces = compact.reshape(-1, 3).astype(np.int32)
    count = len(used)
    weights = sparse.csr_matrix((np.ones(count), (np.arange(count), used)), (count, len(places)))
    while True:
        vertices: Floats = np.asarray(weights @ places)
        ends, faces = _halved(vertices, faces)
        if len(ends) == 0:
            break
        weights = sparse.vstack([weights, 0.5 * (weights[ends[:, 0]] + weights[ends[:, 1]])])
        weights = sparse.csr_matrix(weights)
    return TrackedMesh(weights, faces, face_region(vertices))


def moved(head: Head, places: Floats, triangles: Ints32, place: Ints) -> Head:
    """The head with its surface elsewhere: places (P, 3), and which each of its vertices is at."""
    normals = np.nan_to_num(vertex_normals(places, triangles))
    return Head(places[place], normals[place], head.uv, head.triangles, head.texture, head.slopes)


def write_moving_take(
    out: Path,
    head: Head,
    motion: Floats,
    cameras: CameraArray,
    timing: tuple[int, float],
    seed: int,
    *,
    progress: Progress = silent,
) -> None:
    """Write a visiting take, and its truth.

    Args:
        out: the folder.
        head: at rest.
        motion: (P, 3) mm of its places at the height of the expression.
        cameras: who looks.
        timing: how many frames, and how strongly the head moves.
        seed: of lights, gains and noise.
        progress: told after each frame.

    Raises:
        WorkError: when a picture cannot be written.
    """
    frames, strength = timing
    places, triangles = head.surface()
    place = np.unique(head.vertices, axis=0, return_inverse=True)[1].reshape(-1)
    mesh = tracked_mesh(places, triangles)
    truth: list[Floats32] = []
    for frame in range(frames):
        phase = frame / max(frames - 1, 1)
        pose = head_motion_at(phase, strength)
        now = pose.apply(places + np.sin(np.pi * phase) ** 2 * motion)
        truth.append((mesh.weights @ now).astype(np.float32))
        shown = moved(head, now, triangles, place)
        for name, picture in photographs(shown, cameras, seed, frame):
            path = out / name / f"{frame:04d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            if not cv2.imwrite(str(path), picture):
                raise WorkError(f"{path}: cannot be written")
        progress(frame + 1, frames, "render")
    write_cameras(out / "cameras.json", cameras)
    write_obj(out / "neutral.obj", Mesh(truth[0].astype(np.float64), mesh.triangles))
    write_archive(
        out / "truth.npz",
        {"vertices": np.stack(truth), "faces": mesh.triangles, "face_region": mesh.face},
    )


def ict_motion(
    shared: Path, amounts: Mapping[str, float], places: Floats, triangles: Ints32
) -> Floats:
    """What expressions of the ICT face do to the scan: motion (P, 3) of its places, mm.

    Raises:
        TakeError: naming an expression that the ICT face has not.
    """
    wanted = ["neutral", "expr", "expr_names", "quads"]
    ict = read_archive(shared / "data" / "ict" / "ict_light.npz", wanted)
    names = [str(name) for name in ict["expr_names"]]
    missing = [name for name in amounts if name not in names]
    if missing:
        raise TakeError(f"--expr: no {', '.join(missing)}; the ICT face has {', '.join(names)}")
    template = Mesh(10.0 * ict["neutral"][:_HEAD], ict["quads"][:_HEAD_POLYGONS])
    laid = registered(template, places, triangles, studio(64, 0))
    onto = fit_similarity(template.vertices[:_NARROW], laid[:_NARROW], with_scale=True)
    deltas = np.zeros((_HEAD, 3))
    for name, amount in amounts.items():
        deltas += 10.0 * amount * ict["expr"][names.index(name)][:_HEAD]
    turned = onto.scale * deltas @ onto.rotation.T
    return carried_motion(template.with_vertices(laid), turned, places, triangles)


def main() -> None:
    """Render one take."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--shared", type=Path, required=True, help="folder with data/")
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--expr", default=DEFAULT, help="name:amount,... at the height of the take")
    parser.add_argument("--motion", type=float, default=1.0, help="strength of the head's motion")
    parser.add_argument("--size", type=int, default=1024, help="of the square images, px")
    parser.add_argument("--seed", type=int, default=5, help="of cameras, lights, gains and noise")
    parser.add_argument("--relief", type=float, default=1.0, help="strength of the normal map")
    arguments = parser.parse_args()
    head = load_head(arguments.shared / "data" / "lee-perry-smith", arguments.relief)
    motion = ict_motion(arguments.shared, expressions(arguments.expr), *head.surface())
    write_moving_take(
        arguments.out, head, motion, studio(arguments.size, arguments.seed),
        (arguments.frames, arguments.motion), arguments.seed,
    )  # fmt: skip


def _joined_on(places: Floats, triangles: Ints32) -> Ints32:
    """The triangles of the largest piece, without slivers."""
    a, b, c = places[triangles].transpose(1, 0, 2)
    whole = triangles[np.linalg.norm(np.cross(b - a, c - a), axis=1) > _SLIVER_MM2]
    sides = whole[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    graph = sparse.coo_matrix((np.ones(len(sides)), sides.T), (len(places), len(places)))
    piece = connected_components(graph, directed=False)[1][whole[:, 0]]
    joined: Ints32 = whole[piece == np.bincount(piece).argmax()]
    return joined


def _cotangents(places: Floats, triangles: Ints32) -> tuple[sparse.csr_matrix, Floats]:
    """Stiffness (P, P) of the surface, negative cotangents left out, and its mass (P,), mm^2."""
    count = len(places)
    mass = np.full(count, 1e-6)
    ends, weights = [], []
    for k in range(3):
        a, b, c = (triangles[:, (k + turn) % 3] for turn in range(3))
        one, other = places[a] - places[c], places[b] - places[c]
        double = np.linalg.norm(np.cross(one, other), axis=1)
        mass += np.bincount(c, double / 6.0, minlength=count)
        weights += [0.5 * np.clip((one * other).sum(axis=1) / np.maximum(double, 1e-9), 0.0, 10.0)]
        ends += [np.stack([a, b])]
    both = np.concatenate(ends, axis=1)
    half = sparse.coo_matrix((np.concatenate(weights), both), (count, count))
    pull = sparse.csr_matrix(half + half.T)
    total = np.asarray(pull.sum(axis=1)).ravel()
    return sparse.csr_matrix(sparse.diags(total) - pull), mass


def _halved(vertices: Floats, triangles: Ints32) -> tuple[Ints, Ints32]:
    """Halve every edge over the limit: the ends (E, 2) of those halved, and the triangles then."""
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, inverse = np.unique(sides, axis=0, return_inverse=True)
    long = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1) > _EDGE_MM
    number = np.where(long, len(vertices) + np.cumsum(long) - 1, -1)
    out: list[tuple[int, int, int]] = []
    cuts = number[inverse.reshape(-1, 3)]
    for corners, middles in zip(triangles.tolist(), cuts.tolist(), strict=True):
        out += _pieces(corners, middles)
    return edges[long], np.array(out, dtype=np.int32)


def _pieces(corners: list[int], middles: list[int]) -> list[tuple[int, int, int]]:
    """A triangle in pieces; `middles` of its sides ab, bc, ca are -1 where not halved."""
    count = sum(middle >= 0 for middle in middles)
    for _ in range(3):  # turn it so that a lone middle is on ab, a lone whole side is ca
        first = middles[0] >= 0
        if count in (0, 3) or (first and (count == 1 or middles[2] < 0)):
            break
        corners, middles = corners[1:] + corners[:1], middles[1:] + middles[:1]
    (a, b, c), (ab, bc, ca) = corners, middles
    if count == 0:
        return [(a, b, c)]
    if count == 1:
        return [(a, ab, c), (ab, b, c)]
    if count == 2:
        return [(a, ab, c), (ab, bc, c), (ab, b, bc)]
    return [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]


if __name__ == "__main__":
    main()
