"""A first guess of the array: nominal lenses, IPPE poses, medoid relative poses along a tree."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import cv2
import numpy as np

from capture.arrays import Bools, Floats, Ints
from capture.camera import Camera, CameraArray
from capture.errors import SolveError
from capture.pose import Pose
from recon.array_state import ArrayState
from recon.board.observations import BoardObservations
from recon.board.shape import BoardShape
from recon.calibration.geometry import rigid_fit
from recon.calibration.nominal_lenses import LEAST_CORNERS, face_rows, nominal_lenses

_AGREEING = 0.05  # relative poses nearer than this (radians plus fraction of distance) agree
_EACH = 4  # one corner in so many tells which of two poses is right
_CAP = 0.1  # a relative pose off by more than this (radians, or fraction of distance) is just wrong


@dataclass(frozen=True, eq=False)
class BoardView:
    """One device's sight of the board at one pose: the poses IPPE offers, best first, by face."""

    device: int
    pose: int
    candidates: tuple[Pose, ...]
    corners: int


@dataclass(frozen=True, eq=False)
class Links:
    """How well the devices agree, two by two, on where the others stand.

    Attributes:
        child_from_parent: the relative pose that most shared board poses agree with, by pair.
        shared: (C, C) board poses both saw.
        agreeing: (C, C) how many of them agree with that relative pose.
        weight: (C, C) corners shared at board poses that agree.
    """

    child_from_parent: dict[tuple[int, int], Pose]
    shared: Ints
    agreeing: Ints
    weight: Floats


@dataclass(frozen=True, eq=False)
class FirstGuess:
    """Where a bundle adjustment starts.

    Attributes:
        state: lenses, camera places, board poses, in the space of the best-connected device.
        links: how well the devices agreed.
    """

    state: ArrayState
    links: Links


def initial_state(
    observations: BoardObservations,
    shape: BoardShape | Floats,
    focal_guess: float | None = None,
) -> ArrayState:
    """The state of `first_guess`."""
    return first_guess(observations, shape, focal_guess).state


def first_guess(
    observations: BoardObservations,
    shape: BoardShape | Floats,
    focal_guess: float | None = None,
) -> FirstGuess:
    """Estimate lenses, camera places and board poses well enough to start a bundle adjustment.

    Boards whose place on the body is not known are chained as if each were waved alone; their
    places on the body are then the ones that most poses agree with.

    Args:
        observations: corner sightings.
        shape: the nominal board; corners (N, 3), mm, at Z = 0 stand for one flat board.
        focal_guess: focal length over image width, or None to find it from the views.

    Returns:
        An estimate in the camera space of the best-connected device.

    Raises:
        SolveError: when the devices do not hang together through shared board poses.

    References:
        Zhang 2000, section 3.1 (focal length from homographies); Collins and Bartoli 2014 (IPPE);
        OpenCV's multiview calibration tutorial (maximum spanning tree over pairs).
    """
    if not isinstance(shape, BoardShape):
        shape = BoardShape.flat_board(shape)
    lenses = nominal_lenses(observations, shape, focal_guess)
    groups = _groups(shape)
    apart, poses = _apart(observations, shape, groups)
    views = view_candidates(apart, shape, lenses)
    links = _link(apart, views)
    parent, order = _spanning_tree(apart, links)
    camera_from_array = {order[0]: Pose.identity()}
    for child in order[1:]:
        child_from_parent = links.child_from_parent[child, parent[child]]
        camera_from_array[child] = child_from_parent @ camera_from_array[parent[child]]
    cameras = CameraArray(
        tuple(lens.posed(camera_from_array[index]) for index, lens in enumerate(lenses))
    )
    found = _board_poses(apart, shape.corners, cameras, views)
    state = _joined(observations, shape, groups, poses, ArrayState(cameras, found, shape.corners))
    return FirstGuess(state, links)


def _groups(shape: BoardShape) -> Ints:
    """The group that each face moves with: one of all placed faces, one for each other face."""
    first = 1 if shape.placed.any() else 0
    return np.where(shape.placed, 0, first + np.cumsum(~shape.placed) - 1).astype(np.int64)


def _apart(
    observations: BoardObservations, shape: BoardShape, groups: Ints
) -> tuple[BoardObservations, list[tuple[int, int]]]:
    """The same sightings, each group of faces at a board pose of its own, and what these are."""
    if groups.max() == 0:
        return observations, [(pose, 0) for pose in range(len(observations.frames))]
    group = groups[shape.face[observations.corner]]
    keys = observations.pose * (groups.max() + 1) + group
    found, pose = np.unique(keys, return_inverse=True)
    poses = [divmod(int(key), int(groups.max()) + 1) for key in found]
    frames = tuple(observations.frames[before] for before, _ in poses)
    return dataclasses.replace(observations, frames=frames, pose=pose.astype(np.int64)), poses


