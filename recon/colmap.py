"""The seam to COLMAP: models in and out, and bundle adjustment of an array in the board's frame.

The only module that imports pycolmap, but for a bench that has its fusion as an opponent. COLMAP
puts the centre of the first pixel at 0.5, we put it at 0: that half pixel is added to keypoints and
principal points on the way in, taken away on the way out, here and nowhere else.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from capture.camera import Camera, CameraArray
from capture.errors import CameraError, SolveError, raise_all
from capture.pose import Pose
from capture.product import replacing
from recon.array_state import ArrayState
from recon.board.observations import BoardObservations
from recon.camera_parts import check_unit, rigid, scaled
from recon.colmap_files import check_model_files, check_replaceable, name_images

_HALF_PIXEL = 0.5
_PARAMETERS = {  # where fx fy cx cy k1 k2 p1 p2 stand among each model's parameters; None is 0
    "SIMPLE_PINHOLE": (0, 0, 1, 2, None, None, None, None),
    "PINHOLE": (0, 1, 2, 3, None, None, None, None),
    "SIMPLE_RADIAL": (0, 0, 1, 2, 3, None, None, None),
    "RADIAL": (0, 0, 1, 2, 3, 4, None, None),
    "OPENCV": (0, 1, 2, 3, 4, 5, 6, 7),
    "FULL_OPENCV": (0, 1, 2, 3, 4, 5, 6, 7),
}
_SAME_PLACE = 1e-6  # two images of one camera must agree on its pose to this
_VENDOR = (ValueError, RuntimeError, IndexError, KeyError, TypeError, MemoryError)


@dataclass(frozen=True, kw_only=True)
class AdjustOptions:
    """What a bundle adjustment may move, and how it weighs what does not fit.

    Attributes:
        loss_px: scale of the Cauchy loss; 0 means plain least squares.
        free_lenses: focal lengths, principal points and distortion.
        free_principal_points: principal points (only with free lenses).
        free_cameras: where the devices stand in the array.
        free_board: the board's shape. Nothing fixes its space and the scale then: the result may
            have moved by them, see `recon.calibration.gauge`.
        iterations: at most this many steps.
        moving: indices of the devices whose place and lens may move while the others are held to
            the last bit; None lets all move.
    """

    loss_px: float = 0.5
    free_lenses: bool = True
    free_principal_points: bool = True
    free_cameras: bool = True
    free_board: bool = False
    iterations: int = 60
    moving: tuple[int, ...] | None = None


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
        SolveError: when the solver fails or returns something that is not an array, or when
            `options.moving` names a device that is not there or leaves none to hold.
        CameraError: when a lens that may move has a k3.

    References:
        Triggs et al. 2000, Bundle Adjustment - A Modern Synthesis; COLMAP's rigs and frames.
    """
    seen = np.bincount(observations.corner, minlength=len(state.corners))
    observations = observations.select(seen[observations.corner] > 1)  # COLMAP wants tracks
    reference = _reference(state.cameras, options)
    with _vendor("bundle adjustment"):
        problem = _build(state, observations, reference)
        config = _config(problem, options)
        if options.moving is not None:
            _hold(config, problem, options.moving, reference)
        adjuster = pycolmap.create_default_ceres_bundle_adjuster(
            _ceres_options(options), config, problem
        )
        summary = adjuster.solve()
        if not summary.is_solution_usable():
            raise SolveError(f"bundle adjustment failed: {summary.brief_report()}")
        converged = summary.termination_type == pycolmap.BundleAdjustmentTerminationType.CONVERGENCE
        found = _read_back(problem, state, observations, reference)
    if options.moving is not None:
        moving = set(options.moving)
        pairs = enumerate(zip(state.cameras, found.cameras, strict=True))
        cameras = tuple(new if at in moving else old for at, (old, new) in pairs)
        found = ArrayState(CameraArray(cameras), found.array_from_board, found.corners)
    return Adjustment(found, bool(converged))


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


