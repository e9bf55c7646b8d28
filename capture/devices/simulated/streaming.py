"""`StreamingDevice`: a simulated device in real time, with all that a good real one can do."""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from capture.arrays import Image
from capture.devices.array import DeviceArray
from capture.devices.capabilities import FeatureDump, FeatureValue, Health, PtpReading
from capture.devices.faults import Exposure, Fault
from capture.devices.lines import RealTimeLine
from capture.devices.protocol import DeviceInfo, TriggerKind, TriggerSpec
from capture.devices.real_time import RealTimeDevice
from capture.devices.simulated.features import FeatureTable
from capture.devices.simulated.pattern import STAMP_BYTES, PatternWriter, Stamp, device_crc
from capture.devices.simulated.settings import SimulatedSettings
from capture.errors import SettingsError
from capture.frame import Clock
from capture.frame_header import ImageLayout

_PTP_EPOCH_NS = 1_700_000_000 * 10**9  # what clocks that follow PTP show at the host's time 0
_SOURCES = {TriggerKind.HARDWARE: "Line0", TriggerKind.SOFTWARE: "Software"}
_FORMATS = {(1, "uint8"): "Mono8", (1, "uint16"): "Mono16", (3, "uint8"): "RGB8"}
_LOOPS_TO = "grandmaster-sim"


