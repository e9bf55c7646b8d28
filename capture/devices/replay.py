"""The backend "replay": a recorded take, played as an ordinary device in real time.

An address is ``TAKE_FOLDER#DEVICE``, and after it ``?loop=1`` to begin again at the end, without
a seam: numbers and clock go on. Numbers, device times, latencies, gaps and incomplete images are
those of the recording. Running freely, it plays at the speed of the recording; on a wire or by
software trigger it plays as fast as triggers come, trigger k of the recording at the k-th since the
start.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from statistics import median

import numpy as np

from capture.arrays import Image
from capture.devices.backend import FoundDevice
from capture.devices.faults import Exposure
from capture.devices.lines import RealTimeLine
from capture.devices.protocol import DeviceInfo, TriggerKind, TriggerLine, TriggerSpec
from capture.devices.real_time import RealTimeDevice
from capture.errors import DeviceError, TakeError
from capture.frame_header import FrameHeader
from capture.take import Take

_LOOPED = "?loop=1"
_LATENCY_NS = 5_000_000  # when the recording does not say
_LONGEST_NS = 1_000_000_000
_CLOSE = 0.01  # of the period: how near a free run has to be asked for


class RecordedSource:
    """What a recorded device sent."""

    def __init__(self, take: Take, device: str, loop: bool) -> None:
        """Open a device's file.

        Args:
            take: the recording.
            device: its name there.
            loop: whether to begin again at the end.

        Raises:
            TakeError: when the take has no such device, or it has no frame.
        """
        self._reader = take.reader(device)
        headers = self._reader.headers
        if not headers:
            raise TakeError(f"{take.folder}: {device} has no frame to play")
        self._places = {header.trigger_index: place for place, header in enumerate(headers)}
        self._headers = {header.trigger_index: header for header in headers}
        self._count, self._loop = take.manifest.frame_count, loop
        self.period_ns = take.manifest.period_ns
        self._recorded_ns = take.manifest.start_ns or 0  # of trigger 0
        self._start_ns, self._asked = 0, 1
        ids = [header.frame_id for header in headers]
        self.id_bits, self.wraps_to = 16 if max(ids) < 1 << 16 else 64, int(min(ids) > 0)
        self._rate = self._fitted_rate(headers)

    def begin(self, t_ns: int, spec: TriggerSpec) -> None:
        """The recording begins here; one that does not know its period gets that asked for."""
        self._start_ns, self._asked = t_ns, spec.period_ns

    def exposure(self, edge: int, t_ns: int) -> Exposure | None:
        """What was recorded of that trigger; None where nothing is."""
        lap, k = divmod(edge, self._count)
        header = self._headers.get(k)
        if header is None or (lap and not self._loop):
            return None
        number = header.frame_id + lap * self._numbers()
        t_dev_ns = self.clock_ns(t_ns) + self._residual_ns(header)
        return Exposure(edge, t_ns, number, t_dev_ns, header.exposure_us, header.status == 0)

    def lag_ns(self, exposure: Exposure) -> int:
        """The recorded latency."""
        header = self._headers[exposure.place % self._count]
        lag_ns = header.t_host_ns - self._time_ns(header.trigger_index)
        if header.t_host_ns < 0 or not 0 <= lag_ns <= _LONGEST_NS:
            return round(1000 * max(exposure.exposure_us, 0.0)) + _LATENCY_NS
        return lag_ns

    def fill(self, exposure: Exposure, into: Image) -> str:
        """The recorded image; of one made incomplete the first half."""
        k = exposure.place % self._count
        try:
            image = self._reader.read(self._places[k]).reshape(-1).view(np.uint8)
        except TakeError as error:
            return f"damaged in the recording: {error}"
        torn = not exposure.complete and self._headers[k].status == 0
        size = len(into) // 2 if torn else len(into)
        into[:size] = image[:size]
        return ""

    def free_period_ns(self, period_ns: int) -> int:
        """The recording's."""
        return self._period_ns()

    def clock_ns(self, t_ns: int) -> int:
        """The recorded device's clock, had the recording begun at the last start."""
        first = self._reader.headers[0]
        known_ns = first.t_dev_ns if first.t_dev_ns >= 0 else 0
        since_ns = t_ns - self._start_ns - first.trigger_index * self._period_ns()
        return known_ns + round(since_ns * self._rate)

    def reboot_ns(self, t_ns: int) -> int:
        """Not at all: the recording begins again, and its clock with it."""
        return 0

    def _period_ns(self) -> int:
        return self.period_ns or self._asked

    def _time_ns(self, k: int) -> int:
        return self._recorded_ns + k * self._period_ns()

    def _residual_ns(self, header: FrameHeader) -> int:
        if header.t_dev_ns < 0:
            return 0
        t_ns = self._start_ns + header.trigger_index * self._period_ns()
        return header.t_dev_ns - self.clock_ns(t_ns)

    def _numbers(self) -> int:
        """How many numbers one lap takes; frames missing at either end are taken for lost ones."""
        first, last = self._reader.headers[0], self._reader.headers[-1]
        span = (1 << self.id_bits) - self.wraps_to
        within = last.trigger_index - first.trigger_index
        return (last.frame_id - first.frame_id) % span + self._count - within

    def _fitted_rate(self, headers: tuple[FrameHeader, ...]) -> float:
        """Device nanoseconds in a host nanosecond; the median bears a clock that jumped."""
        rates = [
            (after.t_dev_ns - before.t_dev_ns)
            / ((after.trigger_index - before.trigger_index) * self.period_ns)
            for before, after in pairwise(headers)
            if self.period_ns
            and before.t_dev_ns >= 0
            and after.t_dev_ns >= 0
            and after.trigger_index > before.trigger_index
        ]
        return median(rates) if rates else 1.0