def _joined(
    observations: BoardObservations,
    shape: BoardShape,
    groups: Ints,
    poses: list[tuple[int, int]],
    apart: ArrayState,
) -> ArrayState:
    """One body again: groups placed on it, and for each pose the motion they all like best."""
    if groups.max() == 0:
        return apart
    found = dict(zip(poses, apart.array_from_board, strict=True))
    count = int(groups.max()) + 1
    together = np.array(
        [[sum((p, g) in found and (p, h) in found for p in range(len(observations.frames)))
          for g in range(count)] for h in range(count)]
    )  # fmt: skip
    np.fill_diagonal(together, 0)
    body_from_group = {0: Pose.identity()}
    while len(body_from_group) < count:
        inside = sorted(body_from_group)
        outside = [g for g in range(count) if g not in body_from_group]
        links = together[np.ix_(inside, outside)]
        if links.max() <= 0:
            raise SolveError(
                f"{len(outside)} of {count} boards of the body were never seen together with the "
                "others: turn the body so that two boards show, or give body_from_board in the file"
            )
        start, stop = divmod(int(np.argmax(links)), len(outside))
        known, new = inside[start], outside[stop]
        options = [
            found[p, known].inverse() @ found[p, new]
            for p in range(len(observations.frames))
            if (p, known) in found and (p, new) in found
        ]
        best, _ = _medoid(
            np.stack([option.rotation for option in options]),
            np.stack([option.translation for option in options]),
            np.arange(len(options)),
        )
        body_from_group[new] = body_from_group[known] @ options[best]
    corners = np.array(shape.corners)
    for face, group in enumerate(groups.tolist()):
        if not shape.placed[face]:
            own = shape.face == face
            corners[own] = body_from_group[group].apply(corners[own])
    motions = []
    for pose in range(len(observations.frames)):
        rows = np.flatnonzero(observations.pose == pose)
        options = [
            found[pose, group] @ body_from_group[group].inverse()
            for group in range(count)
            if (pose, group) in found
        ]
        costs = [
            _disagreement(observations, rows, apart.cameras, option.apply(corners))
            for option in options
        ]
        motions.append(options[int(np.argmin(costs))] if options else Pose.identity())
    return ArrayState(apart.cameras, tuple(motions), corners)


def view_candidates(
    observations: BoardObservations, shape: BoardShape, lenses: list[Camera]
) -> list[BoardView]:
    """Poses of the body that each view of it allows.

    Args:
        observations: corner sightings.
        shape: the board; of a face whose place is not known the pose is its own.
        lenses: one a device; their places are not used.
    """
    body_from_face = [
        rigid_fit(
            np.concatenate([flat, np.zeros((len(flat), 1))], axis=1), shape.corners[shape.face == f]
        )
        for f in range(shape.face_count)
        for flat in (shape.flat[shape.face == f],)
    ]
    views = []
    for device, pose, rows in observations.views():
        candidates: list[Pose] = []
        for face, part in face_rows(observations, shape, rows):
            ideal = lenses[device].undistort(observations.pixels[part])
            seen = np.isfinite(ideal).all(axis=1)
            if seen.sum() >= LEAST_CORNERS:
                flat = shape.flat[observations.corner[part]][seen]
                found = plane_poses(flat, ideal[seen])
                candidates += [option @ body_from_face[face].inverse() for option in found]
        if candidates:
            views.append(BoardView(device, pose, tuple(candidates), rows.stop - rows.start))
    return views


