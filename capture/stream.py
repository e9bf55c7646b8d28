"""An array that streams: frames collated as they come, takes cut out of them as windows.

Devices are never stopped between takes: the first frame after a pause is the one most often lost,
and what happened just before a key was pressed is still in the ring.

Only `Stream` touches the devices' frames; who drives it decides about time and threads. A test or
a demonstration fires and pumps in one thread, in virtual time (`record_frames`); a capture machine
does so in threads of their own (`capture.live`).
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace

from capture.arrays import Image
from capture.collate import Collator, TriggerTrain
from capture.devices.array import DeviceArray
from capture.devices.capabilities import Latching
from capture.devices.protocol import ClockSample, Device, TriggerKind
from capture.errors import DeviceError
from capture.frame import FrameEvent
from capture.frame_header import FrameHeader
from capture.recorder import Recording, RecordSettings
from capture.stream_clocks import StreamClocks
from capture.window import Deliver, HeldFrame, Window

Sink = Callable[[str, FrameHeader, Image], None]

_LOOK_S = 1.0  # how long triggers that others send are looked for before silent devices are left
_LOOK_FRAMES = 4  # of each device that are asked for meanwhile: the first one is often late
_FORGET_EVERY = 256
_FOLLOW_NS = 500_000_000
_PARTED = 0.6  # periods


@dataclass
class DeviceCount:
    """What came of one device since the stream began.

    Attributes:
        received: frames.
        complete: of them, placed and complete.
        last_index: trigger of the latest; -1 before any.
        heard_ns: when the latest arrived, by the host's clock; -1 before any.
        trouble: why it could not be asked for frames; empty again when the next one comes.
    """

    received: int = 0
    complete: int = 0
    last_index: int = -1
    heard_ns: int = -1
    trouble: str = ""


class Stream:
    """Streams an array. `pump` moves what has arrived; everything else may be called beside it.

    Attributes:
        array: the devices and what triggers them.
        settings: rate, exposure, waiting time.
        counts: by device name, what came of it.
        pumped_ns: when it was last looked what has arrived, by the host's clock.
        first_index: the first trigger since devices were numbered anew; no take begins before it.
    """

    def __init__(self, array: DeviceArray, settings: RecordSettings, ring_frames: int = 0) -> None:
        """Hold an array; nothing runs yet.

        Args:
            array: the devices and what triggers them.
            settings: rate, exposure, waiting time.
            ring_frames: how many of the latest frames of each device are held for pre-roll.
        """
        self.array, self.settings = array, settings
        self.counts = {name: DeviceCount() for name in array.names}
        self.pumped_ns = 0
        self._ring_frames = ring_frames
        self._rings: list[deque[HeldFrame]] = [deque() for _ in array.devices]
        self._places = {name: place for place, name in enumerate(array.names)}
        self._clocks = StreamClocks(array, settings)
        self.first_index = 0
        self._looking = True
        self._early: list[FrameEvent] = []  # before the triggers of others were made out
        self._anew: set[str] = set()  # found again, not yet heard
        self._collator: Collator | None = None
        self._windows: list[Window] = []
        self._fired = -1
        self._forgotten = 0
        self._stopped = False
        self._started_ns = self._follow_ns = 0
        self._lock = threading.RLock()

    @property
    def basis(self) -> str:
        """What dates the frames, see `capture.recorder.Recording`."""
        return self._clocks.basis

    @property
    def ready(self) -> bool:
        """Whether the triggers are known; those that others send must first be made out."""
        return self._collator is not None

    def train_from(self, trigger_index: int) -> TriggerTrain:
        """The triggers as they come by now, counted from one of them.

        Raises:
            DeviceError: when they are not known yet.
        """
        if self._collator is None:
            raise DeviceError("no triggers have been made out yet: no frame has come")
        return self._collator.train_from(trigger_index)

    @property
    def next_index(self) -> int:
        """The first trigger that is still to come."""
        if self.array.line.fires or self._collator is None:
            return self._fired + 1
        return max(self._collator.index_at(self.array.line.now_ns()) + 1, 0)

    def start(self, start_ns: int | None = None) -> None:
        """Prepare and start every device, and read its clock.

        Args:
            start_ns: when trigger 0 is to be sent, by the line's clock; None: as soon as may be.

        Raises:
            DeviceError: listing every device that could not be prepared or started, and why.
        """
        line, period = self.array.line, self.settings.period_ns
        reserved = self.settings.ring_frames
        self.array.each("not ready", lambda device: device.frames.reserve(reserved))
        self.array.prepare(period, self.settings.exposure_us)
        if start_ns is not None:
            line.wait(start_ns - period)
        self.array.each("not started", lambda device: device.acquire.start())
        for device in self.array.devices:
            if isinstance(device, Latching):
                self._clocks.read(device.info.name, device)
        self._started_ns = line.now_ns()
        if line.fires:
            begin = start_ns if start_ns is not None else line.now_ns() + period
            self._begin(TriggerTrain(begin, period), {})

    def stop(self) -> None:
        """Stop every device and give all held frames back; windows that are open are closed with
        the triggers that have been sent so far, and none can be opened any more.
        """
        with self._lock, ExitStack() as steps:  # all of them, whatever a device raises
            self._stopped = True
            self.end_windows()
            steps.callback(self._let_go)
            for device in self.array.devices:
                steps.callback(_stop, device)

    def fire(self) -> None:
        """Send the next trigger, waiting until it is due."""
        if self._collator is not None and self.array.line.fires:
            # The line waits itself: a command with a set time must be sent ahead of it.
            try:
                self.array.line.fire(self._collator.train.time_ns(self._fired + 1))
            finally:
                self._fired += 1

    def pump(self) -> None:
        """Place all that has arrived, hand it to open windows, close those that are over."""
        with self._lock:
            # Before polling: what arrives while this is slow has not been looked for yet.
            now, sent = self.array.line.now_ns(), self.next_index
            arrived = [event for device in self.array.devices for event in self._poll(device)]
            if self._looking:
                self._early += arrived
                arrived = self._look()
            if self._collator is not None and not self._looking:
                self._deliver(self._collator, arrived)
                for window in list(self._windows):
                    if self._over(self._collator, window, now, sent):
                        self._close(window)
                self._forget(self._collator)
                if not self.array.line.fires and now >= self._follow_ns:
                    self._follow_ns = now + _FOLLOW_NS
                    self._follow(self._collator, now)
            self.pumped_ns = now

    def open(self, first: int, count: int, deliver: Deliver) -> Window:
        """Open a window.

        Args:
            first: its first trigger; what the ring still holds of it is delivered at once.
            count: how many triggers.
            deliver: given each of its complete frames, in a device's order of arrival; whoever gets
                one calls its `done`.

        Raises:
            DeviceError: when the array was stopped.
        """
        with self._lock:
            if self._stopped:
                raise DeviceError("the array does not stream any more")
            window = Window(first, count, deliver)
            self._windows.append(window)
            held = [h for ring in self._rings for h in ring if first <= h.trigger_index]
            for frame in sorted(held, key=self._order):
                if frame.trigger_index <= window.last:
                    deliver(frame.share())
            return window

    def shorten(self, window: Window) -> None:
        """Let a window end with the triggers that have been sent so far."""
        with self._lock:
            window.count = max(min(window.count, self.next_index - window.first), 1)

    def end_windows(self) -> None:
        """Let all open windows end with the triggers that have been sent so far."""
        with self._lock:
            for window in self._windows:
                self.shorten(window)

    @property
    def busy(self) -> bool:
        """Whether a window is open."""
        return bool(self._windows)

    def restart(self, name: str, samples: Sequence[ClockSample] = ()) -> None:
        """Take a device up anew that was lost and found again.

        Args:
            name: of the device.
            samples: readings of its clock since; none when it cannot be read.
        """
        with self._lock:
            self._clocks.forget(name)
            if samples:
                self._clocks.note(name, samples)
            self._anew.add(name)

    def clock_read(self, name: str, samples: Sequence[ClockSample]) -> None:
        """Note new readings of a device's clock; clocks that date frames are followed."""
        with self._lock:
            self._clocks.note(name, samples)
            if self._collator is not None:
                for device, clock in self._clocks.followed(name).items():
                    self._collator.trust(device, clock)

    def latest(self) -> dict[str, HeldFrame]:
        """The latest complete frame that the ring holds of each device; each wants a `done`."""
        with self._lock:
            return {ring[-1].event.device: ring[-1].share() for ring in self._rings if ring}

    def _order(self, frame: HeldFrame) -> tuple[int, int]:
        # All views of one instant together: a scene that keeps its last instant computes it once.
        return frame.trigger_index, self._places[frame.event.device]

    def _poll(self, device: Device) -> Sequence[FrameEvent]:
        try:
            return device.frames.poll()
        except DeviceError as error:  # the others go on
            self.counts[device.info.name].trouble = str(error)
            return ()

    def _deliver(self, collator: Collator, events: list[FrameEvent]) -> None:
        placed = []
        for event in events:
            place = self._places[event.device]
            count, device = self.counts[event.device], self.array.devices[place]
            count.received += 1
            count.heard_ns, count.trouble = event.t_host_ns, ""
            if event.device in self._anew:
                self._anew.remove(event.device)
                clock = self._clocks.anew(event, collator.train_from(0))
                collator.restart(event.device, clock)
            index = collator.add(event)
            count.last_index = collator.last_index(event.device)
            if index is None or not (event.complete or self.settings.keep_incomplete):
                device.frames.release(event)
                continue
            count.complete += event.complete
            placed.append(HeldFrame(device, event, index))
        for frame in sorted(placed, key=self._order):
            for window in self._windows:
                if window.first <= frame.trigger_index <= window.last:
                    window.deliver(frame.share())
            ring = self._rings[self._places[frame.event.device]]
            if frame.event.complete and self._ring_frames:
                ring.append(frame.share())
            if len(ring) > self._ring_frames:
                ring.popleft().done()
            frame.done()

    def _over(self, collator: Collator, window: Window, now_ns: int, sent: int) -> bool:
        # The edge belongs to it: what comes twice comes after the frame that it repeats.
        last = window.last + self.settings.edge_triggers
        if collator.settled(last):
            return True
        if last >= sent:
            return False
        # A host that stalls sends late: frames are waited for from when the last trigger was seen
        # to be sent, and what was sent while it looked has not been looked for.
        if window.sent_ns is None:
            window.sent_ns = now_ns
        wait_ns = round(1e3 * self.settings.exposure_us + 1e6 * self.settings.retention_ms)
        return now_ns >= max(collator.train_from(last).start_ns, window.sent_ns) + wait_ns

    def _follow(self, collator: Collator, now_ns: int) -> None:
        """Follow what is not ours to fire; between takes, number devices that parted anew.

        Devices that run free have each their own pace: 40 millionths make eleven frames an hour.
        """
        collator.follow()
        free = self.array.trigger == TriggerKind.FREE_RUN
        if free and not self._windows and collator.parted() > _PARTED:
            self._looking, self._started_ns = True, now_ns

    def _look(self) -> list[FrameEvent]:
        """Make out triggers that others send; the frames so far once that is done."""
        heard = Counter(event.device for event in self._early)
        few = len(heard) < len(self.counts) or min(heard.values()) < _LOOK_FRAMES
        waited = self.array.line.now_ns() - self._started_ns
        if not heard or (few and waited < 1e9 * _LOOK_S):
            return []
        early, self._early = self._early, []
        train, phases = self._clocks.make_out(early)
        # Numbers go on: what was exposed before keeps its own.
        self.first_index = max(count.last_index for count in self.counts.values()) + 1
        self._begin(replace(train, start_ns=train.time_ns(-self.first_index)), phases)
        return early

    def _begin(self, train: TriggerTrain, phases: Mapping[str, int]) -> None:
        clocks = self._clocks.begin(phases)
        self._collator = Collator([device.info for device in self.array.devices], train, clocks)
        self._looking = False

    def _close(self, window: Window) -> None:
        self._windows.remove(window)
        if self._collator is not None:
            edge = self.settings.edge_triggers
            first, triggers = max(window.first - edge, 0), window.count
            count = window.first - first + triggers + edge
            part, readings = self._collator.cut(first, count), self._clocks.readings()
            basis = self._clocks.basis

            def make() -> Recording:
                return Recording(
                    part.train_from(window.first),
                    part.ledger(window.first, triggers),
                    part.clocks(first, count),
                    basis,
                    readings,
                )

            window.close(make)
        else:
            window.close(None)

    def _let_go(self) -> None:
        for window in list(self._windows):
            self._close(window)
        for ring in self._rings:
            while ring:
                ring.popleft().done()
        for event in self._early:
            self.array.devices[self._places[event.device]].frames.release(event)
        self._early = []

    def _forget(self, collator: Collator) -> None:
        newest = max(count.last_index for count in self.counts.values())
        oldest = min([window.first for window in self._windows], default=newest)
        # The ring of a device that died holds its last frames for ever: no window asks for those.
        before = min(oldest, newest - max(self._ring_frames, _FORGET_EVERY))
        before -= self.settings.edge_triggers
        if before >= self._forgotten + _FORGET_EVERY:
            collator.forget(before)
            self._forgotten = before


