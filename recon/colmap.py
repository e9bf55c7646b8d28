"""The seam to COLMAP: models in and out, and bundle adjustment of an array in the board's frame.

The only module that imports pycolmap, but for a bench that has its fusion as an opponent. COLMAP
puts the centre of the first pixel at 0.5, we put it at 0: that half pixel is added to keypoints and
principal points on the way in, taken away on the way out, here and nowhere else.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pycolmap

from capture.arrays import Floats, Ints
from capture.camera import Camera, CameraArray
from capture.errors import CameraError, SolveError, raise_all
from capture.pose import Pose
from capture.product import replacing
from recon.array_state import ArrayState
from recon.observations import BoardObservations

_HALF_PIXEL = 0.5
_PARAMETERS = {  # where fx fy cx cy k1 k2 p1 p2 stand among each model's parameters; None is 0
    "SIMPLE_PINHOLE": (0, 0, 1, 2, None, None, None, None),
    "PINHOLE": (0, 1, 2, 3, None, None, None, None),
    "SIMPLE_RADIAL": (0, 0, 1, 2, 3, None, None, None),
    "RADIAL": (0, 0, 1, 2, 3, 4, None, None),
    "OPENCV": (0, 1, 2, 3, 4, 5, 6, 7),
    "FULL_OPENCV": (0, 1, 2, 3, 4, 5, 6, 7),
}
_MODEL_FILES = ("cameras", "images", "points3D")
_SAME_PLACE = 1e-6  # two images of one camera must agree on its pose to this
_VENDOR = (ValueError, RuntimeError, IndexError, KeyError, TypeError)


@dataclass(frozen=True, kw_only=True)
class AdjustOptions:
    """What a bundle adjustment may move, and how it weighs what does not fit.

    Attributes:
        loss_px: scale of the Cauchy loss; 0 means plain least squares.
        free_lenses: focal lengths, principal points and distortion.
        free_principal_points: principal points (only with free lenses).
        free_cameras: where the devices stand in the array.
        free_board: the board's shape, three corners of it held.
        iterations: at most this many steps.
    """

    loss_px: float = 0.5
    free_lenses: bool = True
    free_principal_points: bool = True
    free_cameras: bool = True
    free_board: bool = False
    iterations: int = 60


@dataclass(frozen=True, eq=False)
class Adjustment:
    """What a bundle adjustment found.

    Attributes:
        state: the adjusted array.
        converged: whether the solver met its own stopping rule.
    """

    state: ArrayState
    converged: bool


def adjust_array(
    state: ArrayState, observations: BoardObservations, options: AdjustOptions
) -> Adjustment:
    """Adjust lenses, places, board poses and board shape until corners project where seen.

    A moving board before a static array is a static board before a moving array: one COLMAP rig of
    C sensors, one frame a board pose, and the corners as the points all frames share.

    Args:
        state: the estimate to start from.
        observations: corner sightings; every pose used must have a pose in `state`.
        options: what may move.

    Raises:
        SolveError: when the solver fails or returns something that is not an array.

    References:
        Triggs et al. 2000, Bundle Adjustment - A Modern Synthesis; COLMAP's rigs and frames.
    """
    seen = np.bincount(observations.corner, minlength=len(state.corners))
    observations = observations.select(seen[observations.corner] > 1)  # COLMAP wants tracks
    with _vendor("bundle adjustment"):
        problem = _build(state, observations)
        config = _config(problem, observations, state.corners, options)
        adjuster = pycolmap.create_default_ceres_bundle_adjuster(
            _ceres_options(options), config, problem
        )
        summary = adjuster.solve()
        if not summary.is_solution_usable():
            raise SolveError(f"bundle adjustment failed: {summary.brief_report()}")
        converged = summary.termination_type == pycolmap.BundleAdjustmentTerminationType.CONVERGENCE
        return Adjustment(_read_back(problem, state, observations), bool(converged))


def to_colmap(camera: Camera, camera_id: int, model: str = "OPENCV") -> pycolmap.Camera:
    """A COLMAP camera with the lens of ours.

    Args:
        camera: ours, pixel centres at integers.
        camera_id: COLMAP's number for it.
        model: "OPENCV" (k3 must be 0) or "FULL_OPENCV".

    Raises:
        CameraError: when the model cannot hold the lens.
    """
    k1, k2, p1, p2, k3 = camera.distortion.tolist()
    params = [
        camera.fx,
        camera.fy,
        camera.cx + _HALF_PIXEL,
        camera.cy + _HALF_PIXEL,
        k1,
        k2,
        p1,
        p2,
    ]
    if model == "FULL_OPENCV":
        params += [k3, 0.0, 0.0, 0.0]
    elif model != "OPENCV":
        raise CameraError(f"{camera.name}: model must be OPENCV or FULL_OPENCV, found {model}")
    elif k3 != 0:
        raise CameraError(f"{camera.name}: OPENCV holds no k3, found {k3:g}; use FULL_OPENCV")
    return pycolmap.Camera(
        model=model, width=camera.width, height=camera.height, params=params, camera_id=camera_id
    )


def from_colmap(camera: pycolmap.Camera, name: str, camera_from_world: Pose) -> Camera:
    """Our camera with the lens of a COLMAP one.

    Raises:
        CameraError: when its model, or a coefficient, has no place in Brown-Conrady k1 k2 p1 p2 k3.
    """
    model = camera.model.name
    if model not in _PARAMETERS:
        raise CameraError(
            f"{name}: camera model {model} is not supported; "
            f"convert it to one of {', '.join(_PARAMETERS)}"
        )
    params = [float(value) for value in camera.params]
    fx, fy, cx, cy, *bend = (0.0 if at is None else params[at] for at in _PARAMETERS[model])
    k3 = params[8] if model == "FULL_OPENCV" else 0.0
    if model == "FULL_OPENCV" and any(params[9:12]):
        raise CameraError(
            f"{name}: FULL_OPENCV with k4, k5, k6 = {params[9:12]}; "
            "only k1 k2 p1 p2 k3 are supported"
        )
    return Camera(
        name=name, width=int(camera.width), height=int(camera.height), fx=fx, fy=fy,
        cx=cx - _HALF_PIXEL, cy=cy - _HALF_PIXEL, distortion=np.array([*bend, k3]),
        camera_from_world=camera_from_world,
    )  # fmt: skip


def read_model(folder: Path) -> CameraArray:
    """Read the cameras of a COLMAP sparse model, text or binary.

    A camera is named after the folder its images lie in, or, when all images lie in one folder,
    after its image. The world is the model's, its unit taken as a millimetre: a model in metres
    must be scaled before.

    Args:
        folder: holding cameras, images and points3D as .bin or .txt.

    Raises:
        CameraError: naming the folder and every image or camera that does not fit.
    """
    folder = Path(folder)
    if not any(all((folder / f"{n}{e}").is_file() for n in _MODEL_FILES) for e in (".bin", ".txt")):
        raise CameraError(
            f"{folder}: expected a COLMAP model: cameras, images and points3D, all .bin or all .txt"
        )
    model = pycolmap.Reconstruction()
    try:
        with _vendor(f"{folder}: not readable as a COLMAP model"):
            model.read(str(folder))
            images = sorted(model.images.values(), key=lambda image: str(image.name))
            posed = [image for image in images if image.has_pose]
    except SolveError as error:
        raise CameraError(str(error)) from error
    if not posed:
        raise CameraError(f"{folder}: {len(images)} images, none of them with a pose")
    flat = len({PurePosixPath(image.name).parent for image in posed}) == 1 and len(posed) > 1
    cameras: dict[str, Camera] = {}
    problems: list[str] = []
    for image in posed:
        path = PurePosixPath(str(image.name).replace("\\", "/"))
        name = path.stem if flat or path.parent.name == "" else path.parent.name
        try:
            camera = from_colmap(image.camera, name, _pose(image.cam_from_world()))
        except CameraError as error:
            problems.append(str(error))
            continue
        if name in cameras and not _same(cameras[name], camera):
            problems.append(
                f"{name}: {image.name} has another lens or place than the images before it"
            )
        cameras.setdefault(name, camera)
    raise_all(str(folder), list(dict.fromkeys(problems)), CameraError)
    return CameraArray(tuple(cameras.values()))


def write_model(folder: Path, cameras: CameraArray, *, text: bool = False) -> None:
    """Write the array as a COLMAP sparse model: one image `NAME/0000.png` a camera, no points.

    Args:
        folder: to write or replace, whole or not at all.
        cameras: the array; its millimetres become the model's unit.
        text: .txt files rather than .bin.
    """
    model = pycolmap.Reconstruction()
    with _vendor("writing a COLMAP model"):
        for number, camera in enumerate(cameras, start=1):
            kind = "FULL_OPENCV" if camera.distortion[4] != 0 else "OPENCV"
            model.add_camera_with_trivial_rig(to_colmap(camera, number, kind))
            image = pycolmap.Image(
                name=f"{camera.name}/0000.png", camera_id=number, image_id=number
            )
            model.add_image_with_trivial_frame(image, _rigid(camera.camera_from_world))
        with replacing(folder) as partial:
            partial.mkdir()
            (model.write_text if text else model.write_binary)(str(partial))


@contextmanager
def _vendor(what: str) -> Iterator[None]:
    """Turn pycolmap's exceptions into ours, and keep its log off the terminal."""
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL)
    try:
        yield
    except _VENDOR as error:
        raise SolveError(
            f"{what}: {str(error).splitlines()[0] if str(error) else error!r}"
        ) from error
    finally:
        pycolmap.logging.minloglevel = level


