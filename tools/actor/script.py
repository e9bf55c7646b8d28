"""What happens before the cameras, and when: shots of a board or of the face, in virtual time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from capture.errors import SettingsError, raise_all
from capture.pose import Pose

_GOLDEN = 0.6180339887498949
_VOLUME_CENTRE = np.array([0.0, -12.0, 45.0])
_FACING_DEGREES = 52.0  # how far to either side boards face


@dataclass(frozen=True, kw_only=True)
class Act:
    """One shot as the scene plays it.

    Attributes:
        slate: its name.
        kind: "board" or "face".
        start_ns: of its first trigger.
        end_ns: of its last trigger; the face is neutral at both.
        weights: amplitude of each shape at the height of the expression; `eyeBlink` means both
            sides. Only a face has them.
        hold_ns: for how long a board is held still; from trigger to trigger.
        motion: how far the head moves, 1 for a few degrees and millimetres, 0 for not at all.
    """

    slate: str
    kind: str
    start_ns: int
    end_ns: int
    weights: Mapping[str, float] = field(default_factory=dict)
    hold_ns: int = 100_000_000
    motion: float = 1.0

    def __post_init__(self) -> None:
        problems = []
        if self.kind not in ("board", "face"):
            problems.append(f'kind must be "board" or "face", found {self.kind!r}')
        if self.end_ns < self.start_ns:
            problems.append(
                f"end_ns must not lie before start_ns = {self.start_ns}, found {self.end_ns}"
            )
        if self.hold_ns < 1:
            problems.append(f"hold_ns must be above 0, found {self.hold_ns}")
        if self.kind == "board" and self.weights:
            problems.append("a board has no weights")
        if not 0.0 <= self.motion <= 10.0:
            problems.append(f"motion must lie in 0..10, found {self.motion}")
        raise_all(f"act {self.slate!r}", problems, SettingsError)

    def phase(self, t_ns: int) -> float:
        """Where in the act a time lies: 0 at its start or before, 1 at its end or after."""
        length = self.end_ns - self.start_ns
        return float(np.clip((t_ns - self.start_ns) / length, 0.0, 1.0)) if length else 0.0


@dataclass(frozen=True)
class Script:
    """Acts in order of time."""

    acts: tuple[Act, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "acts", tuple(self.acts))
        if not self.acts:
            raise SettingsError("script: expected at least one act, found none")
        for before, after in zip(self.acts[:-1], self.acts[1:], strict=True):
            if after.start_ns <= before.end_ns:
                raise SettingsError(
                    f"script: act {after.slate!r} must start after {before.slate!r} ends at "
                    f"{before.end_ns} ns, found {after.start_ns} ns"
                )

    def at(self, t_ns: int) -> Act:
        """The act that plays at a time: in a gap, whichever of the two is nearer."""
        return min(self.acts, key=lambda act: max(act.start_ns - t_ns, t_ns - act.end_ns))

    def by_slate(self, slate: str) -> Act:
        """The act called `slate`.

        Raises:
            SettingsError: naming the acts there are.
        """
        for act in self.acts:
            if act.slate == slate:
                return act
        raise SettingsError(
            f"script: no act {slate!r}; there are {', '.join(act.slate for act in self.acts)}"
        )


@dataclass(frozen=True, kw_only=True)
class Plan:
    """One act before it has a time: slate, kind, frames, and amplitudes of shapes."""

    slate: str
    kind: str
    frames: int
    weights: Mapping[str, float] = field(default_factory=dict)
    motion: float = 1.0


def make_script(
    plans: Sequence[Plan],
    *,
    period_ns: int,
    start_ns: int = 1_000_000_000,
    gap_ns: int = 2_000_000_000,
) -> Script:
    """Lay acts out in time, so that each one's triggers begin and end it exactly.

    Args:
        plans: what to play, in order.
        period_ns: from trigger to trigger.
        start_ns: of the first act's first trigger.
        gap_ns: from the last trigger of an act to the first of the next.
    """
    acts, at_ns = [], start_ns
    for plan in plans:
        end_ns = at_ns + (plan.frames - 1) * period_ns
        acts.append(Act(slate=plan.slate, kind=plan.kind, start_ns=at_ns, end_ns=end_ns,
                        weights=plan.weights, hold_ns=period_ns, motion=plan.motion))  # fmt: skip
        at_ns = end_ns + gap_ns
    return Script(tuple(acts))


def expression_amount(phase: float) -> float:
    """How much of the expression shows: sin^2, exactly neutral at both ends."""
    return float(np.sin(np.pi * phase) ** 2) if 0.0 < phase < 1.0 else 0.0


def head_pose(phase: float, motion: float) -> Pose:
    """world_from_head: a smooth nod and turn that leaves the identity and comes back to it."""
    if motion == 0.0 or not 0.0 < phase < 1.0:
        return Pose.identity()
    rise, sway = np.sin(np.pi * phase) ** 2, np.sin(2.0 * np.pi * phase) * np.sin(np.pi * phase)
    turn = np.array([0.06 * rise, 0.08 * sway, 0.035 * sway]) * motion
    return Pose.from_rotation_vector(turn, np.array([2.5 * sway, 1.5 * rise, -2.0 * rise]) * motion)


def board_pose(index: int, seed: int, size_mm: tuple[float, float]) -> Pose:
    """world_from_board of the index-th way to hold a board: facing all about, tilted up to 45 deg.

    Args:
        index: which way; neighbours face far apart.
        seed: of the whole series.
        size_mm: width and height of the pattern.
    """
    random = np.random.default_rng([abs(seed), 43, index])
    spread = (random.uniform(0.0, 0.15) + _GOLDEN * index) % 1.0
    azimuth = np.radians(_FACING_DEGREES * (2.0 * spread - 1.0))
    elevation = np.radians(random.uniform(-12.0, 24.0))
    facing = Pose.from_rotation_vector(np.array([0.0, azimuth, 0.0]), np.zeros(3))
    facing = facing @ Pose.from_rotation_vector(np.array([-elevation, 0.0, 0.0]), np.zeros(3))
    about = random.uniform(0.0, 2.0 * np.pi)
    tilt = np.radians(random.uniform(0.0, 45.0) if index % 4 else 0.0)
    lean = np.array([np.cos(about), np.sin(about), 0.0]) * tilt
    facing = facing @ Pose.from_rotation_vector(lean, np.zeros(3))
    roll = np.array([0.0, 0.0, np.radians(random.uniform(-35.0, 35.0) + 90.0 * (index % 3 == 2))])
    facing = facing @ Pose.from_rotation_vector(roll, np.zeros(3))
    flip = np.diag([1.0, -1.0, -1.0])  # board +Y runs down and +Z into the board
    rotation = facing.rotation @ flip
    middle = _VOLUME_CENTRE + random.uniform([-50.0, -50.0, -45.0], [50.0, 50.0, 45.0])
    return Pose(rotation, middle - rotation @ np.array([0.5 * size_mm[0], 0.5 * size_mm[1], 0.0]))
