"""A contact sheet of one actor for a person to look at: `python -m tools.actor.sheet OUT.png`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from capture.arrays import Floats, Image
from capture.camera import Camera
from capture.errors import LikenessError
from capture.pose import Pose
from capture.product import replacing
from tools.actor.array import camera_at
from tools.actor.model import ActorModel, build_actor, named_weights
from tools.actor.renderer import ActorRenderer, Exposure
from tools.actor.sensor import Sensor

_VIEWS: tuple[tuple[float, float], ...] = (
    (-80.0, 2.0),
    (-40.0, 5.0),
    (0.0, 2.0),
    (25.0, -8.0),
    (40.0, 5.0),
)
_EXPRESSIONS: tuple[tuple[str, dict[str, float]], ...] = (
    ("eyeBlink", {"eyeBlink": 1.0}),
    ("jawOpen", {"jawOpen": 1.0}),
    ("mouthSmile", {"mouthSmile": 1.0, "cheekSquint": 0.6}),
    ("smile, jaw", {"mouthSmile": 0.9, "jawOpen": 0.4, "eyeSquint": 0.5}),
    ("mouthFrown", {"mouthFrown": 1.0, "browDown": 0.5}),
    ("mouthPucker", {"mouthPucker": 1.0}),
    ("mouthFunnel", {"mouthFunnel": 1.0, "jawOpen": 0.25}),
    ("cheekPuff", {"cheekPuff": 1.0}),
    ("browInnerUp", {"browInnerUp": 1.0, "browOuterUp": 0.8, "eyeWide": 1.0}),
    ("browDown", {"browDown": 1.0, "eyeSquint": 0.6, "noseSneer": 0.7}),
    ("mouthLeft", {"mouthLeft": 1.0}),
    ("jawRight", {"jawRight": 1.0, "jawOpen": 0.2}),
    ("upper, lower", {"mouthUpperUp": 1.0, "mouthLowerDown": 1.0}),
    ("mouthStretch", {"mouthStretch": 1.0}),
    ("mouthClose", {"jawOpen": 0.6, "mouthClose": 0.6}),
    ("roll", {"mouthRollLower": 1.0, "mouthRollUpper": 1.0}),
    ("shrug", {"mouthShrugUpper": 0.7, "mouthShrugLower": 1.0}),
    ("one side", {"mouthSmileLeft": 1.0, "eyeBlinkLeft": 1.0, "browOuterUpRight": 1.0}),
    ("gaze", {"eyeLookDown": 1.0}),
    ("gaze aside", {"eyeLookOutLeft": 0.8, "eyeLookInRight": 0.8}),
)
_COLUMNS = 5


def contact_sheet(actor: ActorModel, size: int = 320) -> Image:
    """Draw an actor from five sides, close up, and in twenty expressions.

    Args:
        actor: the model.
        size: side of each picture, px.

    Returns:
        (H, W) uint8.
    """
    renderer = ActorRenderer(actor)
    middle, face = np.array([0.0, -8.0, 20.0]), np.array([0.0, -22.0, 80.0])
    eye, lips, cheek = np.array([[29.0, 10.0, 75.0], [0.0, -50.0, 90.0], [45.0, -20.0, 60.0]])
    close = ((0.0, 1.9, face), (30.0, 1.9, face), (20.0, 4.5, eye), (15.0, 4.0, lips),
             (40.0, 4.0, cheek))  # fmt: skip
    tiles = []
    for azimuth, elevation in _VIEWS:
        tiles.append(_tile(renderer, {}, camera_at(middle, azimuth, elevation, size), ""))
    for azimuth, zoom, target in close:
        tiles.append(_tile(renderer, {}, camera_at(target, azimuth, 3.0, size, zoom), ""))
    for title, amplitudes in _EXPRESSIONS:
        tiles.append(_tile(renderer, amplitudes, camera_at(face, 12.0, 2.0, size, 1.45), title))
    rows = [np.hstack(tiles[k : k + _COLUMNS]) for k in range(0, len(tiles), _COLUMNS)]
    return np.vstack(rows)


def _tile(
    renderer: ActorRenderer, amplitudes: dict[str, float], camera: Camera, title: str
) -> Image:
    weights: Floats = named_weights(renderer.model.names, amplitudes)
    posed = renderer.model.pose(weights, Pose.identity())
    image = renderer.render(camera, posed, Sensor(), Exposure())
    if title:
        cv2.putText(image, title, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (230,), 1, cv2.LINE_AA)
    return image


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the sheet; returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.actor.sheet", description="Draw the simulated actor's contact sheet."
    )
    parser.add_argument("out", type=Path, help="PNG to write")
    parser.add_argument("--seed", type=int, default=None, help="identity; the generic head without")
    parser.add_argument("--size", type=int, default=320, help="side of each picture, px")
    given = parser.parse_args(arguments)
    try:
        image = contact_sheet(build_actor(given.seed), given.size)
        with replacing(given.out) as partial:
            partial.write_bytes(cv2.imencode(".png", image)[1].tobytes())
    except LikenessError as error:
        print(error, file=sys.stderr)
        return error.exit_status
    return 0


if __name__ == "__main__":
    sys.exit(main())