def _build(state: ArrayState, observations: BoardObservations) -> pycolmap.Reconstruction:
    """One rig, one frame a pose, one image a view, one point a corner that was seen."""
    problem = pycolmap.Reconstruction()
    reference = state.cameras[0].camera_from_world
    rig = pycolmap.Rig(rig_id=1)
    sensors = []
    for index, camera in enumerate(state.cameras):
        lens = to_colmap(camera, index + 1)
        problem.add_camera(lens)
        sensors.append(lens.sensor_id)
        if index == 0:
            rig.add_ref_sensor(lens.sensor_id)
        else:
            rig.add_sensor(lens.sensor_id, _rigid(camera.camera_from_world @ reference.inverse()))
    problem.add_rig(rig)
    views = list(observations.views())
    for pose in np.unique(observations.pose).tolist():
        frame = pycolmap.Frame(frame_id=pose + 1, rig_id=1)
        frame.rig_from_world = _rigid(reference @ state.array_from_board[pose])
        for number, (device, seen, _) in enumerate(views, start=1):
            if seen == pose:
                frame.add_data_id(pycolmap.data_t(sensors[device], number))
        problem.add_frame(frame)
    tracks: dict[int, Any] = {}
    for number, (device, pose, rows) in enumerate(views, start=1):
        image = pycolmap.Image(
            name=f"{pose}/{device}", keypoints=observations.pixels[rows] + _HALF_PIXEL,
            camera_id=device + 1, image_id=number,
        )  # fmt: skip
        image.frame_id = pose + 1
        problem.add_image(image)
        for place, corner in enumerate(observations.corner[rows].tolist()):
            tracks.setdefault(corner, pycolmap.Track()).add_element(number, place)
    for corner in sorted(tracks):
        point = pycolmap.Point3D(xyz=state.corners[corner], track=tracks[corner])
        problem.add_point3D_with_id(corner + 1, point)
    return problem


