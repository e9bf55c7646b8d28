"""When a device exposes: by itself, at an edge, a command, an action."""

from __future__ import annotations

from dataclasses import dataclass

from tests.gige.camera.agenda import Agenda
from tests.gige.camera.clock import DeviceClock
from tests.gige.camera.faults import Defect, Faults
from tests.gige.camera.settings import Settings
from tests.gige.camera.stream import Exposure, Stream


@dataclass
class Deed:
    """What became of a trigger.

    Attributes:
        t_ns: true time of the trigger.
        outcome: "ignored" or "busy" when there is no frame; else "exposed", then "sent", "dropped"
            (some packets were not sent at first) or "lost" (none was).
        frame_id: of its frame; 0 without.
        t_dev_ns: its time by the device's clock; 0 without a frame.
        number: of the frame since the device was switched on; -1 without.
    """

    t_ns: int
    outcome: str
    frame_id: int = 0
    t_dev_ns: int = 0
    number: int = -1


class Trigger:
    """Answers triggers with exposures, numbers them, and has them sent when they are over."""

    def __init__(
        self, settings: Settings, clock: DeviceClock, faults: Faults, agenda: Agenda, stream: Stream
    ) -> None:
        self._settings, self._clock, self._faults = settings, clock, faults
        self._agenda, self._stream = agenda, stream
        self.acquiring = False
        self.first_id = 1
        self.readout_us = 0.0
        self.deeds: list[Deed] = []
        self.triggers = 0  # answered or not
        self.frames = 0
        self.next_id = 1
        self._free_ns = 0  # true time at which the next trigger can be answered
        self._run = 0  # each start has a number, so that what an earlier one planned is void

    def start(self, now_ns: int) -> None:
        """Begin to answer triggers; numbers begin anew."""
        self.acquiring, self.next_id = True, self.first_id
        self._run += 1
        self._free_run(now_ns, self._run)

    def stop(self) -> None:
        """Cease to answer triggers."""
        self.acquiring = False

    def train(self, source: str, first_ns: int, period_ns: int, count: int) -> None:
        """Edges on a wire at set true times."""
        for k in range(count):
            self._plan_edge(source, first_ns + k * period_ns)

    def edge(self, source: str, t_ns: int) -> bool:
        """A trigger from a source; whether it was answered."""
        if self._settings.chosen("TriggerMode") != "On" or not self.acquiring:
            return False
        if self._settings.chosen("TriggerSource") != source:
            return False
        return self._answer(t_ns)

    def _plan_edge(self, source: str, t_ns: int) -> None:
        self._agenda.at(t_ns, lambda: self._take_edge(source, t_ns))

    def _take_edge(self, source: str, t_ns: int) -> None:
        self.edge(source, t_ns)

    def _answer(self, t_ns: int) -> bool:
        number, self.triggers = self.triggers, self.triggers + 1
        if self._faults.busy or self._faults.due(Defect.IGNORE, number):
            self.deeds.append(Deed(t_ns, "ignored"))
            return False
        if t_ns < self._free_ns:
            self.deeds.append(Deed(t_ns, "busy"))
            return False
        exposure_us = self._settings.real("ExposureTime")
        frame_id = self.next_id
        self.next_id = self._stream.next_id(frame_id)
        exposure = Exposure(
            self.frames, frame_id, t_ns, self._clock.read(t_ns), exposure_us, self.frames & 1
        )
        deed = Deed(t_ns, "exposed", frame_id, exposure.t_dev_ns, exposure.number)
        self.frames += 1
        self.deeds.append(deed)
        end_ns = t_ns + round(exposure_us * 1000)
        self._free_ns = end_ns + round(self.readout_us * 1000)
        self._agenda.at(end_ns, lambda: self._send(exposure, deed))
        if self._settings.chosen("AcquisitionMode") == "SingleFrame":
            self.acquiring = False
        return True

    def _send(self, exposure: Exposure, deed: Deed) -> None:
        deed.outcome = self._stream.send(exposure)

    def _free_run(self, t_ns: int, run: int) -> None:
        if run != self._run or not self.acquiring:
            return
        if self._settings.chosen("TriggerMode") == "Off":
            self._answer(t_ns)
        period_ns = round(1e9 / self._settings.real("AcquisitionFrameRate"))
        self._agenda.at(t_ns + period_ns, lambda: self._free_run(t_ns + period_ns, run))
