"""An array that streams all the time, in threads of its own; a take is a window of its triggers.

Threads: one fires the triggers that are ours to fire, one moves what arrives, one watches the
devices, lanes write, and each take has one that sees it through to its end.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType

from capture.arrays import Image
from capture.device_watch import DeviceState, DeviceWatch
from capture.devices.array import DeviceArray
from capture.devices.capabilities import Health, Reconnecting
from capture.disk_faults import Disk
from capture.errors import DeviceError, LikenessError, TakeError
from capture.lanes import WriteLanes
from capture.live_take import LiveTake
from capture.recorder import Recording, RecordSettings
from capture.session import Session, Shot, opening_of
from capture.stream import Stream
from capture.take_writer import TakeWriter, partial_folder

_RING_SPARE = 8  # frames that may arrive between the key and the opening of the window
_STOP_S = 2.0  # how long the last frames are waited for
_START_S = 5.0  # how long the first frames are waited for


class LiveArray:
    """Streams an array in threads of its own. Used in a `with` block.

    Attributes:
        array: the devices and what triggers them.
        settings: rate, exposure, pre-roll, memory.
        trouble: why streaming ended by itself; empty while all is well.
    """

    def __init__(
        self, array: DeviceArray, settings: RecordSettings, disk: Disk | None = None
    ) -> None:
        """Hold an array; nothing runs yet.

        Args:
            array: the devices and what triggers them.
            settings: rate, exposure, pre-roll, memory.
            disk: that takes are written to; this machine's when not given.
        """
        self.array, self.settings = array, settings
        self._disk = disk
        self.trouble = ""
        self._stream = self._fresh_stream()
        self._watch: DeviceWatch | None = None
        self._lanes: WriteLanes | None = None
        self._running = threading.Event()
        self._threads: list[threading.Thread] = []
        self._takes: list[threading.Thread] = []
        self._numbers: dict[tuple[Path, str], int] = {}
        self._checking = threading.Lock()  # one take is read back at a time

    def __enter__(self) -> LiveArray:
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    @property
    def running(self) -> bool:
        """Whether it streams."""
        return self._running.is_set()

    def start(self) -> None:
        """Prepare every device, start it, and wait until frames arrive.

        Raises:
            DeviceError: listing every device that could not be prepared or stays silent.
        """
        if self.running:
            return
        self.stop()  # what is left when it ended by itself
        self._stream, self.trouble = self._fresh_stream(), ""
        self._watch, self._lanes = DeviceWatch(self._stream), WriteLanes()
        self._running.set()
        try:
            self._stream.start()
            loops = [self._pump, self._look_after]
            if self.array.line.fires:
                loops.append(self._fire)
            for loop in loops:
                thread = threading.Thread(target=self._guarded, args=(loop,), daemon=True)
                self._threads.append(thread)
                thread.start()
            self._await_frames()
        except BaseException:
            self.stop()
            raise

    def stop(self) -> None:
        """End the takes that are being recorded with what was exposed, and stop the devices."""
        if self._lanes is None or self._watch is None:
            return
        self._stream.end_windows()
        deadline = time.monotonic() + _STOP_S
        while self._stream.busy and self.running and time.monotonic() < deadline:
            time.sleep(0.005)
        self._running.clear()
        for thread in self._threads:
            thread.join()
        self._watch.close()
        try:
            self._stream.stop()
        finally:
            for thread in self._takes:  # before the lanes: a take's files may still be being made
                thread.join()
            self._lanes.close()
            self._threads, self._takes, self._lanes = [], [], None

    def record(self, session: Session, shot: Shot) -> LiveTake:
        """Open the window of a take now; returns at once.

        The window begins `settings.pre_roll` triggers ago, out of the ring, holds `shot.frames`
        triggers from now, and `settings.post_roll` after them.

        Raises:
            DeviceError: when the array does not stream.
        """
        lanes, stream, watch = self._lanes, self._stream, self._watch
        if lanes is None or watch is None or not self.running or not stream.ready:
            raise DeviceError(f"{shot.slate}: {self.trouble or 'the array does not stream'}")
        count = self.settings.pre_roll + shot.frames + self.settings.post_roll
        number = self._next_number(session, shot.slate)
        folder = session.folder / "takes" / f"{shot.slate}_{number:03d}"
        first = max(stream.next_index - self.settings.pre_roll, stream.first_index)
        opening = opening_of(shot, number, self.settings, stream.train_from(first))
        take = LiveTake(shot, number, folder, opening)
        take.begin(stream, lanes, first, count)

        def make() -> TakeWriter:
            layouts = {device.info.name: device.info.layout for device in self.array.devices}
            return TakeWriter(
                partial_folder(folder), layouts, opening=opening, expected_frames=count,
                disk=self._disk,
            )  # fmt: skip

        thread = threading.Thread(
            target=take.see_through, args=(make, watch, self._checking), daemon=True
        )
        self._takes = [other for other in self._takes if other.is_alive()] + [thread]
        thread.start()
        return take

    def burst(self, triggers: int) -> Recording:
        """Collate so many triggers from now without writing them, and wait for them.

        Raises:
            DeviceError: when the array does not stream, or ceases to.
        """
        stream = self._stream
        window = stream.open(stream.next_index, triggers, lambda frame: frame.done())
        while not window.closed.wait(0.1):
            if not self.running:
                raise DeviceError(self.trouble or "the array does not stream; start it first")
        if window.recording is None:
            raise DeviceError("the array was stopped before its first frame")
        return window.recording

    def states(self) -> tuple[DeviceState, ...]:
        """How each device fares, in the array's order; nothing while the array is stopped."""
        return self._watch.states() if self._watch is not None else ()

    def health(self) -> Mapping[str, Health]:
        """What each device said of itself last; some can say nothing."""
        return self._watch.health() if self._watch is not None else {}

    def latest(self) -> dict[str, Image]:
        """A copy of the latest complete image of each device that has one."""
        images = {}
        with ExitStack() as held:
            latest = self._stream.latest()
            for frame in latest.values():
                held.callback(frame.done)
            for name, frame in latest.items():
                images[name] = frame.device.frames.pixels(frame.event).copy()
        return images

    def reconnect(self, name: str) -> None:
        """Find a device again that was lost, while the others go on or while all are stopped.

        Raises:
            DeviceError: when it is not there, or cannot be found again.
            TakeError: when the array has no such device.
        """
        found = [device for device in self.array.devices if device.info.name == name]
        if not found:
            raise TakeError(f"no device {name!r}; there are {', '.join(self.array.names)}")
        device = found[0]
        if self._watch is not None and self.running:
            self._watch.reconnect(device)
        elif isinstance(device, Reconnecting):
            device.reconnect()
            device.acquire.stop()  # it is started with the others
        else:
            raise DeviceError(f"{name}: cannot be found again; leave, and open the array anew")

    def _next_number(self, session: Session, slate: str) -> int:
        """The number of the next take, also when the folder of the last is still being made."""
        key = (session.folder, slate)
        self._numbers[key] = max(session.next_number(slate), self._numbers.get(key, 0) + 1)
        return self._numbers[key]

    def _fresh_stream(self) -> Stream:
        return Stream(self.array, self.settings, self.settings.pre_roll + _RING_SPARE)

    def _guarded(self, loop: Callable[[], None]) -> None:
        """Run a loop; when it fails, say why and end the stream, so that no take waits for ever."""
        try:
            while self._running.is_set():
                loop()
        except (LikenessError, OSError) as error:
            self.trouble = str(error)
        finally:
            if self._running.is_set():  # an error that nobody foresaw goes on from here
                self.trouble = self.trouble or f"the program is at fault: {sys.exception()!r}"
                self._running.clear()
                self._stream.stop()

    def _pump(self) -> None:
        self._stream.pump()
        time.sleep(min(max(self.settings.period_ns / 8e9, 0.0005), 0.005))

    def _fire(self) -> None:
        self._stream.fire()

    def _look_after(self) -> None:
        if self._watch is not None:
            self._watch.look()
        time.sleep(0.05)

    def _await_frames(self) -> None:
        deadline = time.monotonic() + _START_S
        silent: list[str] = []
        while time.monotonic() < deadline and self.running:
            silent = [name for name, count in self._stream.counts.items() if not count.received]
            if not silent and self._stream.ready:
                return
            time.sleep(0.01)
        raise DeviceError(
            self.trouble
            or f"no frame within {_START_S:g} s from {', '.join(silent)}; check that "
            f"{self.array.trigger} triggers reach every device and that no other program has it"
        )