def _config(
    problem: pycolmap.Reconstruction,
    observations: BoardObservations,
    corners: Floats,
    options: AdjustOptions,
) -> pycolmap.BundleAdjustmentConfig:
    config = pycolmap.BundleAdjustmentConfig()
    for number in sorted(problem.images):
        config.add_image(number)
    if options.free_board:
        for corner in held_corners(observations, corners):
            config.add_constant_point(int(corner) + 1)
    else:
        for number in sorted(problem.points3D):
            config.add_constant_point(number)
    return config


def held_corners(observations: BoardObservations, corners: Floats) -> Ints:
    """The three corners (3,) that fix the gauge: well seen, and spanning the widest triangle."""
    seen = np.bincount(observations.corner, minlength=len(corners))
    often = np.flatnonzero(seen >= max(0.5 * float(np.median(seen[seen > 0])), 1.0))
    flat = corners[often, :2]
    first = int(np.argmin(flat.sum(axis=1)))
    second = int(np.argmax(np.linalg.norm(flat - flat[first], axis=1)))
    edge = flat[second] - flat[first]
    away = np.abs(edge[0] * (flat[:, 1] - flat[first, 1]) - edge[1] * (flat[:, 0] - flat[first, 0]))
    third = int(np.argmax(away))
    if away[third] <= 0:
        raise SolveError(
            "the corners seen on the board lie on one line: no three of them fix its space"
        )
    return often[[first, second, third]]


