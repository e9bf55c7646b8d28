"""Frames of a device, written by Aravis's own thread straight into memory that we set aside."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from capture.arrays import Image
from capture.devices.aravis.chunks import ExposureChunk
from capture.devices.aravis.library import aravis, translated
from capture.devices.aravis.network import ENOUGH_RECEIVE_BYTES
from capture.devices.slots import SlotPool
from capture.errors import DeviceError
from capture.frame import FrameEvent
from capture.frame_header import ImageLayout

_LATE_NS = 10 * 10**9  # a stamp this old is of another time: the wall clock was set
_RESEND_COUNTERS = ("n_resend_requests", "n_resent_packets", "n_duplicated_packets")
_NONE_RESENT = [0] * len(_RESEND_COUNTERS)
_SHORTEST_RETENTION_US, _LONGEST_RETENTION_US = 30_000, 100_000


@dataclass(frozen=True, kw_only=True)
class StreamPlan:
    """What a stream is made for.

    Attributes:
        layout: of the images.
        payload_bytes: what the device sends for each frame: the image, and chunks after it.
        packet_bytes: of a packet; 0 when the transport has none.
        period_ns: from trigger to trigger.
        exposure_us: of each frame; -1 unknown.
        exposure_sent: whether each frame says itself how long it was exposed.
    """

    layout: ImageLayout
    payload_bytes: int
    packet_bytes: int
    period_ns: int
    exposure_us: float
    exposure_sent: bool = False

    @property
    def retention_us(self) -> int:
        """How long Aravis waits for missing packets: three periods, within reason."""
        return min(max(3 * self.period_ns // 1000, _SHORTEST_RETENTION_US), _LONGEST_RETENTION_US)


@dataclass(eq=False)
class _Memory:
    """The slots, and the buffer of Aravis that stands for each."""

    pool: SlotPool
    buffers: list[Any]
    slot_of: dict[Any, int]
    out: set[int] = field(default_factory=set)  # with whoever polled them


class FrameStream:
    """The frames of one device, across as many streams of Aravis as it takes.

    `poll` belongs to one thread; `pixels` and `release` may be called from any; the rest belongs on
    the device's control thread.
    """

    def __init__(self, name: str) -> None:
        """Begin without memory.

        Args:
            name: of the device.
        """
        self._name = name
        self._lock = threading.Lock()
        self._memory: _Memory | None = None
        self._stream: Any = None
        self._plan: StreamPlan | None = None
        self._resent = [_NONE_RESENT] * 2  # the counters at the last two polls that gave frames
        self._success: Any = None
        self._aborted: Any = None
        self._image_kinds: tuple[Any, ...] = ()
        self._exposure: ExposureChunk | None = None

    def __del__(self) -> None:
        # Aravis's thread must be gone before the memory that it writes to.
        self.end()

    @property
    def free(self) -> int:
        """Frames of memory that nobody holds; -1 before there is memory."""
        memory = self._memory
        return -1 if memory is None else memory.pool.count - len(memory.out)

    @property
    def plan(self) -> StreamPlan | None:
        """What the present stream is made for; None without one."""
        return self._plan

    def exposed_for(self, exposure_us: float) -> None:
        """Say how long frames are exposed from now on."""
        with self._lock:
            if self._plan is not None:
                self._plan = replace(self._plan, exposure_us=exposure_us)

    def reserve(self, frames: int, layout: ImageLayout, payload_bytes: int) -> None:
        """Set memory aside.

        Raises:
            DeviceError: when there is not so much, or frames of the last memory are still held.
        """
        with self._lock:
            old = self._memory
            if old is not None and old.out:
                raise DeviceError(
                    f"{self._name}: {len(old.out)} frames are not released; release them before "
                    f"other memory is set aside"
                )
            if self._stream is not None:
                raise DeviceError(f"{self._name}: memory is set aside before `start`")
            pool = SlotPool(frames, layout, payload_bytes)
            # `received` of a buffer is at most its size: a payload that is longer must not fit in.
            buffers = [
                aravis().Buffer.new(payload_bytes, pool.address(slot)) for slot in range(frames)
            ]
            self._memory = _Memory(
                pool, buffers, {buffer: slot for slot, buffer in enumerate(buffers)}
            )

    def fits(self, layout: ImageLayout, payload_bytes: int) -> bool:
        """Whether there is memory for such frames."""
        memory = self._memory
        return (
            memory is not None
            and memory.pool.layout == layout
            and memory.pool.payload_bytes == payload_bytes
        )

    @property
    def reserved(self) -> int:
        """How many frames there is memory for; 0 before there is any."""
        return 0 if self._memory is None else self._memory.pool.count

    def begin(self, camera: Any, plan: StreamPlan) -> None:
        """Be ready for frames: a fresh receiving thread, and every free slot given to it.

        Raises:
            DeviceError: when the stream cannot be made.
        """
        if self._stream is not None and self._plan == plan:
            # The thread remembers the last frame number, and drops lower ones as late: devices
            # that begin again at 1 with every start need a thread that remembers nothing.
            self._stream.stop_thread(False)
            self._stream.start_thread()
            return
        self.end()
        library = aravis()
        with translated(self._name, "a stream"):
            stream = camera.create_stream(None, None)
        if isinstance(stream, library.GvStream):
            stream.set_property("packet-resend", library.GvStreamPacketResend.ALWAYS)
            stream.set_property("frame-retention", plan.retention_us)
            # Aravis asks after 20 ms of silence, when a frame at 75 Hz is about to be given up.
            stream.set_property("packet-timeout", plan.retention_us // 8)
            # Room for several frames, as far as the host allows: the preflight looks at that.
            stream.set_property("socket-buffer", library.GvStreamSocketBuffer.FIXED)
            stream.set_property("socket-buffer-size", ENOUGH_RECEIVE_BYTES)
        device = camera.get_device()
        self._exposure = ExposureChunk(self._name, device) if plan.exposure_sent else None
        kinds, status = library.BufferPayloadType, library.BufferStatus
        self._success, self._aborted = status.SUCCESS, status.ABORTED
        self._image_kinds = (kinds.IMAGE, kinds.EXTENDED_CHUNK_DATA)
        with self._lock:
            memory = self._memory
            if memory is None:
                raise DeviceError(f"{self._name}: started before memory was set aside")
            self._plan, self._resent = plan, [_NONE_RESENT] * 2
            for slot, buffer in enumerate(memory.buffers):
                if slot not in memory.out:
                    _push(stream, buffer)
            self._stream = stream

    def end(self) -> object:
        """Take all memory back from Aravis, at once.

        Returns:
            What is left of the stream. Who drops it waits for seconds when the device is gone.
        """
        with self._lock:
            stream, self._stream, self._plan = self._stream, None, None
        if stream is not None:
            stream.stop_thread(True)
            # Aravis complains of a stream that is dropped while its thread is stopped. Without
            # buffers the thread has nowhere to write.
            stream.start_thread()
        return stream

    def poll(self) -> Sequence[FrameEvent]:
        """The frames that have arrived since the last call."""
        events: list[FrameEvent] = []
        with self._lock:
            stream, memory, plan = self._stream, self._memory, self._plan
            if stream is None or memory is None or plan is None:
                return events
            wall_ahead_ns = time.time_ns() - time.monotonic_ns()
            while (buffer := stream.try_pop_buffer()) is not None:
                event = self._event(buffer, memory, plan, wall_ahead_ns)
                if event is None:
                    _push(stream, buffer)
                else:
                    memory.out.add(event.slot)
                    events.append(event)
            return self._marked(events, stream) if events else events

    def pixels(self, event: FrameEvent) -> Image:
        """The image of a frame that has not been released, as a view."""
        memory = self._memory
        if memory is None or event.slot not in memory.out:
            raise DeviceError(f"{self._name}: frame {event.frame_id} has been released")
        return memory.pool.image(event.slot)

    def release(self, event: FrameEvent) -> None:
        """Give a slot back; to Aravis while there is a stream."""
        with self._lock:
            memory = self._memory
            if memory is None or event.slot not in memory.out:
                raise DeviceError(f"{self._name}: frame {event.frame_id} was released twice")
            memory.out.remove(event.slot)
            if self._stream is not None:
                _push(self._stream, memory.buffers[event.slot])

    def counters(self) -> dict[str, int]:
        """Aravis's own counters, for the log: several of them do not count what they say."""
        with self._lock:
            stream = self._stream
            if stream is None:
                return {}
            names = [stream.get_info_name(place) for place in range(stream.get_n_infos())]
            return {name: int(stream.get_info_uint64_by_name(name)) for name in names}

    def _event(
        self, buffer: Any, memory: _Memory, plan: StreamPlan, wall_ahead_ns: int
    ) -> FrameEvent | None:
        status = buffer.get_status()
        number = int(buffer.get_frame_id())
        # Number 0 was put in by us: the packet that opens a frame did not come, nothing is known.
        if number == 0 or status == self._aborted:
            return None
        note = ""
        if status != self._success:
            note = f"incomplete: {status.value_nick.replace('-', ' ')}"
        elif buffer.get_payload_type() in self._image_kinds:
            note = _misfit(buffer, plan)
        now_ns = time.monotonic_ns()
        stamp_ns = int(buffer.get_system_timestamp())
        t_host_ns = stamp_ns - wall_ahead_ns
        if not now_ns - _LATE_NS <= t_host_ns <= now_ns:
            t_host_ns = now_ns
        # Aravis stamps a frame of a device without a clock with the wall clock.
        t_dev_ns = int(buffer.get_timestamp())
        exposure_us = plan.exposure_us
        if self._exposure is not None and not note:
            exposure_us = self._exposure.exposure_us(buffer, exposure_us)
        return FrameEvent(
            self._name, number, t_dev_ns, t_host_ns, memory.slot_of[buffer], exposure_us,
            not note, note,
        )  # fmt: skip

    def _marked(self, events: list[FrameEvent], stream: Any) -> list[FrameEvent]:
        """Note frames of an interval in which packets were sent again: some devices mislabel them,
        so that even a frame that came whole may be wrong (aravis issue 311)."""
        if not isinstance(stream, aravis().GvStream):
            return events
        counts = [int(stream.get_info_uint64_by_name(name)) for name in _RESEND_COUNTERS]
        since, self._resent = self._resent[0], [self._resent[1], counts]
        if counts == since:
            return events
        # A packet that comes under the number of another frame counts as a duplicate.
        came = counts[1:] != since[1:]
        mark = "packets resent" if came else "packets asked for again"
        return [
            FrameEvent(
                event.device, event.frame_id, event.t_dev_ns, event.t_host_ns, event.slot,
                event.exposure_us, event.complete,
                f"{event.note}; {mark}" if event.note else mark,
            )
            for event in events
        ]  # fmt: skip


def _push(stream: Any, buffer: Any) -> None:
    # Aravis leaves the number and stamp of the last frame in a buffer whose opening packet is lost.
    buffer.set_frame_id(0)
    buffer.set_system_timestamp(0)
    stream.push_buffer(buffer)


def _misfit(buffer: Any, plan: StreamPlan) -> str:
    """What differs between an image that came and the images that were expected; empty: nothing."""
    region = buffer.get_image_region()
    if (region.width, region.height) != (plan.layout.width, plan.layout.height):
        return f"incomplete: an image of {region.width} x {region.height} px came"
    return ""