def read_model(folder: Path, *, unit_mm: float = 1.0) -> CameraArray:
    """Read the cameras of a COLMAP sparse model, text or binary, with rigs or without.

    A camera is named after the folder its images lie in, or, when all images lie in one folder,
    after its image. The world is the model's. In a model of one rig whose frames stand in several
    places, as a waved board gives, each sensor is a camera and the world is the rig's space.

    Args:
        folder: holding cameras, images and points3D (and rigs and frames) as .bin or .txt.
        unit_mm: millimetres of the model's unit, which COLMAP leaves open.

    Raises:
        CameraError: naming the folder and every image or camera that does not fit.
    """
    folder = Path(folder)
    check_unit(unit_mm)
    check_model_files(folder)
    try:
        with _vendor(f"{folder}: not readable as a COLMAP model"):
            model = pycolmap.Reconstruction()
            model.read(str(folder))
            return scaled(_array(model, str(folder)), unit_mm)
    except SolveError as error:
        raise CameraError(str(error)) from error


def _array(model: pycolmap.Reconstruction, where: str) -> CameraArray:
    images = sorted(model.images.values(), key=lambda image: str(image.name))
    posed = [image for image in images if image.has_pose]
    if not posed:
        raise CameraError(f"{where}: {len(images)} images, none of them with a pose")
    rigs = {image.frame.rig_id for image in posed}
    rig: Any = model.rig(rigs.pop()) if len(rigs) == 1 else None
    one_rig = rig is not None and rig.num_sensors() > 1
    problems = [
        f"sensor {sensor.id} of the rig has no known sensor_from_rig; solve for it first"
        for sensor, place in (rig.non_ref_sensors.items() if one_rig else ())
        if place is None
    ]
    raise_all(where, problems, CameraError)
    places = [image.frame.rig_from_world.matrix() for image in posed]
    waved = one_rig and not all(np.allclose(p, places[0], atol=_SAME_PLACE) for p in places)
    names = name_images([(str(i.name), int(i.camera_id)) for i in posed], where, one_rig=one_rig)
    cameras: dict[str, Camera] = {}
    for image, name in zip(posed, names, strict=True):
        place = image.cam_from_world()
        if waved:
            sensor = image.camera.sensor_id
            known = not rig.is_ref_sensor(sensor)
            place = rig.sensor_from_rig(sensor) if known else pycolmap.Rigid3d()
        try:
            camera = from_colmap(image.camera, name, rigid(place.matrix(), 1.0, str(image.name)))
        except CameraError as error:
            problems.append(str(error))
            continue
        if not _same(cameras.setdefault(name, camera), camera):
            problems.append(
                f"{name}: {image.name} has another lens or place than the images before it"
            )
    raise_all(where, list(dict.fromkeys(problems)), CameraError)
    return CameraArray(tuple(cameras.values()))


def write_model(
    folder: Path, cameras: CameraArray, *, text: bool = False, unit_mm: float = 1.0
) -> None:
    """Write the array as a COLMAP sparse model: one rig, one frame, no points.

    The rig has a sensor a camera, the first of them the reference; the one frame has an image
    `NAME/0000.png` a camera. Cameras without k3 are OPENCV, those with it FULL_OPENCV.

    Args:
        folder: to write or replace, whole or not at all.
        cameras: the array.
        text: .txt files rather than .bin.
        unit_mm: millimetres of the model's unit.

    Raises:
        CameraError: when the folder holds anything but a COLMAP model.
    """
    check_unit(unit_mm)
    folder = Path(folder).resolve()  # "." has no name to replace
    check_replaceable(folder)
    cameras = scaled(cameras, 1.0 / unit_mm)
    origin = cameras[0].camera_from_world
    with _vendor("writing a COLMAP model"):
        model, rig = pycolmap.Reconstruction(), pycolmap.Rig(rig_id=1)
        frame = pycolmap.Frame(frame_id=1, rig_id=1)
        frame.rig_from_world = _rigid(origin)
        images = []
        for number, camera in enumerate(cameras, start=1):
            lens = to_colmap(camera, number, _model(camera))
            model.add_camera(lens)
            if number == 1:
                rig.add_ref_sensor(lens.sensor_id)
            else:
                place = camera.camera_from_world @ origin.inverse()
                rig.add_sensor(lens.sensor_id, _rigid(place))
            frame.add_data_id(pycolmap.data_t(lens.sensor_id, number))
            name = f"{camera.name}/0000.png"
            images.append(pycolmap.Image(name=name, camera_id=number, image_id=number))
        model.add_rig(rig)
        model.add_frame(frame)
        for image in images:
            image.frame_id = 1
            model.add_image(image)
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


