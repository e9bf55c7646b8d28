"""A wire to running devices, and what they did against what a recording says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from capture.devices.lines import HostLine
from capture.ledger import Verdict
from capture.recorder import Recording
from capture.take import Take
from tests.gige.camera.pixels import read_stamp
from tests.gige.camera.running import RunningDevice
from tests.gige.camera.trigger import Deed


class Wire(HostLine):
    """The host sends the edges; devices date each by the time that was asked for."""

    def __init__(self, devices: Sequence[RunningDevice], source: str = "Line0") -> None:
        self.devices, self.source = tuple(devices), source

    @property
    def fires(self) -> bool:
        """True."""
        return True

    def fire(self, t_ns: int) -> None:
        """Wait until then, and send an edge."""
        self.wait(t_ns)
        for device in self.devices:
            device.tell("train", source=self.source, first_ns=t_ns, period_ns=1, count=1)


_GAPS = ("lost", "ignored", "busy")
_STARVED = 3  # frames whose packets a busy machine may have kept waiting too long

# What a trigger came to, and what a ledger must then say.
VERDICTS = {
    "sent": {Verdict.OK},
    # As the packets were sent again or not; without its leader a frame has no number.
    "dropped": {Verdict.OK, Verdict.INCOMPLETE, Verdict.LOST},
    "exposed": {
        Verdict.LOST,
        Verdict.MISSED_TRIGGER,
        Verdict.MISSING,
    },  # switched off before it was sent
    "lost": {Verdict.LOST},
    "ignored": {Verdict.MISSED_TRIGGER},
    "busy": {Verdict.MISSED_TRIGGER},
}


def deeds_by_index(recording: Recording, deeds: Sequence[Deed], count: int) -> dict[int, Deed]:
    """What a device did at each trigger of a recording that reached it."""
    train = recording.train
    found = {}
    for deed in deeds:
        index = round((deed.t_ns - train.start_ns) / train.period_ns)
        if 0 <= index < count:
            found[index] = deed
    return found


def untruths(recording: Recording, take: Take, devices: Mapping[str, RunningDevice]) -> list[str]:
    """Where a recording differs from what its devices did, by their own word and by every pixel.

    Args:
        recording: ledger and train.
        take: as written.
        devices: by name in the array.

    Returns:
        A sentence for each; none is right.
    """
    wrong: list[str] = []
    starved: list[str] = []
    ledger = recording.ledger
    for name, device in devices.items():
        did = deeds_by_index(recording, device.deeds(), ledger.triggers)
        for k in range(ledger.triggers):
            entry, deed = ledger.entry(k, name), did.get(k)
            if deed is None:
                if entry.verdict not in (Verdict.MISSED_TRIGGER, Verdict.LOST, Verdict.MISSING):
                    wrong.append(f"{name} {k}: {entry.verdict}, and no trigger came")
            elif deed.outcome == "sent" and "timeout" in entry.note:
                starved.append(f"{name} {k}: {entry.verdict} ({entry.note}), was sent")
            elif "unknown order" in entry.note and deed.outcome in _GAPS:
                continue
            elif entry.verdict not in VERDICTS[deed.outcome]:
                wrong.append(f"{name} {k}: {entry.verdict} ({entry.note}), was {deed.outcome}")
            elif entry.verdict == Verdict.OK:
                stamp = read_stamp(take.image(name, k))
                if entry.frame_id != deed.frame_id:
                    wrong.append(f"{name} {k}: number {entry.frame_id}, was {deed.frame_id}")
                if stamp is None or (stamp.frame_id, stamp.t_ns) != (deed.frame_id, deed.t_ns):
                    wrong.append(f"{name} {k}: {stamp} in the pixels, was {deed}")
            elif take.present(name, k):
                wrong.append(f"{name} {k}: {entry.verdict}, and an image stands in the take")
    return wrong if len(starved) <= _STARVED else wrong + starved
