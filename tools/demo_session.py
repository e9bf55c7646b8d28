"""The demo's session: what is recorded, the simulated array and actor, and the truth beside it."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from capture.camera import CameraArray
from capture.devices.simulated import simulated_array
from capture.documents import write_json
from capture.errors import InputError
from capture.progress import Progress, silent
from capture.recorder import RecordSettings
from capture.session import Session, Shot, record_take
from capture.settings import check_ranges
from capture.take import Take
from tools.actor.array import make_array
from tools.actor.scene import ActorScene, SceneSettings, act_times
from tools.actor.script import Act, Plan, make_script
from tools.actor.truth import write_truth

BOARD = "board"
NEUTRAL = "neutral"
EXPRESSIONS: Mapping[str, Mapping[str, float]] = {
    "smile": {"mouthSmile": 0.9, "cheekSquint": 0.6, "eyeSquint": 0.3},
    "shout": {"jawOpen": 0.75, "browInnerUp": 0.8, "browOuterUp": 0.6},
    "sneer": {"mouthPucker": 0.7, "noseSneer": 0.8, "browDown": 0.7, "eyeBlink": 1.0},
}
"""By slate, the amplitude of each shape at the height of the expression."""


@dataclass(frozen=True, kw_only=True)
class DemoSettings:
    """Settings of the demo."""

    seed: int = 4
    """Which actor, array and noise."""
    size_px: int = 640
    """Rows and columns of the square images."""
    board_frames: int = 16
    """Poses of the calibration board."""
    expression_frames: int = 9
    """Frames of each expression, neutral to neutral."""
    rate_hz: float = 12.0
    """Triggers a second."""

    def __post_init__(self) -> None:
        check_ranges(
            "demo", self, seed=(0, float("inf")), size_px=(256, 4096), board_frames=(8, 200),
            expression_frames=(4, 1000), rate_hz=(1, 500),
        )  # fmt: skip


def record_session(
    folder: Path, settings: DemoSettings, *, progress: Progress = silent
) -> tuple[Session, CameraArray]:
    """Record a board take, a neutral and the expressions; takes that are there are kept.

    The truth goes to FOLDER/truth/<slate>, which no stage reads.

    Args:
        folder: the session's folder.
        settings: of the demo.
        progress: told of every frame.

    Returns:
        The session and the true array, for error figures alone.

    Raises:
        InputError: when the folder holds a session recorded with other settings.
    """
    session = Session.create(folder, f"actor {settings.seed}")
    _keep_settings(folder / "demo.json", settings)
    period_ns = RecordSettings(rate_hz=settings.rate_hz).period_ns
    plans = [
        Plan(slate=BOARD, kind="board", frames=settings.board_frames),
        Plan(slate=NEUTRAL, kind="face", frames=2, motion=0.0),
        *(
            Plan(slate=slate, kind="face", frames=settings.expression_frames, weights=weights)
            for slate, weights in EXPRESSIONS.items()
        ),
    ]
    script = make_script(plans, period_ns=period_ns)
    scene = ActorScene(SceneSettings(script=script, actor=settings.seed, seed=settings.seed))
    true_array = make_array(settings.seed, size=settings.size_px)
    devices = simulated_array(true_array, scene, seed=settings.seed)
    recorded = {note.slate for note in session.takes()}
    for act in script.acts:
        if act.slate in recorded:
            continue
        record_take(
            session, _shot(act), devices, RecordSettings(rate_hz=settings.rate_hz),
            progress=progress,
        )  # fmt: skip
        if act.kind == "face":
            depths = (0,) if act.slate == NEUTRAL else ()
            write_truth(folder / "truth" / act.slate, scene, true_array, act_times(act), depths)
    return session, true_array


def peak_frame(take: Take) -> int:
    """The frame at the height of an expression that starts and ends in the neutral."""
    return take.frames[len(take.frames) // 2]


def _shot(act: Act) -> Shot:
    kind = "board" if act.kind == "board" else "expression" if act.weights else "neutral"
    return Shot(slate=act.slate, kind=kind, frames=len(act_times(act)), start_ns=act.start_ns)


def _keep_settings(path: Path, settings: DemoSettings) -> None:
    document = dataclasses.asdict(settings)
    if path.exists():
        found = json.loads(path.read_text(encoding="utf-8"))
        if found != document:
            raise InputError(
                f"{path.parent}: recorded with {found}, asked for {document}; "
                "choose another --out, or remove that folder"
            )
        return
    write_json(path, document)
