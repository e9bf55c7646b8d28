"""Simulated devices: their own clocks, latencies and faults, pixels from a scene.

Time is virtual: it stands still while a scene renders. A device renders nothing itself. It asks its
scene for the pixels when they are fetched, one image at a time from the thread that fetches; a
scene may own a graphics context, which belongs to one thread.
"""

from __future__ import annotations

import heapq
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from importlib import metadata
from typing import Any, Protocol

import numpy as np

from capture.arrays import Image
from capture.camera import Camera, CameraArray
from capture.devices.protocol import ClockSample, DeviceArray, DeviceInfo, TriggerKind, TriggerSpec
from capture.errors import DeviceError, SettingsError
from capture.frame import Clock, FrameEvent
from capture.frame_header import ImageLayout

SCENE_GROUP = "likeness.scenes"

_LATCH_NS = 200_000  # a register read over the network takes about this long


class Scene(Protocol):
    """What simulated devices look at."""

    def render(self, camera: Camera, t_ns: int) -> Image:
        """The image that `camera` takes at the true time `t_ns`, noise of the sensor included."""


class FaultKind(StrEnum):
    """What can go wrong at one trigger."""

    LOSE_FRAME = "lose_frame"  # exposed and numbered, never delivered
    MISS_TRIGGER = "miss_trigger"  # not exposed, not numbered
    DUPLICATE = "duplicate"  # delivered twice
    STALE = "stale"  # the frame of two triggers ago is delivered once more, after the new one
    INCOMPLETE = "incomplete"  # delivered with parts missing
    CLOCK_STEP = "clock_step"  # the device's clock jumps by `amount_ns`, from here on
    ID_RESET = "id_reset"  # the device's numbers begin again at 1


@dataclass(frozen=True)
class Fault:
    """One thing that goes wrong.

    Attributes:
        kind: what.
        edge: at which edge of the trigger line since the device was started, counted from 0.
        amount_ns: how far a clock steps.
    """

    kind: FaultKind
    edge: int
    amount_ns: int = 0


@dataclass(frozen=True, kw_only=True)
class SimulatedSettings:
    """How a simulated device behaves.

    Attributes:
        clock: its own clock.
        latency_ms: from the end of an exposure to the arrival of the frame.
        latency_jitter_ms: standard deviation of that, one-sided.
        id_bits: width of its frame numbers, 8 to 64.
        first_id: the first frame's number.
        faults: what goes wrong.
        channels: 1 mono, 3 RGB.
        dtype: "uint8" or "uint16".
        seed: of the latency.
    """

    clock: Clock = field(default_factory=Clock)
    latency_ms: float = 6.0
    latency_jitter_ms: float = 0.5
    id_bits: int = 16
    first_id: int = 1
    faults: tuple[Fault, ...] = ()
    channels: int = 1
    dtype: str = "uint8"
    seed: int = 0

    def __post_init__(self) -> None:
        if not 8 <= self.id_bits <= 64:
            raise SettingsError(f"id_bits must lie in 8..64, found {self.id_bits}")
        if not 1 <= self.first_id < 1 << self.id_bits:
            raise SettingsError(f"first_id must fit {self.id_bits} bits, found {self.first_id}")
        if not (self.latency_ms >= 0 and self.latency_jitter_ms >= 0):
            raise SettingsError("latency_ms and latency_jitter_ms must be 0 or more")


class SimulatedLine:
    """A trigger line in virtual time: waiting is instant, and every device sees each edge."""

    def __init__(self) -> None:
        self._now_ns = 0
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


class SimulatedDevice:
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
        )
        self._scene, self._line, self._settings = scene, line, settings
        self._random = np.random.default_rng((settings.seed, 0x5EED))
        self._spec: TriggerSpec | None = None
        self._running = False
        self._edge = 0
        self._next_id = settings.first_id
        self._clock = settings.clock
        self._arrival_ns = 0
        self._slot = 0
        self._pending: list[tuple[int, int, FrameEvent]] = []
        self._exposed: dict[int, int] = {}  # true time of exposure, by slot
        self._history: list[tuple[FrameEvent, int]] = []
        line.connect(self)

    @property
    def trigger(self) -> SimulatedDevice:
        """When it exposes."""
        return self

    @property
    def acquire(self) -> SimulatedDevice:
        """How it is armed."""
        return self

    @property
    def data(self) -> SimulatedDevice:
        """Where its frames are."""
        return self

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
        self._running, self._edge, self._arrival_ns = True, 0, 0
        self._pending.clear()
        self._exposed.clear()
        self._history.clear()

    def stop(self) -> None:
        """Cease to answer edges."""
        self._running = False

    def latch(self) -> ClockSample:
        """Read the device's clock; the answer takes a while, of which the device's share varies."""
        before = self._line.now_ns()
        share = float(self._random.uniform(0.3, 0.7))
        return ClockSample(
            self._clock.read(before + round(share * _LATCH_NS)), before, before + _LATCH_NS
        )

    def edge(self, t_ns: int) -> None:
        """An edge on the trigger line at the true time `t_ns`."""
        if not self._running or self._spec is None:
            return
        faults = {fault.kind: fault for fault in self._settings.faults if fault.edge == self._edge}
        self._edge += 1
        if FaultKind.CLOCK_STEP in faults:
            step = faults[FaultKind.CLOCK_STEP].amount_ns
            self._clock = replace(self._clock, offset_ns=self._clock.offset_ns + step)
        if FaultKind.ID_RESET in faults:
            self._next_id = 1
        if FaultKind.MISS_TRIGGER in faults:
            return
        frame_id, self._next_id = self._next_id, self._following(self._next_id)
        exposure_us = self._spec.exposure_us
        latency = self._settings.latency_ms + self._settings.latency_jitter_ms * abs(
            self._random.standard_normal()
        )
        arrival = t_ns + round(1000 * exposure_us + 1e6 * latency)
        event = FrameEvent(
            self.info.name, frame_id, self._clock.read(t_ns), arrival, 0, exposure_us,
            FaultKind.INCOMPLETE not in faults,
        )  # fmt: skip
        self._history = [*self._history[-2:], (event, t_ns)]
        if FaultKind.LOSE_FRAME in faults:
            return
        self._deliver(event, t_ns)
        if FaultKind.DUPLICATE in faults:
            self._deliver(event, t_ns)
        if FaultKind.STALE in faults:
            self._deliver(*self._history[0])

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

    def _deliver(self, event: FrameEvent, t_ns: int) -> None:
        # Frames of one device arrive in the order it sent them, whatever the jitter.
        self._arrival_ns = max(event.t_host_ns, self._arrival_ns + 1)
        self._slot += 1
        self._exposed[self._slot] = t_ns
        event = replace(event, t_host_ns=self._arrival_ns, slot=self._slot)
        heapq.heappush(self._pending, (self._arrival_ns, self._slot, event))

    def _following(self, frame_id: int) -> int:
        return 1 if frame_id + 1 >= 1 << self._settings.id_bits else frame_id + 1


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


def load_scene(name: str) -> Any:
    """The function that opens the scene called `name`, found by entry point `likeness.scenes`.

    Raises:
        SettingsError: naming the scenes that are installed.
    """
    found = {entry.name: entry for entry in metadata.entry_points(group=SCENE_GROUP)}
    if name not in found:
        raise SettingsError(f"no scene {name!r}; installed: {', '.join(sorted(found)) or 'none'}")
    return found[name].load()
