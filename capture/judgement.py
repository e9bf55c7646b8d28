"""Whether a take can be used: green, amber or red, with one plain sentence for the operator."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise

from capture.errors import SettingsError
from capture.ledger import Ledger, LedgerEntry, Oddity, Verdict

_AMBER_SETS = 2  # at most this many frame sets may be incomplete
_GREEN_SPREAD_NS = 10_000
_AMBER_SPREAD_NS = 1_000_000
_NAMED = 3
_WORDS = {
    Verdict.INCOMPLETE: "sent an incomplete image at",
    Verdict.MISSED_TRIGGER: "missed the trigger of",
    Verdict.QUARANTINED: "repeated a frame number at",
    Verdict.MISSING: "sent nothing for",
}


class Colour(StrEnum):
    """Green: use it. Amber: it can be used. Red: take it again."""

    GREEN = "green"
    AMBER = "amber"
    RED = "red"

    @property
    def badness(self) -> int:
        """0 green, 1 amber, 2 red: what colours are sorted and compared by."""
        return list(Colour).index(self)


def worst_colour(colours: Iterable[Colour]) -> Colour:
    """The worst of some colours; green when there is none."""
    return max(colours, key=lambda colour: colour.badness, default=Colour.GREEN)


@dataclass(frozen=True)
class Judgement:
    """The verdict on a take, for the operator.

    Attributes:
        colour: green, amber or red.
        sentence: why, in plain words.
        spread_ns: the largest spread of exposure times in a frame set; -1 when none is complete.
    """

    colour: Colour
    sentence: str
    spread_ns: int

    def at_best(self, colour: Colour, sentence: str) -> Judgement:
        """No better than a colour; the sentence is added where that makes it worse."""
        if colour.badness <= self.colour.badness:
            return self
        return Judgement(colour, f"{self.sentence} {sentence}", self.spread_ns)


def judge(ledger: Ledger, hold: tuple[int, int] | None = None) -> Judgement:
    """Judge a take by its ledger.

    Green: all frame sets are complete. Amber: at most two are not, no two of them neighbours, none
    in the hold window. Red: anything else. A spread above 10 us or a jump makes amber, above 1 ms
    red.

    Args:
        ledger: of the take.
        hold: first and last frame of the part that must be whole, or None.

    Raises:
        SettingsError: when the hold lies outside the take.
    """
    if hold is not None and not 0 <= hold[0] <= hold[1] < ledger.triggers:
        raise SettingsError(f"hold must lie within frames 0..{ledger.triggers - 1}, found {hold}")
    broken = ledger.incomplete()
    spread = _largest_spread_ns(ledger)
    reasons = []
    colour = Colour.GREEN
    if broken:
        numbers = sorted(broken)
        neighbours = any(b - a == 1 for a, b in pairwise(numbers))
        held = hold is not None and any(hold[0] <= k <= hold[1] for k in numbers)
        colour = Colour.RED if len(broken) > _AMBER_SETS or neighbours or held else Colour.AMBER
        where = ", some of them neighbours" if neighbours else ", in the hold" if held else ""
        reasons.append(
            f"{len(broken)} of {ledger.triggers} frame sets are not complete{where} "
            f"({_causes(broken)})"
        )
    if spread > _GREEN_SPREAD_NS:
        colour = Colour.RED if spread > _AMBER_SPREAD_NS or colour == Colour.RED else Colour.AMBER
        reasons.append(f"devices exposed up to {spread / 1000:.0f} us apart")
    jumps = sorted(
        {r.device for r in ledger.remarks if r.oddity in (Oddity.CLOCK_STEP, Oddity.ID_RESET)}
    )
    if jumps:
        colour = Colour.RED if colour == Colour.RED else Colour.AMBER
        reasons.append(f"the clock or the frame numbers of {', '.join(jumps)} jumped")
    return Judgement(colour, _sentence(colour, reasons, ledger) + _noted(ledger), spread)


def _sentence(colour: Colour, reasons: list[str], ledger: Ledger) -> str:
    if colour == Colour.GREEN:
        return f"All {ledger.triggers} frame sets of {len(ledger.devices)} devices are complete."
    text = "; ".join(reasons)
    advice = "Take it again." if colour == Colour.RED else "The take can be used."
    return f"{text[0].upper()}{text[1:]}. {advice}"


def _noted(ledger: Ledger) -> str:
    """What the devices noted of frames that are whole: that packets were sent again, for one."""
    notes = Counter(e.note for e in ledger.entries if e.verdict == Verdict.OK and e.note)
    return "".join(f" {count} frames: {note}." for note, count in sorted(notes.items()))


def _causes(broken: dict[int, list[LedgerEntry]]) -> str:
    lines = [entry for k in sorted(broken) for entry in broken[k]]
    named = []
    for entry in lines[:_NAMED]:
        if entry.verdict == Verdict.LOST:
            # Where the frame got stuck tells the operator where to look: at the disk, or a cable.
            how = "could not be written" if entry.unwritten else "was lost in transport"
            named.append(f"frame {entry.trigger_index} of {entry.device} {how}")
        else:
            named.append(f"{entry.device} {_WORDS[entry.verdict]} frame {entry.trigger_index}")
    rest = f" and {len(lines) - _NAMED} more" if len(lines) > _NAMED else ""
    return ", ".join(named) + rest


def _largest_spread_ns(ledger: Ledger) -> int:
    largest = -1
    width = len(ledger.devices)
    for first in range(0, len(ledger.entries), width):
        row = ledger.entries[first : first + width]
        if all(entry.verdict == Verdict.OK and entry.t_ns >= 0 for entry in row):
            times = [entry.t_ns for entry in row]
            largest = max(largest, max(times) - min(times))
    return largest
