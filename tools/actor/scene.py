"""`ActorScene`: what the simulated devices look at, and the truth about it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from capture.arrays import Floats, Image
from capture.camera import Camera
from capture.errors import SettingsError, raise_all
from capture.pose import Pose
from recon.board.charuco import Board
from tools.actor.board_renderer import BoardRenderer
from tools.actor.canvas import Canvas
from tools.actor.model import ActorModel, PosedActor, build_actor, named_weights
from tools.actor.renderer import ActorRenderer
from tools.actor.script import Act, Script, board_pose, expression_amount, head_pose
from tools.actor.sensor import Sensor, expose, make_sensors

DEMO_BOARD = Board(
    squares_x=12, squares_y=9, square_mm=20.0, marker_mm=15.0, dictionary="DICT_5X5_1000"
)
_KEYS = ("actor", "acts", "board", "seed", "supersample")


@dataclass(frozen=True, eq=False, kw_only=True)
class SceneSettings:
    """What a scene is made of.

    Attributes:
        script: what happens and when.
        actor: seed of the identity; None for the generic head.
        board: the board of the board acts.
        seed: of sensors, noise and board poses.
        supersample: samples along each side of a pixel.
        sensor: the sensor of every device; None for a little different one each.
    """

    script: Script
    actor: int | None = 7
    board: Board = field(default=DEMO_BOARD)
    seed: int = 0
    supersample: int = 2
    sensor: Sensor | None = None


class ActorScene:
    """The actor or a board, as a script has it, seen by any camera at any time.

    Implements `capture.devices.simulated.Scene`.
    """

    def __init__(self, settings: SceneSettings) -> None:
        """Build the actor; nothing is drawn yet.

        Args:
            settings: the script, the actor, the board.

        Raises:
            SettingsError: when the script names a shape that the actor does not have.
        """
        self.settings = settings
        self.model: ActorModel = build_actor(settings.actor)
        self._amplitudes = {
            act.slate: named_weights(self.model.names, dict(act.weights))
            for act in settings.script.acts
        }
        self._canvas: Canvas | None = None
        self._face: ActorRenderer | None = None
        self._board: BoardRenderer | None = None
        self._sensors: dict[str, Sensor] = {}
        self._last: tuple[int, PosedActor] | None = None

    def render(self, camera: Camera, t_ns: int) -> Image:
        """The image that `camera` takes at the true time `t_ns`, noise included: (H, W) uint8."""
        act = self.settings.script.at(t_ns)
        if self._canvas is None:
            self._canvas = Canvas(self.settings.supersample)
        if act.kind == "board":
            if self._board is None:
                self._board = BoardRenderer(self.settings.board, self._canvas)
            radiance = self._board.radiance(camera, self.board_truth(t_ns))
        else:
            radiance = self.face_renderer().radiance(camera, self.truth(t_ns))
        return expose(radiance, self._sensor(camera.name), (self.settings.seed, camera.name, t_ns))

    def face_renderer(self) -> ActorRenderer:
        """The renderer of the face, for depth and albedo."""
        if self._canvas is None:
            self._canvas = Canvas(self.settings.supersample)
        if self._face is None:
            self._face = ActorRenderer(self.model, self._canvas)
        return self._face

    def weights(self, t_ns: int) -> Floats:
        """(B,) true weights at a time; 0 during a board act."""
        act = self.settings.script.at(t_ns)
        return self._amplitudes[act.slate] * expression_amount(act.phase(t_ns))

    def truth(self, t_ns: int) -> PosedActor:
        """The true surface, weights and head motion at a time."""
        if self._last is None or self._last[0] != t_ns:
            act = self.settings.script.at(t_ns)
            head = head_pose(act.phase(t_ns), act.motion if act.kind == "face" else 0.0)
            self._last = (t_ns, self.model.pose(self.weights(t_ns), head))
        return self._last[1]

    def board_truth(self, t_ns: int) -> Pose:
        """world_from_board at a time of a board act: still about each trigger."""
        act = self.settings.script.at(t_ns)
        index = round((t_ns - act.start_ns) / act.hold_ns)
        board = self.settings.board
        size = (board.squares_x * board.square_mm, board.squares_y * board.square_mm)
        return board_pose(max(index, 0), self.settings.seed, size)

    def _sensor(self, name: str) -> Sensor:
        if self.settings.sensor is not None:
            return self.settings.sensor
        if name not in self._sensors:
            self._sensors |= make_sensors(self.settings.seed, [name])
        return self._sensors[name]


def open_scene(spec: str | Mapping[str, Any]) -> ActorScene:
    """Open a scene from its description: the entry point `likeness.scenes`.

    Args:
        spec: keys `acts` (a list of tables with the fields of `Act`), and optionally `actor`,
            `board` (the fields of `recon.board.charuco.Board`), `seed`, `supersample`; as a
            mapping, as JSON text, or as the path of a JSON file.

    Raises:
        SettingsError: naming what does not fit.
    """
    table, where = _table(spec)
    unknown = sorted(set(table) - set(_KEYS))
    problems = [f"{key}: unknown; known are {', '.join(_KEYS)}" for key in unknown]
    if not isinstance(table.get("acts"), list):
        problems.append(f"acts: expected a list of acts, found {type(table.get('acts')).__name__}")
    raise_all(where, problems, SettingsError)
    try:
        acts = tuple(Act(**act) for act in table["acts"])
        board = Board(**table["board"]) if "board" in table else DEMO_BOARD
        settings = SceneSettings(
            script=Script(acts), actor=table.get("actor", 7), board=board,
            seed=int(table.get("seed", 0)), supersample=int(table.get("supersample", 2)),
        )  # fmt: skip
    except (TypeError, ValueError) as error:
        raise SettingsError(f"{where}: {error}") from error
    return ActorScene(settings)


def _table(spec: str | Mapping[str, Any]) -> tuple[Mapping[str, Any], str]:
    if isinstance(spec, Mapping):
        return spec, "scene"
    text, where = spec, "scene"
    if not spec.lstrip().startswith("{"):
        where = spec
        try:
            text = Path(spec).read_text(encoding="utf-8")
        except OSError as error:
            raise SettingsError(f"{spec}: not readable: {error.strerror}") from error
    try:
        table = json.loads(text)
    except ValueError as error:
        raise SettingsError(f"{where}: expected JSON: {error}") from error
    if not isinstance(table, dict):
        raise SettingsError(f"{where}: expected a table, found {type(table).__name__}")
    return table, where


def act_times(act: Act) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Trigger times (F,) of an act, ns, first and last included."""
    count = round((act.end_ns - act.start_ns) / act.hold_ns) + 1
    return act.start_ns + act.hold_ns * np.arange(count, dtype=np.int64)