class ReplayDevice(RealTimeDevice):
    """A device of a recorded take."""

    def __init__(
        self, name: str, address: str, take: Take, device: str, line: RealTimeLine
    ) -> None:
        """Connect a recorded device to a line.

        Args:
            name: in the array.
            address: as it was given.
            take: the recording.
            device: its name there.
            line: the wire for hardware triggers.
        """
        self._recorded = RecordedSource(take, device, address.endswith(_LOOPED))
        info = DeviceInfo(
            name=name,
            serial=f"REPLAY-{device}",
            model=f"recording {take.name}",
            layout=take.reader(device).layout,
            id_bits=self._recorded.id_bits,
            triggers=(TriggerKind.FREE_RUN, TriggerKind.HARDWARE, TriggerKind.SOFTWARE),
            first_id=self._recorded.wraps_to,
            transport="replay",
            address=address,
        )
        super().__init__(info, self._recorded, line)

    def prepare(self, spec: TriggerSpec) -> None:
        """Set the device up; it runs freely at no other rate than that of the recording."""
        period_ns = self._recorded.period_ns
        if (
            spec.kind == TriggerKind.FREE_RUN
            and period_ns
            and abs(spec.period_ns - period_ns) > _CLOSE * period_ns
        ):
            raise DeviceError(
                f"asked for {1e9 / spec.period_ns:.6g} Hz, the take was recorded at "
                f"{1e9 / period_ns:.6g} Hz; set that rate, or use a trigger"
            )
        super().prepare(spec)


class ReplayBackend:
    """Opens recorded devices, and owns the wire that can trigger them.

    As with simulated devices, two arrays at the same time need two backend objects.
    """

    name = "replay"

    def __init__(self, line: RealTimeLine | None = None) -> None:
        """Lay the wire.

        Args:
            line: the wire; one on which `fire` sends the edges when not given.
        """
        self._line = line if line is not None else RealTimeLine()

    def discover(self) -> tuple[FoundDevice, ...]:
        """None: a recording is opened by its folder."""
        return ()

    def open(self, address: str, name: str) -> ReplayDevice:
        """Open a device of a take.

        Args:
            address: see the module.
            name: that it shall have in the array.

        Raises:
            DeviceError: when there is no such take or device.
        """
        folder, mark, device = address.removesuffix(_LOOPED).rpartition("#")
        if not mark:
            raise DeviceError(
                f"{name}: expected TAKE_FOLDER#DEVICE or TAKE_FOLDER#DEVICE{_LOOPED}, "
                f"found {address!r}"
            )
        try:
            return ReplayDevice(name, address, Take.open(Path(folder)), device, self._line)
        except TakeError as error:
            raise DeviceError(f"{name}: {error}") from error

    def line(self) -> TriggerLine:
        """The wire of all devices that this object opened."""
        return self._line


backend = ReplayBackend()
