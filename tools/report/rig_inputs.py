"""What the page of a rig is made of: the rig, what it was before, and what it was solved on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from capture.arrays import Bools, Floats
from capture.errors import ShapeError
from rig.face_rig import FaceRig, read_rig
from rig.fit import Observations
from rig.rig_settings import RigSettings
from rig.stage import observe
from rig.template import Template, read_template
from tools.report.inputs import json_object
from track.performance import Performance

_STILL = 0.5  # of the weights' change between any two frames: beyond it neighbours are no motion
_FPS = 30.0  # frames of a motion are shown at this pace; their true one is not in the files
_STILLS_A_SECOND = 1.5


@dataclass(frozen=True, eq=False, kw_only=True)
class RigInputs:
    """A solved rig and all that one can compare it with; what is None is left out of the page.

    Attributes:
        folder: what `solve_rig` wrote.
        rig: the refined rig.
        report: what the solver says of itself.
        before: the template's shapes on the actor, before refinement, or None.
        template: the artist's shapes, or None.
        performances: what the rig was solved on, in the same order; may be empty.
        takes: a name for each performance.
        settings: of the solve.
    """

    folder: Path
    rig: FaceRig
    report: Mapping[str, Any]
    before: Template | None = None
    template: Template | None = None
    performances: tuple[Performance, ...] = ()
    takes: tuple[str, ...] = ()
    settings: RigSettings = field(default_factory=RigSettings)

    def __post_init__(self) -> None:
        told = sum(len(p.frames) for p in self.performances)
        if self.performances and told != len(self.rig.weights):
            raise ShapeError(
                f"{self.folder / 'rig.npz'}: solved on {len(self.rig.weights)} frames, but the "
                f"performances hold {told}; give the ones that it was solved on"
            )
        wanted = self.rig.deltas.shape
        for called, other in (("transferred.npz", self.before), ("template", self.template)):
            if other is not None and other.deltas.shape != wanted:
                raise ShapeError(
                    f"{self.folder / 'rig.npz'}: has (shapes, vertices) {wanted[:2]}, the "
                    f"{called} {other.deltas.shape[:2]}; they must be of one solve"
                )

    @cached_property
    def starts(self) -> list[tuple[int, str]]:
        """The first frame of each take, and its name."""
        if not self.performances:
            return [(0, "")] if len(self.rig.weights) else []
        lengths = [len(p.frames) for p in self.performances]
        begins = np.cumsum([0, *lengths[:-1]]).tolist()
        return list(zip(begins, self.takes, strict=True))

    @cached_property
    def labels(self) -> list[str]:
        """What each frame is called: its take and number there."""
        if not self.performances:
            return [f"frame {f}" for f in range(len(self.rig.weights))]
        many = len(self.performances) > 1
        return [
            f"{take} {number}" if many else f"frame {number}"
            for take, p in zip(self.takes, self.performances, strict=True)
            for number in p.frames.tolist()
        ]

    @cached_property
    def contiguous(self) -> Bools:
        """(F,) whether each frame's number follows the one before it in its take."""
        if not self.performances:
            return np.arange(len(self.rig.weights)) > 0
        return np.concatenate(
            [np.concatenate([[False], np.diff(p.frames) == 1])[: len(p.frames)]
             for p in self.performances]
        )  # fmt: skip

    @cached_property
    def is_motion(self) -> bool:
        """Whether neighbouring frames are alike, as in a film; a set of still poses is not.

        Numbers that follow each other are not enough: stills are often numbered so too. So the
        weights of neighbours must also be nearer to each other than those of frames far apart.
        """
        weights, follows = self.rig.weights, self.contiguous
        if len(weights) < 3 or follows.mean() < 0.5:
            return False
        near = np.abs(np.diff(weights, axis=0))[follows[1:]].sum(axis=1).mean()
        far = np.abs(weights - np.roll(weights, len(weights) // 2, axis=0)).sum(axis=1).mean()
        return bool(near <= _STILL * far)

    @cached_property
    def times_s(self) -> Floats:
        """(F,) when each frame is shown."""
        pace = _FPS if self.is_motion else _STILLS_A_SECOND
        times: Floats = np.arange(len(self.rig.weights)) / pace
        return times

    @cached_property
    def change_mm(self) -> Floats | None:
        """(B, V) how far refinement moved each vertex of each shape at weight 1, mm, or None."""
        if self.before is None:
            return None
        moved: Floats = np.linalg.norm(self.rig.deltas - self.before.deltas, axis=2)
        return moved

    def observations(self, frames: Sequence[int]) -> Observations:
        """What was seen at some of the frames, each for itself."""
        chosen = np.asarray(frames)
        parts = []
        for (start, _), p in zip(self.starts, self.performances, strict=True):
            own = chosen[(chosen >= start) & (chosen < start + len(p.frames))] - start
            parts.append(
                replace(
                    p,
                    vertices=p.vertices[own], confidence=p.confidence[own], frames=p.frames[own],
                    head_from_neutral=p.head_from_neutral[own], reference=p.reference[own],
                )
            )  # fmt: skip
        seen = observe(parts)
        return replace(seen, contiguous=np.zeros(len(chosen), dtype=bool))


def read_rig_inputs(
    folder: Path,
    *,
    template: Template | None = None,
    performances: Sequence[Performance] = (),
    takes: Sequence[str] = (),
    settings: RigSettings | None = None,
) -> RigInputs:
    """Read what `solve_rig` wrote into a folder, beside what it was made of.

    Raises:
        InputError: naming what is missing, damaged, or of another solve.
    """
    transferred = folder / "transferred.npz"
    return RigInputs(
        folder=folder,
        rig=read_rig(folder / "rig.npz"),
        report=json_object(folder / "report.json"),
        before=read_template(transferred) if transferred.is_file() else None,
        template=template,
        performances=tuple(performances),
        takes=tuple(takes) or tuple(f"take {i + 1}" for i in range(len(performances))),
        settings=settings or RigSettings(),
    )
