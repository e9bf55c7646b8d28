"""Faults of devices that are played: what can go wrong at a trigger, and how it is done.

A `FaultBook` stands between what a device would send and what it sends. It holds the faults that
are planned, takes more while frames stream, and keeps what they leave behind: numbers and clocks
that are shifted, a device that is dead.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple, Protocol, runtime_checkable

from capture.errors import SettingsError

_NEXT = (None, -1)  # as a fault's edge: whichever comes next
_BELOW_WRAP = 3  # a number that jumps stops so many short of the highest


class FaultKind(StrEnum):
    """What can go wrong at one trigger."""

    LOSE_FRAME = "lose_frame"  # exposed and numbered, never delivered
    MISS_TRIGGER = "miss_trigger"  # not exposed, not numbered
    DUPLICATE = "duplicate"  # delivered twice
    STALE = "stale"  # the frame of two triggers ago is delivered once more, after the new one
    INCOMPLETE = "incomplete"  # a packet is lost: delivered with parts missing
    CLOCK_STEP = "clock_step"  # the device's clock jumps by `amount_ns`, from here on
    CLOCK_DRIFT = "clock_drift"  # the clock runs faster by `drift_ppm` than before, from here on
    ID_RESET = "id_reset"  # the device's numbers begin again at the number after the highest
    ID_JUMP = "id_jump"  # the numbers jump to just below where 16 bits wrap
    FREEZE = "freeze"  # silent for `triggers`, which are exposed and numbered; then it goes on
    DEATH = "death"  # silent for good, until it is reconnected: then it begins anew


_SUDDEN = frozenset(
    {
        FaultKind.CLOCK_STEP,
        FaultKind.CLOCK_DRIFT,
        FaultKind.ID_RESET,
        FaultKind.ID_JUMP,
        FaultKind.DEATH,
    }
)


@dataclass(frozen=True)
class Fault:
    """One thing that goes wrong.

    Attributes:
        kind: what.
        edge: at which trigger since the device was started, from 0; None or -1: at the next.
        amount_ns: how far a clock steps.
        drift_ppm: how much faster a clock runs than before, millionths; -1000 to 1000.
        triggers: how many in a row are hit; clocks, numbers and deaths change once, at the first.
    """

    kind: FaultKind
    edge: int | None = None
    amount_ns: int = 0
    drift_ppm: float = 0.0
    triggers: int = 1

    def __post_init__(self) -> None:
        if self.edge is not None and self.edge < -1:
            raise SettingsError(
                f"a fault's edge is counted from 0, or None or -1 for the next one, "
                f"found {self.edge}"
            )
        if self.triggers < 1:
            raise SettingsError(f"a fault hits at least 1 trigger, found {self.triggers}")
        if not abs(self.drift_ppm) <= 1000:
            raise SettingsError(f"drift_ppm must lie in -1000..1000, found {self.drift_ppm}")

    def hits(self, edge: int) -> bool:
        """Whether this happens at that trigger."""
        first = self.edge or 0
        return edge == first or (self.kind not in _SUDDEN and first <= edge < first + self.triggers)


@runtime_checkable
class Faulty(Protocol):
    """A device with which things go wrong on request, while it streams."""

    def inject(self, fault: Fault) -> None:
        """Let something go wrong at the trigger that the fault names, once.

        Raises:
            SettingsError: when that trigger has passed.
        """


class Exposure(NamedTuple):
    """One exposure as the device itself knows it.

    Attributes:
        place: which one: trigger of the device or of the recording that it plays.
        t_ns: true time of its start, by the host's clock.
        number: that the device gives it, before it is cut to the width of a frame number.
        t_dev_ns: start by the device's clock.
        exposure_us: how long.
        complete: False when parts are missing.
    """

    place: int
    t_ns: int
    number: int
    t_dev_ns: int
    exposure_us: float
    complete: bool = True


class Outcome(NamedTuple):
    """What becomes of a trigger.

    Attributes:
        exposed: whether the device exposed.
        sent: the exposures that it sends, in order.
    """

    exposed: bool
    sent: tuple[Exposure, ...] = ()


class FaultBook:
    """Turns what a device would send into what it sends. Not safe from several threads at once."""

    def __init__(self, id_bits: int, wraps_to: int = 1, planned: tuple[Fault, ...] = ()) -> None:
        """Open a book.

        Args:
            id_bits: width of the device's frame numbers.
            wraps_to: the number after the highest.
            planned: what goes wrong after every start.
        """
        self._highest, self._wraps_to = (1 << id_bits) - 1, wraps_to
        self._planned = tuple(_at(fault, 0) for fault in planned)
        self._extra: list[Fault] = []
        self._history: deque[Exposure] = deque(maxlen=3)
        self._shift = 0  # of the numbers
        self._next_number: int | None = None  # the next exposure gets this one
        self._step_ns, self._drift_ppm, self._drift_from_ns = 0, 0.0, 0
        self.edge = 0
        self.dead = False

    def begin(self) -> None:
        """Count triggers from 0 again; numbers and clocks go on as they are."""
        self._extra = [
            fault for fault in self._extra if fault.edge in _NEXT or fault.edge >= self.edge
        ]
        self.edge = 0
        self._history.clear()

    def inject(self, fault: Fault) -> None:
        """Note one more fault; it happens once.

        Raises:
            SettingsError: when its trigger has passed.
        """
        if fault.edge not in _NEXT and fault.edge < self.edge:
            raise SettingsError(
                f"trigger {fault.edge} has passed; the next one is {self.edge}, or leave it out"
            )
        self._extra.append(fault)

    def revive(self, back_ns: int) -> None:
        """Begin anew after a death: numbers from the first on, the clock set back.

        Args:
            back_ns: how far the clock is set back: what it shows unshifted, to begin at 0.
        """
        if self.dead:
            self.dead, self._next_number = False, self._wraps_to
            self._step_ns, self._drift_ppm = -back_ns, 0.0
        self._extra.clear()

    def clock_ns(self, t_ns: int, t_dev_ns: int) -> int:
        """What the device's clock shows, when it would show `t_dev_ns` at the true time `t_ns`."""
        if not self._drift_ppm:
            return t_dev_ns + self._step_ns
        drifted = round((t_ns - self._drift_from_ns) * self._drift_ppm * 1e-6)
        return t_dev_ns + self._step_ns + drifted

    def trigger(self, t_ns: int, would: Exposure | None) -> Outcome:
        """A trigger comes.

        Args:
            t_ns: when, by the host's clock.
            would: the exposure that the device would send; None when it would send none.
        """
        hits = self._hits()
        self.edge += 1
        if FaultKind.DEATH in hits:
            self.dead = True
        if self.dead:
            return Outcome(exposed=False)
        if hits:
            self._shift_clock(hits, t_ns)
        if FaultKind.ID_RESET in hits:
            self._next_number = self._wraps_to
        if FaultKind.ID_JUMP in hits:
            self._next_number = min(self._highest, 0xFFFF) - _BELOW_WRAP
        if would is None:
            return Outcome(exposed=False)
        if FaultKind.MISS_TRIGGER in hits:
            self._shift -= 1
            return Outcome(exposed=False)
        exposure = self._shifted(would, FaultKind.INCOMPLETE in hits)
        self._history.append(exposure)
        if FaultKind.LOSE_FRAME in hits or FaultKind.FREEZE in hits:
            return Outcome(exposed=True)
        sent: tuple[Exposure, ...] = (exposure,)
        if FaultKind.DUPLICATE in hits:
            sent += (exposure,)
        if FaultKind.STALE in hits:
            sent += (self._history[0],)
        return Outcome(True, sent)

    def _hits(self) -> dict[FaultKind, Fault]:
        if not self._planned and not self._extra:
            return {}
        edge = self.edge
        extra = [_at(fault, edge) for fault in self._extra]
        self._extra = [fault for fault in extra if (fault.edge or 0) + fault.triggers > edge + 1]
        return {fault.kind: fault for fault in (*self._planned, *extra) if fault.hits(edge)}

    def _shift_clock(self, hits: dict[FaultKind, Fault], t_ns: int) -> None:
        if FaultKind.CLOCK_STEP in hits:
            self._step_ns += hits[FaultKind.CLOCK_STEP].amount_ns
        if FaultKind.CLOCK_DRIFT in hits:
            self._step_ns = self.clock_ns(t_ns, 0)
            self._drift_from_ns = t_ns
            self._drift_ppm += hits[FaultKind.CLOCK_DRIFT].drift_ppm

    def _shifted(self, would: Exposure, torn: bool) -> Exposure:
        if self._next_number is not None:
            self._shift, self._next_number = self._next_number - would.number, None
        span = self._highest + 1 - self._wraps_to
        return would._replace(
            number=(would.number + self._shift - self._wraps_to) % span + self._wraps_to,
            t_dev_ns=self.clock_ns(would.t_ns, would.t_dev_ns),
            complete=would.complete and not torn,
        )


def _at(fault: Fault, edge: int) -> Fault:
    return replace(fault, edge=edge) if fault.edge in _NEXT else fault
