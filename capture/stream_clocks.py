"""Whose clocks date the frames of a stream, and how they are read."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from statistics import median

from capture.clock_model import ClockModel, model_of_arrivals, model_of_samples
from capture.collate import DeviceClock, TriggerTrain
from capture.devices.array import DeviceArray
from capture.devices.capabilities import Latching, PtpClocked
from capture.devices.protocol import ClockKind, ClockSample, TriggerKind
from capture.frame import FrameEvent
from capture.recorder import RecordSettings

_READINGS = 64  # of each clock that are remembered


class StreamClocks:
    """The clocks of an array that streams.

    Attributes:
        basis: what dates the frames, see `capture.recorder.Recording`.
    """

    def __init__(self, array: DeviceArray, settings: RecordSettings) -> None:
        """Know nothing of any clock yet."""
        self.basis = "model"
        self._array, self._settings = array, settings
        self._models: dict[str, ClockModel] = {}
        self._readings: dict[str, deque[ClockSample]] = {}
        self._clocks: dict[str, DeviceClock] = {}
        self._kinds = {device.info.name: device.info.clock for device in array.devices}
        self._free = array.trigger == TriggerKind.FREE_RUN

    def read(self, name: str, device: Latching) -> None:
        """Read the clock of the device of that name some times.

        Raises:
            DeviceError: when it does not answer.
        """
        self.note(name, [device.latch() for _ in range(self._settings.latches)])

    def note(self, name: str, samples: Sequence[ClockSample]) -> None:
        """Note readings of a device's clock."""
        self._readings.setdefault(name, deque(maxlen=_READINGS)).extend(samples)
        self._models[name] = model_of_samples(samples)

    def forget(self, name: str) -> None:
        """Forget a device's clock: it was lost, and may have begun anew."""
        self._readings.pop(name, None)
        self._models.pop(name, None)

    def readings(self) -> dict[str, tuple[ClockSample, ...]]:
        """The latest readings of each clock that can be read."""
        return {name: tuple(samples) for name, samples in self._readings.items()}

    def make_out(self, events: Sequence[FrameEvent]) -> tuple[TriggerTrain, dict[str, int]]:
        """The triggers that others send, by the first frames.

        Returns:
            The train, and by device how much later than it the device exposed, ns.
        """
        first: dict[str, int] = {}
        period = self._settings.period_ns
        for name in sorted({event.device for event in events}):
            own = [event for event in events if event.device == name]
            if self._kinds[name] == ClockKind.HOST:
                self._models[name] = ClockModel(0, 0)
            elif name not in self._readings:
                late_ns = round(1e3 * self._settings.exposure_us)
                self._models[name] = model_of_arrivals(
                    [event.t_dev_ns for event in own],
                    [event.t_host_ns - late_ns for event in own],
                )
            times = [self._models[name].to_host(event.t_dev_ns) for event in own]
            away = median(_wrapped(t_ns - times[0], period) for t_ns in times)
            first[name] = times[0] + round(away)  # one that was late decides nothing
        origin = min(first.values())
        phases = {name: _wrapped(t_ns - origin, period) for name, t_ns in first.items()}
        middle = round(median(phases.values()))
        train = TriggerTrain(origin + middle - period, period)
        return train, {name: phase - middle for name, phase in phases.items()}

    def begin(self, phases: Mapping[str, int]) -> dict[str, DeviceClock]:
        """Decide, by device, how times are read from now on.

        Args:
            phases: of `make_out`; empty when the triggers are ours.
        """
        shared = self._shared()
        for name, kind in self._kinds.items():
            if kind == ClockKind.HOST:
                clock = DeviceClock(ClockModel(0, 0), fitted=False)
            elif shared is not None:
                clock = DeviceClock(shared, fitted=False)
            else:
                model = self._models.get(name, ClockModel(0, 0))
                clock = DeviceClock(model, fitted=not self._free)
            phase = phases.get(name, 0) if self._free else 0
            self._clocks[name] = replace(clock, phase_ns=phase)
        if all(kind == ClockKind.HOST for kind in self._kinds.values()):
            self.basis = "host"
        elif shared is not None:
            self.basis = "ptp"
        elif self._free:
            self.basis = "free"
        return dict(self._clocks)

    def followed(self, name: str) -> dict[str, DeviceClock]:
        """Clocks that are to be read otherwise since that of `name` was read again."""
        if name not in self._clocks or self._kinds[name] == ClockKind.HOST:
            return {}
        if self.basis == "free":
            changed = {name: replace(self._clocks[name], model=self._models[name])}
        elif self.basis == "ptp":
            shared = self._median()
            changed = {one: replace(clock, model=shared) for one, clock in self._clocks.items()}
        else:
            return {}
        self._clocks.update(changed)
        return changed

    def anew(self, event: FrameEvent, train: TriggerTrain) -> DeviceClock:
        """How the times of a device are read that was found again, by its first frame since."""
        name = event.device
        clock = self._clocks[name]
        if self.basis != "ptp" and self._kinds[name] == ClockKind.OWN:
            arrived = ClockModel(event.t_dev_ns, event.t_host_ns)
            clock = replace(clock, model=self._models.get(name, arrived))
        if self._free:
            away = clock.model.to_host(event.t_dev_ns) - train.start_ns
            clock = replace(clock, phase_ns=_wrapped(away, train.period_ns))
        self._clocks[name] = clock
        return clock

    def _shared(self) -> ClockModel | None:
        """The one clock that all devices follow; None unless every device says that it does."""
        devices = self._array.devices
        said = [device.ptp() for device in devices if isinstance(device, PtpClocked)]
        together = len(said) == len(devices) == len(self._models)
        if not together or not all(reading.locked for reading in said):
            return None
        return self._median() if len({reading.grandmaster for reading in said}) == 1 else None

    def _median(self) -> ClockModel:
        return ClockModel(round(median(model.offset_ns for model in self._models.values())), 0)


def _wrapped(t_ns: int, period_ns: int) -> int:
    """A time brought to within half a period of 0 by whole periods."""
    return (t_ns + period_ns // 2) % period_ns - period_ns // 2
