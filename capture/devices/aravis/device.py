"""A device behind Aravis. It is its own trigger, acquire and frame logic."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from typing import TypeVar

from capture.arrays import Image
from capture.devices.aravis import formats
from capture.devices.aravis.chunks import sends_exposure
from capture.devices.aravis.connection import Connection
from capture.devices.aravis.stream import FrameStream, StreamPlan
from capture.devices.capabilities import FeatureDump, FeatureValue, Health, PtpReading
from capture.devices.protocol import DeviceInfo, TriggerSpec, WholeDevice
from capture.devices.watchdog import Watchdog
from capture.errors import DeviceError
from capture.frame import FrameEvent

Result = TypeVar("Result")

ANSWER_S = 1.0  # for one question; Aravis itself tries for 2.5 s
SETUP_S = 6.0  # for many
_PARTING_S = 2.0
_EXPOSURES = ("ExposureTime", "ExposureTimeAbs")
_TEMPERATURES = ("DeviceTemperature", "TemperatureAbs")


class AravisDevice(WholeDevice):
    """A GigE Vision or USB3 Vision device.

    Every control call runs on a thread of the device's own and has a deadline: a device that is
    gone costs its caller a second, and the other devices nothing.
    """

    def __init__(self, name: str, connection: Connection, control: Watchdog) -> None:
        """Take over an open connection.

        Args:
            name: that the device has in the array.
            connection: to it.
            control: the thread on which the connection was opened.
        """
        self._name, self._connection, self._control = name, connection, control
        self._stream = FrameStream(name)
        self._writes: list[tuple[str, FeatureValue]] = []
        self._spec: TriggerSpec | None = None
        self._exposure_us = -1.0
        self._share = 0.0  # of the period, over which packets are spread; 0 as the device likes
        self._frames = 0
        self._running = self._closed = False
        self._info = self._ask(lambda: connection.describe(name), SETUP_S)

    @property
    def info(self) -> DeviceInfo:
        """What the device says of itself; a changed setting may change it."""
        return self._info

    @property
    def problems(self) -> tuple[str, ...]:
        """What was changed when it was opened, and why it may miss triggers, in words."""
        return self._connection.problems

    def prepare(self, spec: TriggerSpec) -> None:
        """Set the device up for a kind of trigger."""
        self._exposure_us = self._ask(lambda: self._connection.triggers.prepare(spec), SETUP_S)
        self._spec = spec

    def start(self) -> None:
        """Begin to answer triggers."""
        spec = self._spec
        if spec is None:
            raise DeviceError(f"{self._name}: started before it was prepared")
        if not self._frames:
            raise DeviceError(f"{self._name}: started before memory was set aside")
        self._ask(lambda: self._start(spec), SETUP_S)
        self._running = True

    def stop(self) -> None:
        """Cease to answer triggers. What has been exposed can still be fetched."""
        if not self._running:
            return
        self._running = False
        with contextlib.suppress(DeviceError):  # a device that is gone has stopped
            self._ask(lambda: self._connection.command("AcquisitionStop"))

    def reserve(self, frames: int) -> None:
        """Set memory aside for so many frames."""
        self._ask(lambda: self._reserve(frames), SETUP_S)
        self._frames = frames

    def poll(self) -> Sequence[FrameEvent]:
        """The frames that have arrived since the last call; never waits."""
        return self._stream.poll()

    def pixels(self, event: FrameEvent) -> Image:
        """The image of a frame that has not been released, as a view."""
        return self._stream.pixels(event)

    def release(self, event: FrameEvent) -> None:
        """Give the frame's memory back."""
        self._stream.release(event)

    def read_feature(self, name: str) -> FeatureValue:
        """The value of a setting."""
        return self._ask(lambda: self._connection.features.read(name))

    def write_feature(self, name: str, value: FeatureValue) -> None:
        """Set one; it is written again after a loss. Packed pixel formats are refused."""
        self._info = self._ask(lambda: self._write(name, value))
        if self._writes and self._writes[-1][0] == name:
            self._writes.pop()
        self._writes.append((name, value))

    def pace(self, share: float = 0.8) -> int:
        """Spread the packets of each frame over a share of the period, so that the bursts of many
        devices that expose at once pass through one switch; written again after a loss.

        Args:
            share: of the period, above 0 and below 1.

        Returns:
            Pause between packets that the device took, ns.

        Raises:
            DeviceError: when it has no such setting, or does not say how fast its link is.
        """
        spec = self._spec
        if spec is None:
            raise DeviceError(f"{self._name}: the pace is set once it is prepared")
        pause = self._ask(lambda: self._connection.pace(share, spec.period_ns), SETUP_S)
        self._share = share
        return pause

    def features(self) -> FeatureDump:
        """All settings, and the device's own description of them."""
        return self._ask(self._connection.features.dump, SETUP_S)

    def health(self) -> Health:
        """How the device fares; one that is gone says so and does not raise."""
        counters = self._stream.counters() | self._connection.figures()
        try:
            temperature = self._ask(self._temperature)
        except DeviceError:
            return Health(False, None, counters, None, self._stream.free)
        return Health(True, temperature, counters, self._ptp_reading(), self._stream.free)

    def reconnect(self) -> None:
        """Open the device anew, write its settings again, prepare it as before and start it."""
        if not self._closed:
            # It is let go first, or else the device would be in use, by us.
            self._leave(stop=False)
        self._control, self._closed = Watchdog(self._name), False
        self._connection = self._ask(self._connection.again, 2 * SETUP_S)
        self._info = self._ask(lambda: self._connection.describe(self._name), SETUP_S)
        for name, value in self._writes:
            self._info = self._ask(lambda name=name, value=value: self._write(name, value))  # type: ignore[misc]
        if self._spec is not None:
            self.prepare(self._spec)
            if self._share:
                self.pace(self._share)
            if self._frames:
                self.start()

    def close(self) -> None:
        """Stop, and give the device back."""
        if self._closed:
            return
        self._closed, self._running = True, False
        self._leave(stop=True)

    def _ask(self, work: Callable[[], Result], timeout_s: float = ANSWER_S) -> Result:
        return self._control.call(work, timeout_s)

    def _start(self, spec: TriggerSpec) -> None:
        connection = self._connection
        if not self._stream.fits(self._info.layout, connection.payload_bytes()):
            self._reserve(self._frames)  # a setting was written in between
        plan = StreamPlan(
            layout=self._info.layout,
            payload_bytes=connection.payload_bytes(),
            packet_bytes=connection.negotiate(),
            period_ns=spec.period_ns,
            exposure_us=self._exposure_us,
            exposure_sent=sends_exposure(connection.features),
        )
        self._stream.begin(connection.camera, plan)
        connection.command("AcquisitionStart")

    def _reserve(self, frames: int) -> None:
        self._stream.end()
        self._stream.reserve(frames, self._info.layout, self._connection.payload_bytes())

    def _write(self, name: str, value: FeatureValue) -> DeviceInfo:
        features = self._connection.features
        if name == "PixelFormat":
            formats.check_format(self._name, str(value), features.entries(name))
        features.write(name, value)
        self._connection.wrote(name)
        if name in _EXPOSURES and self._exposure_us >= 0:
            self._exposure_us = float(features.read(name))
            self._stream.exposed_for(self._exposure_us)
        return self._connection.describe(self._name)

    def _temperature(self) -> float | None:
        features = self._connection.features
        self._connection.knock()  # a device that was restarted answers, and is ours no more
        name = features.first(*_TEMPERATURES)
        return float(features.read(name)) if name else None

    def _ptp_reading(self) -> PtpReading | None:
        return None

    def _leave(self, *, stop: bool) -> None:
        """Let the connection go on its own thread, which takes seconds for a device that is gone.

        What a new connection needs is free at once: the memory, and the address.
        """
        connection, held = self._connection, [self._stream.end()]
        connection.forget()

        def work() -> None:
            if stop:
                with contextlib.suppress(DeviceError):
                    connection.command("AcquisitionStop")
            held.clear()
            connection.drop()

        self._control.post(work).wait(_PARTING_S)
        self._control.close()  # once what it still does is done