def _ceres_options(options: AdjustOptions) -> pycolmap.BundleAdjustmentOptions:
    out = pycolmap.BundleAdjustmentOptions()
    out.print_summary = False
    out.refine_focal_length = out.refine_extra_params = options.free_lenses
    out.refine_principal_point = options.free_lenses and options.free_principal_points
    out.refine_sensor_from_rig = options.free_cameras
    out.refine_points3D = options.free_board
    kind = pycolmap.LossFunctionType
    out.ceres.loss_function_type = kind.CAUCHY if options.loss_px > 0 else kind.TRIVIAL
    out.ceres.loss_function_scale = options.loss_px if options.loss_px > 0 else 1.0
    out.ceres.solver_options.max_num_iterations = options.iterations
    out.ceres.solver_options.num_threads = (
        1  # sums in one order: the same input gives the same bytes
    )
    out.ceres.solver_options.function_tolerance = 1e-9
    return out


def _read_back(
    problem: pycolmap.Reconstruction, state: ArrayState, observations: BoardObservations
) -> ArrayState:
    reference = state.cameras[0].camera_from_world
    rig = problem.rig(1)
    cameras = []
    for index, camera in enumerate(state.cameras):
        lens = problem.camera(index + 1)
        place = reference
        if index > 0:
            place = _pose(rig.sensor_from_rig(lens.sensor_id)) @ reference
        cameras.append(from_colmap(lens, camera.name, place))
    poses = list(state.array_from_board)
    for pose in np.unique(observations.pose).tolist():
        poses[pose] = reference.inverse() @ _pose(problem.frame(pose + 1).rig_from_world)
    corners = np.array(state.corners)
    for number in sorted(problem.points3D):
        corners[number - 1] = problem.point3D(number).xyz
    if not np.isfinite(corners).all():
        raise SolveError("bundle adjustment returned a board shape that is not finite")
    return ArrayState(CameraArray(tuple(cameras)), tuple(poses), corners)


def _rigid(pose: Pose) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(np.column_stack([pose.rotation, pose.translation]))


def _pose(rigid: pycolmap.Rigid3d) -> Pose:
    matrix = np.asarray(rigid.matrix(), dtype=np.float64)
    return Pose(matrix[:, :3], matrix[:, 3])


def _same(one: Camera, other: Camera) -> bool:
    return bool(
        np.array_equal(one.matrix, other.matrix)
        and np.array_equal(one.distortion, other.distortion)
        and np.allclose(
            one.camera_from_world.matrix(), other.camera_from_world.matrix(), atol=_SAME_PLACE
        )
    )
