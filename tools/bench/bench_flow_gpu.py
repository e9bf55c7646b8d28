"""Flow of one view pair on processor and graphics card: `python -m tools.bench.bench_flow_gpu`.

Draws the simulated actor at rest and with an expression into one camera, guides with a mesh that
has gone part of the way, and times the dense flow of the finest rounds: warp, whole-pixel search
and sub-pixel refinement of all samples, through `track.flow_backend.CpuFlow` and
`track.gpu_flow.GpuFlow`. Prints one JSON line a size, with the name of the device that OpenGL
draws on: `llvmpipe` there is no graphics card but the processor again, through Mesa. The card works
while its caller goes on, so its `whole_ms` is to be read, not its steps; `fetch_ms` is what reading
the warped view back takes after that, which later steps of the registration ask for in part.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from capture.arrays import Floats, Floats32, Ints32
from capture.pose import Pose
from recon.images import mono
from tools.actor.array import make_array
from tools.actor.model import build_actor
from tools.actor.renderer import ActorRenderer, Exposure
from tools.actor.sensor import Sensor
from track.flow import FlowMatches
from track.flow_backend import CpuFlow, FlowBackend
from track.gpu_flow import GpuFlow
from track.raster import Rasterizer
from track.reference import ReferenceLevel, facing_normals, reference_level, visible_samples
from track.stage import TrackSettings
from track.surface_samples import sample_surface, vertex_rings

RADIUS_PX = 2  # of the search of the finest rounds
ITERATIONS = 3
_GONE = 0.9  # share of the expression that the guide knows
_RINGS = 3


@dataclass(frozen=True, eq=False, kw_only=True)
class Pair:
    """A view of the actor at rest and of a later frame.

    Attributes:
        level: the reference, at full resolution.
        triangles: (T, 3).
        guide: (V, 3) world mm, near the mesh in the frame.
        image: (H, W) the frame's.
        occluders: depth (h, w) of the guide and its pixel's size in finest ones.
    """

    level: ReferenceLevel
    triangles: Ints32
    guide: Floats
    image: Floats32
    occluders: tuple[Floats32, float]


def make_pair(size: int, seed: int = 11, settings: TrackSettings | None = None) -> Pair:
    """Draw a pair of square images.

    Args:
        size: columns and rows, px.
        seed: of the actor.
        settings: whose windows and samples to use; the defaults when left out.
    """
    settings = settings or TrackSettings()
    actor, camera = build_actor(seed), make_array(1, count=4, size=size)[1]
    renderer, triangles = ActorRenderer(actor), actor.neutral.triangles
    turned = Pose.from_rotation_vector(np.array([0.02, 0.04, 0.01]), np.array([2.0, -1.0, 1.5]))
    amounts = actor.weights(jawOpen=0.35, mouthSmile=0.5, browInnerUp=0.4)
    images = []
    for index, (weights, head) in enumerate([(0.0 * amounts, Pose.identity()), (amounts, turned)]):
        posed = actor.pose(weights, head)
        images.append(mono(renderer.render(camera, posed, Sensor(), Exposure(0, index))))
    rest = actor.neutral.vertices
    raster = Rasterizer(triangles, len(rest))
    samples = sample_surface(rest, triangles, settings.spacing_mm)
    drawn, normals = raster.render(camera, rest), facing_normals(rest, triangles)
    chosen = visible_samples(samples, rest, normals, camera, drawn, settings.min_cosine)
    rings = vertex_rings(triangles, len(rest), _RINGS)
    surface = triangles, samples.triangle[chosen], rings
    pixels = camera.project(samples.points(rest)[chosen])
    level = reference_level(
        camera, images[0], drawn, pixels, chosen, surface, settings.half_window_px
    )
    guide = turned.apply(actor.pose(_GONE * amounts, Pose.identity()).skin)
    depth = raster.render(camera, guide).depth[::2, ::2].copy()
    return Pair(
        level=level, triangles=triangles, guide=guide, image=images[1], occluders=(depth, 2.0)
    )


def run_pair(flow: FlowBackend, pair: Pair) -> tuple[dict[str, float], FlowMatches]:
    """Measure the flow of a pair once; wall milliseconds of its steps, and the refined matches."""
    every = np.ones(len(pair.level.samples), bool)
    clock = [time.perf_counter()]

    def told(name: str) -> None:
        clock.append(time.perf_counter())
        steps[name] = 1e3 * (clock[-1] - clock[-2])

    steps: dict[str, float] = {}
    view = flow.warp(pair.level, pair.triangles, pair.guide, pair.image, pair.occluders)
    told("warp_ms")
    found = flow.search(pair.level, view, every, RADIUS_PX)
    told("search_ms")
    refined = flow.refine(pair.level, view, found.displacement, ITERATIONS)
    told("refine_ms")
    steps["whole_ms"] = 1e3 * (clock[-1] - clock[0])
    _ = view.image, view.place, view.solid
    told("fetch_ms")
    return steps, refined


def difference(one: FlowMatches, other: FlowMatches) -> dict[str, float]:
    """How far two matches of the same samples lie apart."""
    matched = np.isfinite(one.displacement[:, 0]), np.isfinite(other.displacement[:, 0])
    both = matched[0] & matched[1]
    away = np.abs(one.displacement - other.displacement)[both].max(axis=1)
    return {
        "samples": len(both),
        "matched_by_one_alone": int((matched[0] != matched[1]).sum()),
        "median_px": float(np.median(away)),
        "p99_9_px": float(np.percentile(away, 99.9)),
        "within_1e-3_px": float((away < 1e-3).mean()),
        "correlation_max": float(np.abs(one.correlation - other.correlation)[both].max()),
    }


def bench(size: int, rounds: int) -> dict[str, object]:
    """Time both at one size: medians over rounds, after one that compiles."""
    pair = make_pair(size)
    GpuFlow()  # makes the context
    begun = time.perf_counter()
    card = GpuFlow([pair.level])
    sent_ms = 1e3 * (time.perf_counter() - begun)
    ways: dict[str, Callable[[], tuple[dict[str, float], FlowMatches]]] = {
        "cpu": lambda: run_pair(CpuFlow(), pair),
        "gpu": lambda: run_pair(card, pair),
    }
    line: dict[str, object] = {"device": card.device_name, "size": size}
    whole, results = {}, {}
    for name, way in ways.items():
        results[name] = way()[1]
        processor = time.process_time()
        steps = [way()[0] for _ in range(rounds)]
        medians = {key: float(np.median([step[key] for step in steps])) for key in steps[0]}
        whole[name] = medians["whole_ms"]
        line[name] = {
            **{key: round(value, 2) for key, value in medians.items()},
            "ms_per_megapixel": round(medians["whole_ms"] / (size**2 / 1e6), 2),
            "processor_ms": round(1e3 * (time.process_time() - processor) / rounds, 2),
        }
    line["level_sent_once_ms"] = round(sent_ms, 2)
    line["cpu_over_gpu"] = float(f"{whole['cpu'] / whole['gpu']:.3g}")
    line["difference"] = difference(results["cpu"], results["gpu"])
    return line


def main(arguments: Sequence[str] | None = None) -> None:
    """Print one JSON line for each size."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, nargs="*", default=[1024], help="px, of the square")
    parser.add_argument("--rounds", type=int, default=5, help="timed rounds of each")
    options = parser.parse_args(arguments)
    for size in options.size:
        print(json.dumps(bench(size, options.rounds)), flush=True)


if __name__ == "__main__":
    main()
