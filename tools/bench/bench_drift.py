"""How small a motion the drift check tells: `python -m tools.bench.bench_drift [--poses N]`.

Predicted from the covariances of an unmoved array, then tried: three devices of sixteen are moved
by 1.0 and by 1.5 times that, one after another. Seeds differ in lenses, board poses and noise.
"""

from __future__ import annotations

import argparse
import dataclasses
import json

import numpy as np

from capture.arrays import Floats
from capture.camera import CameraArray
from capture.pose import Pose
from recon.array_state import ArrayState
from recon.board.shape import BoardShape
from recon.calibration.drift import DriftSettings, check_drift
from recon.calibration.drift_fit import fit_drift
from tools.bench.board_scene import A4_BOARD, BoardScene, make_state, observe

_KINDS = {  # unit motions: 1 um or 1 mdeg
    "sideways, um": (3, 1e-3),
    "along its axis, um": (5, 1e-3),
    "turned, mdeg": (1, float(np.radians(1e-3))),
    "rolled, mdeg": (2, float(np.radians(1e-3))),
}


def moved_state(truth: ArrayState, motions: dict[int, Floats]) -> ArrayState:
    """The same take with some devices moved by (6,) turn (rad) and shift (mm) of their space."""
    cameras = [
        c.posed(Pose.from_rotation_vector(motions[i][:3], motions[i][3:]) @ c.camera_from_world)
        if i in motions
        else c
        for i, c in enumerate(truth.cameras)
    ]
    return ArrayState(CameraArray(tuple(cameras)), truth.array_from_board, truth.corners)


def smallest(scene: BoardScene, settings: DriftSettings) -> dict[str, Floats]:
    """By kind, for every device, the motion that passes both limits with two deviations to spare.

    One number a device, um or mdeg.
    """
    truth = make_state(scene)
    fit = fit_drift(truth.cameras, observe(scene, truth), A4_BOARD.corners_mm(), settings)
    out: dict[str, Floats] = {}
    tests = fit.system.tests(fit.still)
    for kind, (place, unit) in _KINDS.items():
        sizes = []
        for device, (_, covariance) in enumerate(tests):
            step = np.zeros(6)
            step[place] = unit
            distance = float(np.sqrt(step @ np.linalg.solve(covariance, step)))
            effect = fit.system.effect_px(device, step)
            sizes.append(
                max((settings.significant + 2.0) / distance, 1.1 * settings.least_px / effect)
            )
        out[kind] = np.array(sizes)
    return out


def told_share(
    scene: BoardScene, settings: DriftSettings, kind: str, sizes: Floats, times: float
) -> tuple[int, int, int]:
    """How many moved devices were told, of how many, and how many false alarms there were."""
    place, unit = _KINDS[kind]
    random = np.random.default_rng([scene.seed, 9])
    chosen = random.permutation(scene.devices)[:3].tolist()
    truth = make_state(scene)
    motions = {}
    for device in chosen:
        motions[device] = np.zeros(6)
        motions[device][place] = random.choice([-1.0, 1.0]) * times * unit * sizes[device]
    seen = observe(scene, moved_state(truth, motions))
    shape = BoardShape.flat_board(A4_BOARD.corners_mm())
    moved = set(check_drift(truth.cameras, seen, shape, settings).moved)
    names = {truth.cameras[device].name for device in chosen}
    return len(moved & names), len(names), len(moved - names)


def main() -> None:
    """Print one line of JSON a kind of motion."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--poses", type=int, default=5)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--size", type=int, default=2048)
    words = parser.parse_args()
    scene = BoardScene(poses=words.poses, size_px=words.size, focal_px=words.size / 0.512)
    settings = DriftSettings()
    takes = [dataclasses.replace(scene, seed=seed) for seed in range(words.seeds)]
    least = [smallest(take, settings) for take in takes]
    for kind in _KINDS:
        sizes = np.concatenate([found[kind] for found in least])
        row: dict[str, object] = {
            "motion": kind,
            "median": float(f"{np.median(sizes):.3g}"),
            "worst": float(f"{sizes.max():.3g}"),
        }
        for times in (1.0, 1.5):
            counts = [
                told_share(take, settings, kind, found[kind], times)
                for take, found in zip(takes, least, strict=True)
            ]
            told, moved, wrong = (sum(column) for column in zip(*counts, strict=True))
            row[f"told at {times:g}x"] = f"{told} of {moved}"
            row[f"false at {times:g}x"] = wrong
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
