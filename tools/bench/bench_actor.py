"""What the simulated actor costs: `python -m tools.bench.bench_actor` prints one JSON line."""

from __future__ import annotations

import json
import time

import numpy as np

from capture.pose import Pose
from tools.actor.array import make_array
from tools.actor.model import build_actor
from tools.actor.renderer import ActorRenderer, Exposure
from tools.actor.sensor import Sensor


def measure(size: int = 640, rounds: int = 2) -> dict[str, float]:
    """Time the build and the images of one actor.

    Args:
        size: columns and rows, px.
        rounds: how often the 16 cameras are drawn.

    Returns:
        seconds: CPU of the build, CPU and wall of one image, noise included, after the first round.
    """
    start = time.process_time()
    actor = build_actor(11)
    build_s = time.process_time() - start
    renderer = ActorRenderer(actor)
    cameras = make_array(1, size=size)
    cpu_s, wall_s = np.inf, np.inf
    for index in range(rounds + 1):
        posed = actor.pose(actor.weights(jawOpen=0.1 * index), Pose.identity())
        cpu, wall = time.process_time(), time.perf_counter()
        for camera in cameras:
            renderer.render(camera, posed, Sensor(), Exposure(0, index))
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
        if index:
            cpu_s, wall_s = min(cpu_s, cpu / len(cameras)), min(wall_s, wall / len(cameras))
    seconds = {"build_cpu_s": build_s, "image_cpu_s": cpu_s, "image_wall_s": wall_s}
    return {name: round(value, 4) for name, value in seconds.items()}


def main() -> None:
    """Print the timings."""
    print(json.dumps(measure()))


if __name__ == "__main__":
    main()
