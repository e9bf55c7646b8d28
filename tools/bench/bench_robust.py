"""Stereo under faults of the array: what each costs, and whether the scan says so.

    python -m tools.bench.bench_robust TAKE [FRAME] --score SCORE_SCAN.py [--only WORDS]

Faults are put into the images and cameras of one frame of a visiting take: devices removed, one out
of focus, highlights clipped, gains off, calibration off. `--score` names a script called with TAKE
FRAME SCAN that prints one JSON line, such as score_scan.py. One JSON object a fault: the score, the
report's warnings, the devices they name rightly (`named`), those at fault that they do not name
(`silent`), those named without fault (`blamed`), and whether the fault was told at all (`told`).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from capture.arrays import Image
from capture.camera import CameraArray
from capture.errors import LikenessError
from recon.scan import reconstruct_images
from recon.surface import write_ply
from tools.bench.bench_stereo import Instant, load_instant

_BLUR_PX, _CLIPPED, _GAIN, _SHIFT_PX, _GONE, _SEED = 3.0, 0.10, 0.30, 0.3, 4, 17


@dataclass(frozen=True, eq=False)
class Fault:
    """One fault of an array.

    Attributes:
        words: what it is.
        apply: the instant with the fault in it.
        devices: those at fault; every one of the array for a fault that all share.
    """

    words: str
    apply: Callable[[Instant], Instant]
    devices: tuple[str, ...] = ()


def faults(names: Sequence[str]) -> list[Fault]:
    """The faults an array of these devices is tried with, "none" first."""
    rng = np.random.default_rng(_SEED)
    every, count, middle = tuple(names), len(names), len(names) // 2
    some = rng.choice(count, _GONE, replace=False) if count > _GONE else np.zeros(0, np.int64)
    choices = {
        "scattered": [names[index] for index in sorted(some.tolist())],
        "from the middle": list(names[middle - 2 : middle + 2]),
        "from the ends": [*names[:2], *names[-2:]],
    }
    cases = [Fault("none", lambda instant: instant)]
    for words, gone in choices.items():
        cases.append(Fault(f"{_GONE} removed {words}", _without(gone), tuple(gone)))
    one, three = names[middle - 2], (names[1], names[middle + 2], names[-2])
    cases.append(Fault("one out of focus", lambda instant: blurred(instant, one), (one,)))
    cases.append(Fault("highlights clipped", clipped, every))
    cases.append(Fault("gain off on three", lambda instant: unequal(instant, three), three))
    for axis, (words, step) in enumerate((("columns", (1.0, 0.0)), ("rows", (0.0, 1.0)))):
        shift = {names[middle + axis]: _SHIFT_PX * np.array(step)}
        cases.append(Fault(f"one shifted along {words}", _shifted_by(shift), tuple(shift)))
    random = {name: _SHIFT_PX * direction for name, direction in _directions(names, rng).items()}
    cases.append(Fault("all shifted", _shifted_by(random), every))
    return cases


def removed(instant: Instant, gone: Sequence[str]) -> Instant:
    """Without the images of some devices."""
    kept = {name: image for name, image in instant.images.items() if name not in gone}
    return replace(instant, images=kept)


def blurred(instant: Instant, name: str) -> Instant:
    """With one device out of focus by a Gaussian of 3 px."""
    soft = cv2.GaussianBlur(instant.images[name], (0, 0), _BLUR_PX)
    return replace(instant, images={**instant.images, name: soft})


def clipped(instant: Instant) -> Instant:
    """With all exposures raised until a tenth of what is lit clips at the greatest code."""
    lit = [image[image > _threshold(image)] for image in instant.images.values()]
    level = float(np.quantile(np.concatenate(lit), 1.0 - _CLIPPED))
    images = {
        name: _scaled(image, np.iinfo(image.dtype).max / level)
        for name, image in instant.images.items()
    }
    return replace(instant, images=images)


def unequal(instant: Instant, names: Sequence[str]) -> Instant:
    """With the gain of some devices off by 30 %, by turns darker and brighter."""
    images = dict(instant.images)
    for turn, name in enumerate(names):
        images[name] = _scaled(images[name], 1.0 - _GAIN if turn % 2 == 0 else 1.0 + _GAIN)
    return replace(instant, images=images)


def shifted(instant: Instant, steps_px: Mapping[str, Any]) -> Instant:
    """With the principal points of some devices off by (column, row) steps."""
    cameras = []
    for camera in instant.cameras:
        across, down = steps_px.get(camera.name, (0.0, 0.0))
        cameras.append(replace(camera, cx=camera.cx + across, cy=camera.cy + down))
    return replace(instant, cameras=CameraArray(tuple(cameras)))


def verdict(fault: Fault, warnings: Sequence[str], names: Sequence[str]) -> dict[str, Any]:
    """Whom the warnings name, rightly and wrongly; one for many devices names those at fault."""
    heads = [warning.partition(":")[0] for warning in warnings]
    shared = any(head.endswith(" cameras") for head in heads)
    mentioned = {name for name in names if any(name in head.split(", ") for head in heads)}
    at_fault = set(fault.devices)
    named = at_fault if shared and len(at_fault) == len(names) else at_fault & mentioned
    return {
        "told": bool(named) == bool(at_fault) if at_fault else not heads,
        "named": sorted(named),
        "silent": sorted(at_fault - named),
        "blamed": sorted(mentioned - at_fault),
    }


def main() -> None:
    """Scan one frame under each fault and print a JSON object a line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("take", type=Path)
    parser.add_argument("frame", type=int, nargs="?", default=0)
    parser.add_argument("--score", type=Path, help="script called with TAKE FRAME SCAN")
    parser.add_argument("--only", default="", help="only faults whose name holds these words")
    arguments = parser.parse_args()
    instant = load_instant(arguments.take, arguments.frame)
    for fault in faults(instant.cameras.names):
        if arguments.only in fault.words:
            print(json.dumps(_row(fault, instant, arguments)), flush=True)


