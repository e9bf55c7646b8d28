"""What a device shall do wrong."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from enum import StrEnum


class Resend(StrEnum):
    """How requests for packets are answered."""

    ANSWER = "answer"
    SILENT = "silent"  # not at all
    UNAVAILABLE = "unavailable"  # by saying that the packet is gone
    WRONG_FRAME = "wrong_frame"  # the packet, under the number of the next frame to be sent
    WRONG_DATA = "wrong_data"  # under the right numbers, what another packet holds


class Defect(StrEnum):
    """What can be planned for a trigger or a frame to come."""

    IGNORE = "ignore"  # a trigger is not answered
    LOSE = "lose"  # a frame is exposed and numbered, and never sent
    DROP = "drop"  # some packets of a frame are not sent at first
    REPEAT = "repeat"  # a frame is sent twice


@dataclass(frozen=True)
class _Plan:
    defect: Defect
    first: int
    last: int
    packets: frozenset[int]


@dataclass
class Faults:
    """What is wrong now, and what is planned.

    Attributes:
        dead: neither answers nor sends; it goes on exposing.
        busy: answers no trigger.
        resend: how requests for packets are answered.
        mute_actions: so many action commands are carried out and not acknowledged.
    """

    dead: bool = False
    busy: bool = False
    resend: Resend = Resend.ANSWER
    mute_actions: int = 0
    _plans: list[_Plan] = field(default_factory=list)

    def plan(self, defect: Defect, first: int, count: int, packets: Collection[int]) -> None:
        """Plan a defect.

        Args:
            defect: what shall go wrong.
            first: number of the trigger or frame, counted from 0 since the device was switched on.
            count: with how many in a row.
            packets: which are dropped.
        """
        self._plans.append(_Plan(defect, first, first + count - 1, frozenset(packets)))

    def due(self, defect: Defect, number: int) -> bool:
        """Whether a defect is planned for a trigger or frame."""
        return any(p.defect is defect and p.first <= number <= p.last for p in self._plans)

    def dropped(self, number: int) -> frozenset[int]:
        """Which packets of a frame are not sent at first."""
        plans = [p for p in self._plans if p.defect is Defect.DROP and p.first <= number <= p.last]
        return frozenset().union(*(plan.packets for plan in plans))