def plane_poses(flat: Floats, ideal: Floats) -> list[Pose]:
    """The one or two poses camera_from_board of a flat board, best first.

    Args:
        flat: (N, 2) corners on the board, mm.
        ideal: (N, 2) the same in the image, normalised and without distortion.

    References:
        Collins and Bartoli 2014, Infinitesimal plane-based pose estimation.
    """
    board = np.concatenate([flat, np.zeros((len(flat), 1))], axis=1)
    middle = board.mean(axis=0)
    found, turns, shifts, _ = cv2.solvePnPGeneric(
        board - middle, ideal, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    out = []
    for turn, shift in zip(turns[:found], shifts[:found], strict=True):
        if np.isfinite(turn).all() and np.isfinite(shift).all() and shift[2, 0] > 0:
            moved = Pose.from_rotation_vector(
                turn[:, 0].astype(np.float64), shift[:, 0].astype(np.float64)
            )
            out.append(moved @ Pose(np.eye(3), -middle))
    return out


def _link(observations: BoardObservations, views: list[BoardView]) -> Links:
    """Compare the devices two by two on the board poses both saw."""
    count = len(observations.device_names)
    places: list[dict[int, BoardView]] = [{} for _ in range(count)]
    for view in views:
        places[view.device][view.pose] = view
    relative: dict[tuple[int, int], Pose] = {}
    shared, agreeing = np.zeros((2, count, count), dtype=np.int64)
    weight = np.zeros((count, count))
    for one in range(count):
        for other in range(one):
            both = sorted(places[one].keys() & places[other].keys())
            if not both:
                continue
            best, near = shared_motion(
                [places[one][pose].candidates for pose in both],
                [places[other][pose].candidates for pose in both],
            )
            relative[one, other], relative[other, one] = best, best.inverse()
            sizes = [min(places[one][p].corners, places[other][p].corners) for p in both]
            shared[one, other] = shared[other, one] = len(both)
            agreeing[one, other] = agreeing[other, one] = int(near.sum())
            weight[one, other] = weight[other, one] = float(np.array(sizes)[near].sum())
    return Links(relative, shared, agreeing, weight)


def _spanning_tree(
    observations: BoardObservations, links: Links
) -> tuple[dict[int, int], list[int]]:
    """Maximum spanning tree over devices by agreeing corners: parents, and root-first order."""
    count = len(observations.device_names)
    root = int(np.argmax(links.weight.sum(axis=1)))
    order, parent = [root], {}
    while len(order) < count:
        outside = [c for c in range(count) if c not in order]
        weight = links.weight[np.ix_(order, outside)]
        start, stop = divmod(int(np.argmax(weight)), len(outside))
        if weight[start, stop] <= 0:
            names = observations.device_names
            raise SolveError(
                f"{', '.join(names[c] for c in outside)}: never saw the board together with "
                f"{', '.join(names[c] for c in order)}; hold the board where both groups see it"
            )
        parent[outside[stop]] = order[start]
        order.append(outside[stop])
    return parent, order


def shared_motion(
    ones: list[tuple[Pose, ...]], others: list[tuple[Pose, ...]]
) -> tuple[Pose, Bools]:
    """The motion one_from_other that most pairs of candidate poses offer, and which pairs do."""
    pairs = [
        (place, first, second)
        for place, (own, theirs) in enumerate(zip(ones, others, strict=True))
        for first in own
        for second in theirs
    ]
    turns = np.stack([first.rotation for _, first, _ in pairs])
    shifts = np.stack([first.translation for _, first, _ in pairs])
    back = np.stack([second.rotation for _, _, second in pairs])
    from_there = np.stack([second.translation for _, _, second in pairs])
    turned = turns @ back.transpose(0, 2, 1)
    moved = shifts - np.einsum("aij,aj->ai", turned, from_there)
    best, near = _medoid(turned, moved, np.array([place for place, _, _ in pairs]))
    _, first, second = pairs[best]
    return first @ second.inverse(), near


def _medoid(turns: Floats, shifts: Floats, owner: Ints) -> tuple[int, Bools]:
    """The motion that most owners (O,) offer one near to, and which owners do.

    Args:
        turns: (A, 3, 3) rotations.
        shifts: (A, 3) translations, mm.
        owner: (A,) whose each is, from 0, ascending.
    """
    trace = turns.reshape(-1, 9) @ turns.reshape(-1, 9).T
    angle = np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))
    reach = max(float(np.median(np.linalg.norm(shifts, axis=1))), 1e-9)
    gap = np.linalg.norm(shifts[:, None] - shifts[None], axis=2) / reach
    distance = np.minimum(angle + gap, _CAP)
    starts = np.flatnonzero(np.diff(owner, prepend=-1))
    nearest = np.minimum.reduceat(distance, starts, axis=1)
    best = int(np.argmin(nearest.sum(axis=1)))
    return best, nearest[best] < _AGREEING


def board_poses(
    observations: BoardObservations, shape: BoardShape, cameras: CameraArray
) -> tuple[Pose, ...]:
    """Board poses array_from_board before an array that is known; the identity where none is seen.

    Args:
        observations: corner sightings.
        shape: the board, every face of it placed.
        cameras: the array.
    """
    views = view_candidates(observations, shape, list(cameras))
    return _board_poses(observations, shape.corners, cameras, views)


def _board_poses(
    observations: BoardObservations, corners: Floats, cameras: CameraArray, views: list[BoardView]
) -> tuple[Pose, ...]:
    """For each board pose, the candidate of any device that all devices together like best."""
    rows_of = [np.flatnonzero(observations.pose == p) for p in range(len(observations.frames))]
    poses = []
    for index, rows in enumerate(rows_of):
        best, least = Pose.identity(), np.inf
        for view in (v for v in views if v.pose == index):
            array_from_camera = cameras[view.device].camera_from_world.inverse()
            for candidate in view.candidates:
                option = array_from_camera @ candidate
                cost = _disagreement(observations, rows, cameras, option.apply(corners))
                if cost < least:
                    best, least = option, cost
        poses.append(best)
    return tuple(poses)


def _disagreement(
    observations: BoardObservations, rows: Ints, cameras: CameraArray, points: Floats
) -> float:
    """Mean capped reprojection error of one board pose over all devices, in image sizes."""
    total = 0.0
    for device in np.unique(observations.device[rows]):
        mine = rows[observations.device[rows] == device][::_EACH]
        miss = (
            cameras[device].project(points[observations.corner[mine]]) - observations.pixels[mine]
        )
        size = max(observations.sizes[device])
        error = np.nan_to_num(np.linalg.norm(miss, axis=1) / size, nan=_CAP)
        total += float(np.minimum(error, _CAP).sum())
    return total / max(len(rows), 1)
