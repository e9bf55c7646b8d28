"""Simulated devices in virtual time: their own clocks, latencies and faults, pixels from a scene.

Time is virtual: it stands still while a scene renders. A device renders nothing itself. It asks its
scene for the pixels when they are fetched, one image at a time from the thread that fetches; a
scene may own a graphics context, which belongs to one thread.
"""

from __future__ import annotations

import heapq
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from capture.arrays import Image
from capture.camera import Camera, CameraArray
from capture.devices.array import DeviceArray
from capture.devices.faults import Exposure, Fault, FaultBook
from capture.devices.protocol import ClockSample, DeviceInfo, TriggerKind, TriggerSpec, WholeDevice
from capture.devices.simulated.scene import Scene
from capture.devices.simulated.settings import SimulatedSettings
from capture.errors import DeviceError, SettingsError
from capture.frame import Clock, FrameEvent
from capture.frame_header import ImageLayout

_LATCH_NS = 200_000  # a register read over the network takes about this long


class SimulatedLine:
    """A trigger line in virtual time: waiting is instant, and every device sees each edge."""

    def __init__(self) -> None:
        self._now_ns = 0
        self.fires = True
        self._devices: list[SimulatedDevice] = []

    def connect(self, device: SimulatedDevice) -> None:
        """Wire a device to the line."""
        self._devices.append(device)

    def now_ns(self) -> int:
        """The virtual time."""
        return self._now_ns

    def wait(self, t_ns: int) -> None:
        """Set the virtual time; a retake may set it back."""
        self._now_ns = t_ns

    def fire(self, t_ns: int) -> None:
        """Send an edge at `t_ns`."""
        self._now_ns = t_ns
        for device in self._devices:
            device.edge(t_ns)


class SimulatedDevice(WholeDevice):
    """One simulated device. It is its own trigger, acquire and data logic."""

    def __init__(
        self, camera: Camera, scene: Scene, line: SimulatedLine, settings: SimulatedSettings
    ) -> None:
        """Wire a device to its line.

        Args:
            camera: where it stands and what its lens does; its name is the device's.
            scene: what it looks at.
            line: what triggers it, and the host's clock.
            settings: how it behaves.
        """
        self.camera = camera
        self.info = DeviceInfo(
            name=camera.name,
            serial=f"SIM-{camera.name}",
            model="likeness simulated",
            layout=ImageLayout(camera.width, camera.height, settings.channels, settings.dtype),
            id_bits=settings.id_bits,
            triggers=(TriggerKind.HARDWARE,),
            first_id=settings.wraps_to,
        )
        self._scene, self._line, self._settings = scene, line, settings
        self._random = np.random.default_rng((settings.seed, 0x5EED))
        self._spec: TriggerSpec | None = None
        self._running = False
        self._book = FaultBook(settings.id_bits, settings.wraps_to, settings.faults)
        self._number = settings.first_id
        self._arrival_ns = 0
        self._slot = 0
        self._pending: list[tuple[int, int, FrameEvent]] = []
        self._exposed: dict[int, int] = {}  # true time of exposure, by slot
        line.connect(self)

    def reserve(self, frames: int) -> None:
        """Nothing to do: a scene renders a frame when it is fetched."""

    def close(self) -> None:
        """Cease to answer edges."""
        self.stop()

    def prepare(self, spec: TriggerSpec) -> None:
        """Set the device up for hardware triggers."""
        if spec.kind not in self.info.triggers:
            raise DeviceError(
                f"asked for {spec.kind} triggers, offers {', '.join(self.info.triggers)}"
            )
        self._spec = spec

    def start(self) -> None:
        """Begin to answer edges; they are counted from 0 again."""
        if self._spec is None:
            raise DeviceError(f"{self.info.name}: started before it was prepared")
        self._running, self._arrival_ns = True, 0
        self._book.begin()
        self._pending.clear()
        self._exposed.clear()

    def stop(self) -> None:
        """Cease to answer edges."""
        self._running = False

    def latch(self) -> ClockSample:
        """Read the device's clock; the answer takes a while, of which the device's share varies."""
        before = self._line.now_ns()
        share = float(self._random.uniform(0.3, 0.7))
        t_ns = before + round(share * _LATCH_NS)
        return ClockSample(self._clock_ns(t_ns), before, before + _LATCH_NS)

    def inject(self, fault: Fault) -> None:
        """Let something go wrong, at the next edge unless the fault names another."""
        self._book.inject(fault)

    def edge(self, t_ns: int) -> None:
        """An edge on the trigger line at the true time `t_ns`."""
        if not self._running or self._spec is None:
            return
        exposure_us = self._spec.exposure_us
        t_dev_ns = self._settings.clock.read(t_ns)
        would = Exposure(self._book.edge, t_ns, self._number, t_dev_ns, exposure_us)
        self._number += 1
        outcome = self._book.trigger(t_ns, would)
        if not outcome.exposed:
            return
        latency = self._settings.latency_ms + self._settings.latency_jitter_ms * abs(
            self._random.standard_normal()
        )
        for exposure in outcome.sent:
            self._deliver(exposure, t_ns + round(1000 * exposure_us + 1e6 * latency))

    def poll(self) -> Sequence[FrameEvent]:
        """The frames that have arrived by now."""
        arrived = []
        while self._pending and self._pending[0][0] <= self._line.now_ns():
            arrived.append(heapq.heappop(self._pending)[2])
        return arrived

    def pixels(self, event: FrameEvent) -> Image:
        """What the scene shows at the true time of the exposure."""
        image = self._scene.render(self.camera, self._exposed[event.slot])
        if ImageLayout.of(image) != self.info.layout:
            raise DeviceError(
                f"{self.info.name}: the scene gave {ImageLayout.of(image)}, "
                f"expected {self.info.layout}"
            )
        return image

    def release(self, event: FrameEvent) -> None:
        """Forget the frame."""
        del self._exposed[event.slot]

    def _clock_ns(self, t_ns: int) -> int:
        return self._book.clock_ns(t_ns, self._settings.clock.read(t_ns))

    def _deliver(self, exposure: Exposure, arrival_ns: int) -> None:
        # Frames of one device arrive in the order it sent them, whatever the jitter.
        self._arrival_ns = max(arrival_ns, self._arrival_ns + 1)
        self._slot += 1
        self._exposed[self._slot] = exposure.t_ns
        event = FrameEvent(
            self.info.name, exposure.number, exposure.t_dev_ns, self._arrival_ns, self._slot,
            exposure.exposure_us, exposure.complete,
        )  # fmt: skip
        heapq.heappush(self._pending, (self._arrival_ns, self._slot, event))