def _stop(device: Device) -> None:
    with suppress(DeviceError):  # one that is gone cannot be stopped, nor need it be
        device.acquire.stop()


def record_frames(
    array: DeviceArray,
    settings: RecordSettings,
    sink: Sink,
    *,
    count: int,
    start_ns: int | None = None,
    told: Callable[[int], None] = lambda frames: None,
) -> Recording:
    """Record `count` triggers of an array, firing and writing in the calling thread.

    For arrays in virtual time, whose devices render when a frame is fetched: one image is in memory
    at a time. An array that streams in real time is recorded by `capture.live`.

    Args:
        array: the devices and the line that triggers them.
        settings: rate, exposure, waiting time; pre-roll and post-roll are part of `count`.
        sink: given each frame of the take, with its trigger index, as it comes.
        count: how many triggers belong to the take.
        start_ns: when trigger 0 is sent, by the line's clock; None: as soon as all is ready.
        told: called with the number of frames that have gone to the sink.

    Raises:
        DeviceError: when a device cannot be prepared.
    """
    edge, period, frames = settings.edge_triggers, settings.period_ns, 0
    stream = Stream(array, settings)

    def write(frame: HeldFrame) -> None:
        nonlocal frames
        sink(frame.event.device, frame.header(edge), frame.device.frames.pixels(frame.event))
        frame.done()
        frames += 1
        told(frames)

    try:
        stream.start(None if start_ns is None else start_ns - edge * period)
        window = stream.open(edge, count, write)
        for _ in range(count + 2 * edge):
            stream.fire()
            stream.pump()
        while not window.closed.is_set():
            array.line.wait(array.line.now_ns() + period)
            stream.pump()
        if window.recording is None:
            raise DeviceError("the array was stopped before its first frame")
        return window.recording
    finally:
        stream.stop()
