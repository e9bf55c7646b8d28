"""The ledger of a take: every (trigger index, device) pair has exactly one verdict."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path

from capture.errors import TakeError
from capture.product import replacing

_COLUMNS = (
    "trigger_index",
    "device",
    "verdict",
    "frame_id",
    "t_dev_ns",
    "t_host_ns",
    "t_ns",
    "note",
)
_NOT_WRITTEN = "not written: "


class Verdict(StrEnum):
    """What became of one trigger at one device."""

    OK = "ok"
    INCOMPLETE = "incomplete"  # parts of the image did not arrive
    LOST = "lost"  # exposed, and lost in transport or host: the frame number skipped
    MISSED_TRIGGER = "missed_trigger"  # never exposed: time went on, the frame number did not
    QUARANTINED = "quarantined"  # a frame came with a number that had been given before
    MISSING = "missing"  # no frame, and no other frame of the device around it to say why


class Oddity(StrEnum):
    """A frame that belongs to no trigger, or a jump of a device's numbers or clock."""

    DUPLICATE = "duplicate"  # the same frame number again; quarantined
    STALE = "stale"  # an older frame came again; quarantined
    CLOCK_STEP = "clock_step"  # the device's clock jumped; its frame is kept
    ID_RESET = "id_reset"  # the device's frame numbers jumped; its frame is kept


@dataclass(frozen=True, slots=True)
class LedgerEntry:
    """One line of the ledger.

    Attributes:
        trigger_index: the trigger.
        device: the device's name.
        verdict: what became of it.
        frame_id: the number the device gave the frame; -1 when there is none.
        t_dev_ns: start of exposure by the device's clock; -1 when there is none.
        t_host_ns: arrival by the host's clock; -1 when there is none.
        t_ns: start of exposure by the common clock; -1 when there is none.
        note: a remark, for a person.
    """

    trigger_index: int
    device: str
    verdict: Verdict
    frame_id: int = -1
    t_dev_ns: int = -1
    t_host_ns: int = -1
    t_ns: int = -1
    note: str = ""

    @property
    def unwritten(self) -> bool:
        """Whether a frame came and could not be written; see `unwritten`."""
        return self.verdict == Verdict.LOST and self.note.startswith(_NOT_WRITTEN)


@dataclass(frozen=True, slots=True)
class Remark:
    """One oddity: a quarantined frame, or a jump of a device's numbers or clock.

    Attributes:
        device: the device's name.
        oddity: what it is.
        trigger_index: the trigger it came at or after; -1 before the first.
        frame_id: the number the device gave the frame.
    """

    device: str
    oddity: Oddity
    trigger_index: int
    frame_id: int


@dataclass(frozen=True, eq=False)
class Ledger:
    """All verdicts of a take.

    Attributes:
        devices: names, in the take's order.
        triggers: how many; indices run from 0.
        entries: trigger by trigger, devices in order.
        remarks: oddities, in the order they came.
    """

    devices: tuple[str, ...]
    triggers: int
    entries: tuple[LedgerEntry, ...]
    remarks: tuple[Remark, ...] = ()

    def __post_init__(self) -> None:
        # Counted first: a damaged file may claim more triggers than memory can list.
        whole = len(self.entries) == self.triggers * len(self.devices)
        expected = ((k, device) for k in range(self.triggers) for device in self.devices)
        if not whole or any(
            (entry.trigger_index, entry.device) != pair
            for entry, pair in zip(self.entries, expected, strict=True)
        ):
            raise TakeError(
                f"ledger: expected exactly one verdict for each of {self.triggers} triggers x "
                f"{len(self.devices)} devices in order, found {len(self.entries)} entries"
            )

    def entry(self, trigger_index: int, device: str) -> LedgerEntry:
        """The line of one trigger and one device."""
        return self.entries[trigger_index * len(self.devices) + self.devices.index(device)]

    def counts(self) -> dict[Verdict, int]:
        """How often each verdict was given; the sum is triggers x devices."""
        return {
            verdict: sum(entry.verdict == verdict for entry in self.entries) for verdict in Verdict
        }

    def incomplete(self) -> dict[int, list[LedgerEntry]]:
        """The lines that are not OK, by trigger index."""
        out: dict[int, list[LedgerEntry]] = {}
        for entry in self.entries:
            if entry.verdict != Verdict.OK:
                out.setdefault(entry.trigger_index, []).append(entry)
        return out


def all_present(devices: Sequence[str], triggers: int) -> Ledger:
    """The ledger of a take that came whole, an import say."""
    entries = tuple(
        LedgerEntry(k, device, Verdict.OK, frame_id=k)
        for k in range(triggers)
        for device in devices
    )
    return Ledger(tuple(devices), triggers, entries)


def unwritten(ledger: Ledger, reasons: Mapping[tuple[int, str], str]) -> Ledger:
    """The ledger when some frames came and could not be written: they are lost, and why is noted.

    Args:
        ledger: as collated.
        reasons: by trigger index and device.
    """
    entries = tuple(
        replace(entry, verdict=Verdict.LOST, note=f"{_NOT_WRITTEN}{reasons[pair]}")
        if (pair := (entry.trigger_index, entry.device)) in reasons
        else entry
        for entry in ledger.entries
    )
    return replace(ledger, entries=entries)


def write_ledger(path: Path, ledger: Ledger) -> None:
    """Write ledger.csv, whole or not at all; remarks follow the verdicts, in capitals."""
    with replacing(path) as partial, partial.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(_COLUMNS)
        for entry in ledger.entries:
            writer.writerow([getattr(entry, column) for column in _COLUMNS])
        for remark in ledger.remarks:
            row = [remark.trigger_index, remark.device, remark.oddity.upper(), remark.frame_id]
            writer.writerow([*row, -1, -1, -1, ""])


def read_ledger(path: Path) -> Ledger:
    """Read ledger.csv.

    Raises:
        TakeError: naming the file and the line that does not fit.
    """
    entries: list[LedgerEntry] = []
    remarks: list[Remark] = []
    try:
        rows = list(csv.reader(path.read_text(encoding="utf-8").splitlines()))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise TakeError(f"{path}: not readable: {error}") from error
    if not rows or tuple(rows[0]) != _COLUMNS:
        raise TakeError(f"{path}: expected a ledger with columns {', '.join(_COLUMNS)}")
    for number, row in enumerate(rows[1:], start=2):
        try:
            k, device, verdict, frame_id, t_dev, t_host, t, note = row
            if verdict.isupper():
                remarks.append(Remark(device, Oddity(verdict.lower()), int(k), int(frame_id)))
            else:
                entries.append(
                    LedgerEntry(
                        int(k),
                        device,
                        Verdict(verdict),
                        int(frame_id),
                        int(t_dev),
                        int(t_host),
                        int(t),
                        note,
                    )
                )
        except ValueError as error:
            raise TakeError(f"{path}:{number}: not a line of a ledger: {error}") from error
    if not entries:
        raise TakeError(f"{path}: holds no verdict")
    devices = tuple(dict.fromkeys(entry.device for entry in entries))
    try:
        return Ledger(devices, entries[-1].trigger_index + 1, tuple(entries), tuple(remarks))
    except TakeError as error:
        raise TakeError(f"{path}: {error}") from error
