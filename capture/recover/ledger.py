"""The ledger and the judgement of a recovered take, from the frames that are left of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from capture.errors import TakeError
from capture.frame_header import FrameHeader
from capture.judgement import Colour, judge
from capture.ledger import Ledger, LedgerEntry, Verdict, read_ledger
from capture.recover.salvage import Salvage

_NOTE = "recovered"
_MOST_TRIGGERS = 1_000_000  # nearly four hours at 75 Hz: a header can claim any


def mended_ledger(
    path: Path, found: Mapping[str, Salvage | None], frame_count: int | None
) -> tuple[Ledger, bool]:
    """The ledger of what is left, and whether the one on disk said just that.

    Args:
        path: ledger.csv, which is believed where the files do not contradict it.
        found: by device, in the take's order, what its file holds; None when it is gone.
        frame_count: triggers of the take, where its manifest says so.

    Raises:
        TakeError: when a frame claims a trigger beyond any take.
    """
    old = _old(path, tuple(found), frame_count)
    count = old.triggers if old is not None else frame_count or _last_trigger(found) + 1
    if count > _MOST_TRIGGERS:
        raise TakeError(f"{path}: {count} triggers are beyond what is recovered ({_MOST_TRIGGERS})")
    headers = {name: _by_trigger(there.headers if there else ()) for name, there in found.items()}
    reasons = {name: _reasons(there) for name, there in found.items()}
    entries = tuple(
        _entry(
            None if old is None else old.entry(k, name),
            k,
            name,
            headers[name].get(k),
            reasons[name].get(k, ""),
        )
        for k in range(count)
        for name in found
    )
    ledger = Ledger(tuple(found), count, entries, old.remarks if old is not None else ())
    return ledger, old is not None and old.entries == ledger.entries


def recovered_judgement(ledger: Ledger, planned: int | None) -> dict[str, Any]:
    """The judgement of a take without a manifest: never green, red when it ended early."""
    verdict = judge(ledger)
    colour = Colour.AMBER if verdict.colour == Colour.GREEN else verdict.colour
    begun = f"{ledger.triggers}"
    if planned is not None and ledger.triggers < planned:
        colour, begun = Colour.RED, f"{ledger.triggers} of {planned}"
    whole = ledger.triggers - len(ledger.incomplete())
    advice = "Take it again." if colour == Colour.RED else "The take can be used."
    sentence = (
        f"Recovered after a crash: {begun} frame sets were begun, {whole} are complete. {advice}"
    )
    return asdict(replace(verdict, colour=colour, sentence=sentence))


def _old(path: Path, devices: tuple[str, ...], frame_count: int | None) -> Ledger | None:
    try:
        ledger = read_ledger(path)
    except TakeError:
        return None
    fits = ledger.devices == devices and frame_count in (None, ledger.triggers)
    return ledger if fits else None


def _by_trigger(headers: Sequence[FrameHeader]) -> dict[int, FrameHeader]:
    """As `Take` looks them up: a complete image before one that is not."""
    return {h.trigger_index: h for h in sorted(headers, key=lambda h: h.status == 0)}


def _reasons(there: Salvage | None) -> dict[int, str]:
    reasons = {}
    for damage in there.damages if there else ():
        for k in damage.triggers:
            reasons[k] = "torn while it was written" if damage.torn else "damaged on the disk"
    return reasons


def _last_trigger(found: Mapping[str, Salvage | None]) -> int:
    """The last trigger of which anything is known."""
    last = 0
    for there in found.values():
        if there is not None:
            known = [header.trigger_index for header in there.headers]
            known += [k for damage in there.damages for k in damage.triggers]
            last = max([last, *known])
    return last


def _entry(
    old: LedgerEntry | None, k: int, device: str, header: FrameHeader | None, reason: str
) -> LedgerEntry:
    """One line, the files having the last word on whether there is a frame."""
    if header is None:
        if old is not None and old.verdict not in (Verdict.OK, Verdict.INCOMPLETE):
            return old  # the recording knew why there is none
        if old is not None and old.verdict == Verdict.INCOMPLETE and not reason:
            return old  # incomplete images are on disk only where that was asked for
        if reason or old is not None:
            note = f"{_NOTE}: {reason or 'its frame is not on the disk'}"
            if old is not None:
                return replace(old, verdict=Verdict.LOST, note=note)
            return LedgerEntry(k, device, Verdict.LOST, note=note)
        return LedgerEntry(k, device, Verdict.MISSING, note=_NOTE)
    verdict = Verdict.OK if header.status == 0 else Verdict.INCOMPLETE
    if old is not None and old.verdict == verdict:
        return old
    return LedgerEntry(
        k, device, verdict, header.frame_id, header.t_dev_ns, header.t_host_ns, -1, _NOTE
    )
