"""Synthetic board takes with one fault each, before arrays of many kinds; and healthy ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from capture.camera import CameraArray
from recon.array_state import ArrayState
from recon.board.charuco import Board
from recon.board.observations import BoardObservations
from recon.board.sightings import BarSightings
from tools.bench.board_scene import A4_BOARD, BoardScene, observe
from tools.bench.board_video import (
    delay_device,
    drop_rows,
    earlier_session,
    make_video,
    mirror_device,
    pick_poses,
    swap_devices,
)

_CHOSEN = 60  # frames that a solve gets of a video
_LATE = 20
_FILE_ERROR = 1.02  # square size in the wrong board file over the true one
BAR_MM = 200.0
_BAR_ENDS = np.array([[20.0, 190.0, 0.0], [20.0 + BAR_MM, 190.0, 0.0]])  # board space, mm


@dataclass(frozen=True, eq=False, kw_only=True)
class FaultyTake:
    """A board take at the level of sightings, and what is wrong with it.

    Attributes:
        fault: what it is, in words; "" for a healthy take.
        scene: the array and the take.
        guilty: names of the devices that the program has to name, and no others.
        every: sightings of all frames.
        shown: those of the frames chosen for the solve.
        truth: the array and the board's motion as they were.
        board: as its file has it.
        previous: the cameras of an earlier session, when they are at hand.
        bar: what was seen of a scale bar of `BAR_MM`, when one was shown.
    """

    fault: str
    scene: BoardScene
    guilty: tuple[str, ...]
    every: BoardObservations
    shown: BoardObservations
    truth: ArrayState
    board: Board
    previous: CameraArray | None = None
    bar: BarSightings | None = None


@dataclass(frozen=True, kw_only=True)
class Fault:
    """One fault.

    Attributes:
        words: what it is.
        devices: how many devices are guilty of it.
        spoil: the sightings of every frame made wrong, given those devices.
        suits: whether those devices can be guilty of it at all.
        known: whether the cameras of an earlier session are at hand.
        file_factor: square size in the board file over the true one.
        with_bar: whether a scale bar was shown.
    """

    words: str
    devices: int
    spoil: Callable[[BoardObservations, list[int]], BoardObservations]
    suits: Callable[[BoardObservations, list[int]], bool] = lambda seen, who: True
    known: bool = False
    file_factor: float = 1.0
    with_bar: bool = False


def _middle(seen: BoardObservations, who: list[int]) -> int:
    """The pose in the middle of those that these devices saw."""
    return int(np.median(np.unique(seen.pose[np.isin(seen.device, who)])))


def _seen_around(seen: BoardObservations, who: list[int], pose: int) -> bool:
    """Whether each device saw the board often before and after a pose: else no change shows."""
    views = seen.view_counts()[who] > 0
    share = views[:, :pose].sum(axis=1) / np.maximum(views.sum(axis=1), 1)
    return bool((np.abs(share - 0.5) < 0.3).all())


FAULTS = (
    Fault(
        words="a device with three views",
        devices=1,
        spoil=lambda seen, who: drop_rows(seen, who[0], 3),
    ),
    Fault(
        words="a device that never sees the board",
        devices=1,
        spoil=lambda seen, who: drop_rows(seen, who[0], 0),
    ),
    Fault(
        words="a device 20 frames late",
        devices=1,
        spoil=lambda seen, who: delay_device(seen, who[0], _LATE),
    ),
    Fault(
        words="a device 7 frames early",
        devices=1,
        spoil=lambda seen, who: delay_device(seen, who[0], -7),
    ),
    Fault(
        words="two devices swapped all along, earlier cameras known",
        devices=2,
        spoil=lambda seen, who: swap_devices(seen, who[0], who[1]),
        known=True,
    ),
    Fault(
        words="two devices swapped from the middle on",
        devices=2,
        spoil=lambda seen, who: swap_devices(seen, who[0], who[1], _middle(seen, who)),
        suits=lambda seen, who: _seen_around(seen, who, _middle(seen, who)),
    ),
    Fault(
        words="squares 2 % too large in the board file, scale bar shown",
        devices=0,
        spoil=lambda seen, who: seen,
        file_factor=_FILE_ERROR,
        with_bar=True,
    ),
    Fault(
        words="a mirrored device",
        devices=1,
        spoil=lambda seen, who: mirror_device(seen, who[0]),
    ),
)

_VIDEO = BoardScene(
    size_px=1024, focal_px=2000.0, poses=200, bow_mm=0.2, outliers=0.005, hidden=0.6
)
ARRAYS = (
    ("arc", 16, 62.0),
    ("ring", 8, 180.0),
    ("clusters", 10, 45.0),
    ("pairs", 8, 50.0),
    ("turned", 9, 50.0),
    ("rows", 12, 40.0),
    ("row", 5, 20.0),
)
_HEALTHY = (  # layout, devices, span, frames, chosen, pace, noise, bow, outliers, width, lens
    ("arc", 16, 62.0, 200, 60, 1.0, 0.1, 0.3, 0.01, 1024, 2.0),
    ("arc", 4, 30.0, 120, 40, 1.0, 0.1, 0.0, 0.0, 640, 2.2),
    ("arc", 32, 70.0, 160, 30, 1.5, 0.1, 0.2, 0.005, 1024, 2.0),
    ("ring", 8, 180.0, 220, 60, 1.0, 0.1, 0.2, 0.01, 1024, 2.0),
    ("ring", 12, 180.0, 240, 60, 1.0, 0.15, 0.0, 0.0, 1024, 1.8),
    ("ring", 6, 180.0, 240, 50, 1.0, 0.1, 0.3, 0.01, 1024, 1.8),
    ("clusters", 10, 45.0, 200, 60, 1.0, 0.1, 0.2, 0.01, 1024, 2.0),
    ("clusters", 6, 30.0, 150, 25, 0.6, 0.2, 0.1, 0.02, 640, 1.6),
    ("clusters", 20, 55.0, 200, 40, 1.0, 0.1, 0.3, 0.005, 1024, 2.0),
    ("pairs", 8, 50.0, 200, 60, 1.0, 0.1, 0.2, 0.01, 1024, 2.0),
    ("pairs", 4, 25.0, 100, 20, 1.5, 0.1, 0.0, 0.0, 640, 2.5),
    ("pairs", 14, 65.0, 200, 50, 1.2, 0.08, 0.4, 0.01, 1024, 2.0),
    ("turned", 9, 50.0, 200, 60, 1.0, 0.1, 0.2, 0.01, 1024, 2.0),
    ("turned", 5, 30.0, 150, 30, 0.8, 0.1, 0.0, 0.03, 640, 2.0),
    ("turned", 12, 60.0, 90, 30, 2.0, 0.1, 0.2, 0.005, 1024, 2.2),
    ("rows", 12, 40.0, 200, 60, 0.3, 0.1, 0.2, 0.01, 1024, 2.0),
    ("rows", 6, 20.0, 200, 40, 0.4, 0.1, 0.1, 0.0, 1024, 3.0),
    ("row", 5, 20.0, 200, 60, 1.0, 0.1, 0.2, 0.01, 1024, 2.0),
    ("row", 4, 12.0, 60, 15, 1.5, 0.1, 0.0, 0.0, 640, 2.5),
    ("row", 8, 55.0, 200, 20, 1.0, 0.05, 0.3, 0.01, 1024, 2.0),
)


def faulty_takes(small: bool) -> Iterator[FaultyTake]:
    """Every fault before every array, one after the other; small: two arrays."""
    for number, (layout, devices, span) in enumerate(ARRAYS[1:3] if small else ARRAYS):
        scene = _scene(number, layout, devices, span)
        truth = make_video(scene)
        seen = observe(scene, truth)
        for place, fault in enumerate(FAULTS):
            yield spoiled(fault, scene, truth, seen, 100 * number + place)


def spoiled(
    fault: Fault, scene: BoardScene, truth: ArrayState, seen: BoardObservations, seed: int
) -> FaultyTake:
    """One good take with one fault, at devices that the seed picks.

    Args:
        fault: what goes wrong.
        scene: the good take.
        truth: its array and board poses.
        seen: its sightings.
        seed: of which devices are guilty.
    """
    random = np.random.default_rng([seed, 9])
    who = random.choice(scene.devices, fault.devices, replace=False).tolist()
    while not fault.suits(seen, who):
        who = random.choice(scene.devices, fault.devices, replace=False).tolist()
    every = fault.spoil(seen, who)
    return FaultyTake(
        fault=fault.words, scene=scene, guilty=tuple(seen.device_names[index] for index in who),
        every=every, shown=pick_poses(every, min(_CHOSEN, len(every.frames))), truth=truth,
        board=replace(
            A4_BOARD, square_mm=fault.file_factor * A4_BOARD.square_mm,
            marker_mm=fault.file_factor * A4_BOARD.marker_mm,
        ),
        previous=earlier_session(truth.cameras, seed) if fault.known else None,
        bar=see_bar(scene, truth) if fault.with_bar else None,
    )  # fmt: skip


def healthy_takes(count: int) -> Iterator[FaultyTake]:
    """Good takes of varied arrays, boards and paces; every second has earlier cameras at hand."""
    for number in range(count):
        layout, devices, span, frames, chosen, pace, noise, bow, wild, width, lens = _HEALTHY[
            number % len(_HEALTHY)
        ]
        scene = BoardScene(
            layout=layout, devices=devices, span_deg=span, poses=frames, noise_px=noise,
            bow_mm=bow, outliers=wild, size_px=width, focal_px=lens * width, hidden=0.6,
            radius_mm=450.0 * lens, seed=200 + number,
        )  # fmt: skip
        truth = make_video(scene, pace)
        every = observe(scene, truth)
        yield FaultyTake(
            fault="", scene=scene, guilty=(), every=every, shown=pick_poses(every, chosen),
            truth=truth, board=A4_BOARD, bar=see_bar(scene, truth) if number % 3 == 0 else None,
            previous=earlier_session(truth.cameras, number) if number % 2 else None,
        )  # fmt: skip


def see_bar(scene: BoardScene, truth: ArrayState) -> BarSightings:
    """Sightings of the two ends of a scale bar that is held under the board all along."""
    random = np.random.default_rng([scene.seed, 11])
    rows: list[tuple[int, int, int, float, float]] = []
    for frame, array_from_board in enumerate(truth.array_from_board):
        ends = array_from_board.apply(_BAR_ENDS)
        for device, camera in enumerate(truth.cameras):
            towards = camera.centre - ends.mean(axis=0)
            if -array_from_board.rotation[:, 2] @ towards < 0.4 * np.linalg.norm(towards):
                continue
            pixels = camera.project(ends) + random.normal(0.0, scene.noise_px, (2, 2))
            rows += [
                (device, frame, end, *pixels[end].tolist())
                for end in np.flatnonzero(camera.contains(pixels)).tolist()
            ]
    table = np.array(rows).reshape(-1, 5)
    whole = table[:, :3].astype(np.int64)
    return BarSightings(
        device_names=truth.cameras.names, device=whole[:, 0], frame=whole[:, 1], end=whole[:, 2],
        pixels=table[:, 3:],
    )  # fmt: skip


def _scene(seed: int, layout: str, devices: int, span_deg: float) -> BoardScene:
    return replace(_VIDEO, layout=layout, devices=devices, span_deg=span_deg, seed=50 + seed)