def _model(camera: Camera) -> str:
    return "FULL_OPENCV" if camera.distortion[4] != 0 else "OPENCV"


def _reference(cameras: CameraArray, options: AdjustOptions) -> int:
    """The device in whose space the others stand: the first that is held."""
    count = len(cameras)
    free = range(count) if options.moving is None else options.moving
    for index in free if options.free_lenses else ():
        if 0 <= index < count and _model(cameras[index]) != "OPENCV":
            raise CameraError(
                f"{cameras[index].name}: a lens with k3 = {cameras[index].distortion[4]:g} is not "
                "solved for; hold the lenses, or start from k3 = 0"
            )
    if options.moving is None:
        return 0
    strange = sorted(set(options.moving) - set(range(count)))
    held = [index for index in range(count) if index not in options.moving]
    if strange or not held:
        raise SolveError(
            f"moving: expected some of the devices 0..{count - 1} and not all of them, "
            f"found {sorted(options.moving)}"
        )
    return held[0]


def _hold(
    config: pycolmap.BundleAdjustmentConfig,
    problem: pycolmap.Reconstruction,
    moving: tuple[int, ...],
    reference: int,
) -> None:
    """Hold lens and place of every device that must not move."""
    for number in sorted(problem.cameras):
        if number - 1 not in moving:
            config.set_constant_cam_intrinsics(number)
            if number - 1 != reference:
                config.set_constant_sensor_from_rig_pose(problem.camera(number).sensor_id)


def _build(
    state: ArrayState, observations: BoardObservations, reference: int = 0
) -> pycolmap.Reconstruction:
    """One rig, one frame a pose, one image a view, one point a corner that was seen."""
    problem = pycolmap.Reconstruction()
    origin = state.cameras[reference].camera_from_world
    rig = pycolmap.Rig(rig_id=1)
    sensors = []
    for index, camera in enumerate(state.cameras):
        lens = to_colmap(camera, index + 1, _model(camera))
        problem.add_camera(lens)
        sensors.append(lens.sensor_id)
    rig.add_ref_sensor(sensors[reference])  # before all others
    for index, camera in enumerate(state.cameras):
        if index != reference:
            rig.add_sensor(sensors[index], _rigid(camera.camera_from_world @ origin.inverse()))
    problem.add_rig(rig)
    views = list(observations.views())
    for pose in np.unique(observations.pose).tolist():
        frame = pycolmap.Frame(frame_id=pose + 1, rig_id=1)
        frame.rig_from_world = _rigid(origin @ state.array_from_board[pose])
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
    problem: pycolmap.Reconstruction, options: AdjustOptions
) -> pycolmap.BundleAdjustmentConfig:
    config = pycolmap.BundleAdjustmentConfig()
    for number in sorted(problem.images):
        config.add_image(number)
    if not options.free_board:
        for number in sorted(problem.points3D):
            config.add_constant_point(number)
    return config


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
    problem: pycolmap.Reconstruction,
    state: ArrayState,
    observations: BoardObservations,
    reference: int,
) -> ArrayState:
    origin = state.cameras[reference].camera_from_world
    rig = problem.rig(1)
    cameras = []
    for index, camera in enumerate(state.cameras):
        lens = problem.camera(index + 1)
        place = origin
        if index != reference:
            place = _pose(rig.sensor_from_rig(lens.sensor_id)) @ origin
        cameras.append(from_colmap(lens, camera.name, place))
    poses = list(state.array_from_board)
    for pose in np.unique(observations.pose).tolist():
        poses[pose] = origin.inverse() @ _pose(problem.frame(pose + 1).rig_from_world)
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