def simulated_array(
    cameras: CameraArray,
    scene: Scene,
    *,
    seed: int = 0,
    faults: Mapping[str, Sequence[Fault]] | None = None,
    settings: SimulatedSettings | None = None,
) -> DeviceArray:
    """One simulated device a camera, each with its own clock and latency.

    Clocks are off by up to 500 s, drift by up to 40 ppm and jitter by 1 us; frames arrive 3 to 9 ms
    after exposure; frame numbers begin anywhere in their 16 bits, so some wrap.

    Args:
        cameras: where the devices stand.
        scene: what they look at.
        seed: of clocks, latencies and first frame numbers.
        faults: what goes wrong, by device name.
        settings: what clocks, latencies and first numbers are put into; the default is mono uint8.
    """
    random = np.random.default_rng((seed, 0xA44A))
    line = SimulatedLine()
    usual = settings if settings is not None else SimulatedSettings()
    unknown = sorted(set(faults or {}) - set(cameras.names))
    if unknown:
        raise SettingsError(
            f"faults of unknown devices: {', '.join(unknown)}; there are {', '.join(cameras.names)}"
        )
    devices = []
    for place, camera in enumerate(cameras):
        clock = Clock(
            offset_ns=int(random.integers(0, 500 * 10**9)),
            drift_ppm=float(random.uniform(-40.0, 40.0)),
            jitter_ns=1000.0,
            seed=seed * 1000 + place,
        )
        own = replace(
            usual,
            clock=clock,
            latency_ms=float(random.uniform(3.0, 9.0)),
            first_id=int(random.integers(1, 1 << min(usual.id_bits, 16))),
            faults=tuple((faults or {}).get(camera.name, ())),
            seed=seed * 1000 + place,
        )
        devices.append(SimulatedDevice(camera, scene, line, own))
    return DeviceArray(tuple(devices), line)