class PatternSource:
    """What a simulated device sends in real time: the pattern, dated by its own clock."""

    def __init__(self, name: str, layout: ImageLayout, settings: SimulatedSettings) -> None:
        """Begin with the first frame's number.

        Args:
            name: of the device.
            layout: of its frames, at least as large as a stamp.
            settings: clock, latency and numbers.
        """
        if layout.nbytes < 2 * STAMP_BYTES:
            raise SettingsError(
                f"{name}: images need at least {2 * STAMP_BYTES} bytes for their stamp, "
                f"found {layout}"
            )
        self._settings, self._writer = settings, PatternWriter(layout)
        self._crc = device_crc(name)
        self._random = random.Random(settings.seed)
        self._number = settings.first_id
        self.set_clock(settings.clock)
        self.exposure_us = 1000.0

    def set_clock(self, clock: Clock, follows: bool = False) -> None:
        """Give the device another clock.

        Args:
            clock: its own, or one that follows others.
            follows: whether it follows others.
        """
        self._jitter_ns, self._follows = clock.jitter_ns, follows
        self._clock = replace(clock, jitter_ns=0.0)

    def begin(self, t_ns: int, spec: TriggerSpec) -> None:
        """Nothing to do: numbers and clock go on."""

    def exposure(self, edge: int, t_ns: int) -> Exposure:
        """Every trigger exposes."""
        number, self._number = self._number, self._number + 1
        t_dev_ns = self._clock.read(t_ns)
        if self._jitter_ns:
            t_dev_ns += round(self._random.gauss(0.0, self._jitter_ns))
        return Exposure(edge, t_ns, number, t_dev_ns, self.exposure_us)

    def lag_ns(self, exposure: Exposure) -> int:
        """Exposure and latency; the jitter of the latency is one-sided."""
        settings = self._settings
        latency_ms = settings.latency_ms
        if settings.latency_jitter_ms:
            latency_ms += abs(self._random.gauss(0.0, settings.latency_jitter_ms))
        return round(1000 * exposure.exposure_us + 1e6 * latency_ms)

    def fill(self, exposure: Exposure, into: Image) -> str:
        """The pattern; of an incomplete image the first half, the rest is what was there before."""
        stamp = Stamp(self._crc, exposure.place, exposure.number, exposure.t_ns)
        self._writer.write(stamp, into if exposure.complete else into[: len(into) // 2])
        return ""

    def free_period_ns(self, period_ns: int) -> int:
        """By the device's own clock."""
        return round(period_ns / (1 + 1e-6 * self._clock.drift_ppm))

    def clock_ns(self, t_ns: int) -> int:
        """The device's clock, without jitter."""
        return self._clock.read(t_ns)

    def reboot_ns(self, t_ns: int) -> int:
        """To 0; a clock that follows PTP is set right again at once."""
        return 0 if self._follows else self._clock.read(t_ns)


class StreamingDevice(RealTimeDevice):
    """A simulated device in real time; all its settings can be set while it streams."""

    def __init__(
        self,
        name: str,
        layout: ImageLayout,
        line: RealTimeLine,
        settings: SimulatedSettings,
        address: str = "",
    ) -> None:
        """Connect a device to its line.

        Args:
            name: in the array.
            layout: of its frames.
            line: the wire for hardware triggers.
            settings: how it behaves.
            address: by which it was opened.
        """
        self._pattern = PatternSource(name, layout, settings)
        info = DeviceInfo(
            name=name,
            serial=f"SIM-{settings.seed:04d}",
            model="likeness simulated",
            layout=layout,
            id_bits=settings.id_bits,
            triggers=(TriggerKind.HARDWARE, TriggerKind.SOFTWARE, TriggerKind.FREE_RUN),
            first_id=settings.wraps_to,
            address=address,
            link_mbps=10_000.0,
        )
        super().__init__(info, self._pattern, line, settings.faults)
        self._own_clock = settings.clock
        self._features = FeatureTable(
            {
                "Width": layout.width,
                "Height": layout.height,
                "PixelFormat": _FORMATS.get((layout.channels, layout.dtype), "RGB16"),
                "DeviceModelName": info.model,
                "DeviceSerialNumber": info.serial,
            }
        )
        self._ptp = PtpReading("disabled")
        self._ptp_on = PtpReading("slave", settings.seed % 400 - 200, _LOOPS_TO)
        self.temperature_c = 41.0

    def prepare(self, spec: TriggerSpec) -> None:
        """Set the device up for a kind of trigger: mode, source and exposure, in that order."""
        super().prepare(spec)
        self._features.write("TriggerMode", "Off")
        if spec.kind in _SOURCES:
            self._features.write("TriggerSource", spec.source or _SOURCES[spec.kind])
            self._features.write("TriggerMode", "On")
        self._features.write("ExposureTime", spec.exposure_us)
        self._features.write("AcquisitionFrameRate", 1e9 / spec.period_ns)
        self._pattern.exposure_us = float(self._features.read("ExposureTime"))

    def read_feature(self, name: str) -> FeatureValue:
        """The value of a setting."""
        self._answer()
        return self._features.read(name)

    def write_feature(self, name: str, value: FeatureValue) -> None:
        """Set one; an exposure time counts from the next frame on."""
        self._answer()
        became = self._features.write(name, value)
        if name == "ExposureTime":
            self._pattern.exposure_us = float(became)
        if name == "PtpEnable":
            self._follow(bool(became))

    def features(self) -> FeatureDump:
        """All settings."""
        self._answer()
        return self._features.dump()

    def health(self) -> Health:
        """How it fares."""
        return replace(super().health(), temperature_c=self.temperature_c, ptp=self._ptp)

    def enable_ptp(self, on: bool) -> None:
        """Let the clock follow that of all others, or go its own way again."""
        self.write_feature("PtpEnable", on)

    def ptp(self) -> PtpReading:
        """The state now."""
        self._answer()
        return self._ptp

    def set_ptp(self, reading: PtpReading) -> None:
        """Choose what the device says of its clock while PTP is enabled; a locked one is off by it.

        Args:
            reading: state, offset and grandmaster.
        """
        self._ptp_on = reading
        self._follow(bool(self._features.read("PtpEnable")))

    def _follow(self, on: bool) -> None:
        self._ptp = self._ptp_on if on else PtpReading("disabled")
        if self._ptp.locked:
            offset_ns = _PTP_EPOCH_NS + (self._ptp.offset_ns or 0)
            self._pattern.set_clock(Clock(offset_ns=offset_ns), follows=True)
        elif not on:
            self._pattern.set_clock(self._own_clock)


def streaming_settings(seed: int, first_id: int | None = None) -> SimulatedSettings:
    """A device drawn at random: its clock is off by up to 500 s and drifts by up to 40 ppm, frames
    arrive 3 to 9 ms after exposure, numbers begin anywhere in their 16 bits.

    Args:
        seed: of the draw.
        first_id: the first frame's number, when it is not drawn.
    """
    draw = np.random.default_rng((seed, 0xA44B))
    return SimulatedSettings(
        clock=Clock(
            offset_ns=int(draw.integers(0, 500 * 10**9)),
            drift_ppm=float(draw.uniform(-40.0, 40.0)),
            jitter_ns=1000.0,
        ),
        latency_ms=float(draw.uniform(3.0, 9.0)),
        first_id=int(draw.integers(1, 1 << 16)) if first_id is None else first_id,
        seed=seed,
    )


def streaming_array(
    count: int,
    layout: ImageLayout,
    *,
    seed: int = 0,
    faults: Mapping[str, Sequence[Fault]] | None = None,
    line: RealTimeLine | None = None,
) -> DeviceArray:
    """An array of devices cam00, cam01, ... that are simulated in real time.

    Args:
        count: how many.
        layout: of their frames.
        seed: of clocks, latencies and first frame numbers.
        faults: what goes wrong after every start, by device name.
        line: the wire they are connected to; a new one when not given.
    """
    wire = line if line is not None else RealTimeLine()
    names = [f"cam{place:02d}" for place in range(count)]
    unknown = sorted(set(faults or {}) - set(names))
    if unknown:
        raise SettingsError(
            f"faults of unknown devices: {', '.join(unknown)}; there are {', '.join(names)}"
        )
    devices = []
    for place, name in enumerate(names):
        settings = streaming_settings(seed * 1000 + place)
        own = replace(settings, faults=tuple((faults or {}).get(name, ())))
        devices.append(StreamingDevice(name, layout, wire, own))
    return DeviceArray(tuple(devices), wire)