def _row(fault: Fault, instant: Instant, arguments: argparse.Namespace) -> dict[str, Any]:
    row: dict[str, Any] = {"fault": fault.words, "devices": list(fault.devices)}
    bad = fault.apply(instant)
    try:
        result = reconstruct_images(bad.cameras, bad.images)
    except LikenessError as error:  # a refusal names the fault too
        return {**row, "refused": str(error)}
    warnings = result.report["warnings"]
    row |= verdict(fault, warnings, instant.cameras.names)
    row["warnings"] = warnings
    row["agreement_p95_mm"] = result.report["agreement_p95_mm"]
    if arguments.score:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "scan.ply"
            write_ply(path, result.scan)
            words = [arguments.score, arguments.take, arguments.frame, path]
            done = subprocess.run(
                [sys.executable, *map(str, words)], check=True, capture_output=True, text=True
            )
        row["score"] = json.loads(done.stdout.splitlines()[-1])
    return row


def _without(gone: Sequence[str]) -> Callable[[Instant], Instant]:
    return lambda instant: removed(instant, gone)


def _shifted_by(steps_px: Mapping[str, Any]) -> Callable[[Instant], Instant]:
    return lambda instant: shifted(instant, steps_px)


def _directions(names: Sequence[str], rng: np.random.Generator) -> dict[str, Any]:
    """A unit step in a random direction for each device."""
    angles = rng.uniform(0.0, 2.0 * np.pi, len(names))
    return {name: np.array([np.cos(a), np.sin(a)]) for name, a in zip(names, angles, strict=True)}


def _threshold(image: Image) -> float:
    """Between the ground and what is lit, by Otsu's method on the upper eight bits."""
    shift = 8 * (image.dtype.itemsize - 1)
    level, _ = cv2.threshold((image >> shift).astype(np.uint8), 0, 255, cv2.THRESH_OTSU)
    return float((level + 1) * (1 << shift) - 1)  # above it, whatever the lower bits


def _scaled(image: Image, factor: float) -> Image:
    top = np.iinfo(image.dtype).max
    scaled: Image = np.clip(np.rint(image * factor), 0, top).astype(image.dtype)
    return scaled


if __name__ == "__main__":
    main()
