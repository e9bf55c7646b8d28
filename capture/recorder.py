"""Recording: triggers out, frames straight from the devices to disk, in bounded memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from capture.arrays import Image
from capture.clock_model import ClockModel, model_of_samples
from capture.collate import Collator, TriggerTrain
from capture.devices.protocol import Device, DeviceArray, TriggerKind, TriggerSpec
from capture.errors import SettingsError
from capture.frame import FrameEvent
from capture.frame_header import FrameHeader
from capture.ledger import Ledger
from capture.settings import check_ranges

Sink = Callable[[str, FrameHeader, Image], None]


@dataclass(frozen=True, kw_only=True)
class RecordSettings:
    """How takes are recorded.

    Attributes:
        rate_hz: triggers a second; 1 to 1000.
        exposure_us: exposure time; below the period.
        pre_roll: triggers before the take, so that its first frame has one before it; 0 to 1000.
        post_roll: triggers after the take, so that its last frame has one after it; 0 to 1000.
        retention_ms: how long to wait for frames after the last trigger; 1 to 10000.
        latches: readings of each device's clock before the take; 1 to 1000.
        keep_incomplete: whether images with missing parts are kept on disk, marked.
    """

    rate_hz: float = 75.0
    exposure_us: float = 3000.0
    pre_roll: int = 2
    post_roll: int = 2
    retention_ms: float = 100.0
    latches: int = 8
    keep_incomplete: bool = False

    def __post_init__(self) -> None:
        check_ranges(
            "record", self, rate_hz=(1, 1000), exposure_us=(1, 1e6), pre_roll=(0, 1000),
            post_roll=(0, 1000), retention_ms=(1, 10_000), latches=(1, 1000),
        )  # fmt: skip
        if self.exposure_us >= 1e6 / self.rate_hz:
            raise SettingsError(
                f"record.exposure_us must be below the period of {1e6 / self.rate_hz:.0f} us, "
                f"found {self.exposure_us}"
            )

    @property
    def period_ns(self) -> int:
        """From trigger to trigger."""
        return round(1e9 / self.rate_hz)


@dataclass(frozen=True, eq=False)
class Recording:
    """What a recording was.

    Attributes:
        train: its triggers.
        ledger: the verdict of each trigger at each device.
        clocks: by device name, its clock as fitted to the triggers.
    """

    train: TriggerTrain
    ledger: Ledger
    clocks: dict[str, ClockModel]


def record_frames(
    array: DeviceArray,
    settings: RecordSettings,
    sink: Sink,
    *,
    count: int,
    start_ns: int | None = None,
    told: Callable[[int], None] = lambda frames: None,
) -> Recording:
    """Record `count` triggers of an array.

    Everything runs in the calling thread, so that simulated devices render in one thread; one image
    is in memory at a time.

    Args:
        array: the devices and the line that triggers them.
        settings: rate, exposure, pre-roll and post-roll.
        sink: given each frame of the take, with its trigger index, as it comes.
        count: how many triggers belong to the take.
        start_ns: when trigger 0 is sent, by the line's clock; None: as soon as all is ready.
        told: called with the number of frames that have gone to the sink.

    Raises:
        DeviceError: when a device cannot be prepared.
    """
    period = settings.period_ns
    array.prepare(
        TriggerSpec(kind=TriggerKind.HARDWARE, period_ns=period, exposure_us=settings.exposure_us)
    )
    lead = (settings.pre_roll + 1) * period
    if start_ns is None:
        start_ns = array.line.now_ns() + lead
    train = TriggerTrain(start_ns, period, count, settings.pre_roll)
    try:
        array.line.wait(start_ns - lead)
        for device in array.devices:
            device.acquire.start()
        models = {
            device.info.name: model_of_samples(
                [device.acquire.latch() for _ in range(settings.latches)]
            )
            for device in array.devices
        }
        collator = Collator([device.info for device in array.devices], train, models)
        intake = _Intake(array.devices, collator, sink, settings.keep_incomplete, told)
        last = count + settings.post_roll - 1
        for k in range(-settings.pre_roll, last + 1):
            array.line.fire(train.time_ns(k))
            intake.take_in()
        deadline = train.time_ns(last) + round(
            1e3 * settings.exposure_us + 1e6 * settings.retention_ms
        )
        while not collator.settled(last) and array.line.now_ns() < deadline:
            array.line.wait(min(array.line.now_ns() + period, deadline))
            intake.take_in()
        return Recording(train, collator.close(), collator.clocks())
    finally:
        for device in array.devices:
            device.acquire.stop()


class _Intake:
    """Moves what has arrived from the devices to the collator and the sink."""

    def __init__(
        self,
        devices: Sequence[Device],
        collator: Collator,
        sink: Sink,
        keep_incomplete: bool,
        told: Callable[[int], None],
    ) -> None:
        self._devices, self._collator, self._sink = devices, collator, sink
        self._keep_incomplete = keep_incomplete
        self._told = told
        self._frames = 0

    def take_in(self) -> None:
        """Place all that has arrived, and write it trigger by trigger."""
        placed = []
        for place, device in enumerate(self._devices):
            for event in device.data.poll():
                where = self._collator.add(event)
                if where.wanted and (event.complete or self._keep_incomplete):
                    placed.append((where.trigger_index, place, event))
                else:
                    device.data.release(event)
        # All views of one instant together: a scene that keeps its last instant computes it once.
        for index, place, event in sorted(placed, key=lambda item: item[:2]):
            self._write(index, self._devices[place], event)

    def _write(self, index: int, device: Device, event: FrameEvent) -> None:
        header = FrameHeader(
            trigger_index=index,
            frame_id=event.frame_id,
            t_dev_ns=event.t_dev_ns,
            t_host_ns=event.t_host_ns,
            exposure_us=event.exposure_us,
            status=0 if event.complete else 1,
        )
        self._sink(device.info.name, header, device.data.pixels(event))
        device.data.release(event)
        self._frames += 1
        self._told(self._frames)
