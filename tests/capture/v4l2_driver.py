"""A video driver that is played: it answers the kernel's requests as a real one would.

What a driver in a guest can show is shown there (tests/v4l2); this one has what vivid has not:
compressed images, exposure controls, clocks of its own, padded rows, short images.
"""

from __future__ import annotations

import ctypes
import errno
import mmap
import os
from collections import deque
from dataclasses import dataclass, field

from capture.devices.protocol import TriggerKind, TriggerSpec
from capture.devices.v4l2 import ioctls
from capture.devices.v4l2.device import V4l2Device, device_on
from capture.devices.v4l2.discovery import NodeIdentity

AUTO, ABSOLUTE, PRIORITY = 0x009A0901, 0x009A0902, 0x009A0903
PERIOD_NS = 40_000_000


def fourcc(name: str) -> int:
    return int.from_bytes(name.ljust(4).encode("ascii"), "little")


@dataclass
class PlayedControl:
    """One control of the driver's."""

    id: int
    type: int
    name: str
    minimum: int
    maximum: int
    value: int
    flags: int = 0
    menu: dict[int, str] = field(default_factory=dict)


def exposure_controls() -> list[PlayedControl]:
    return [
        PlayedControl(AUTO, ioctls.TYPE_MENU, "Auto Exposure", 0, 3, 3,
                      menu={1: "Manual Mode", 3: "Aperture Priority Mode"}),
        PlayedControl(ABSOLUTE, ioctls.TYPE_INTEGER, "Exposure Time, Absolute", 3, 2047, 250,
                      ioctls.CTRL_INACTIVE),
        PlayedControl(PRIORITY, ioctls.TYPE_BOOLEAN, "Exposure, Dynamic Framerate", 0, 1, 1),
    ]  # fmt: skip


class PlayedDriver:
    """A node that behaves as it is told to."""

    def __init__(
        self,
        pixel_format: str = "GREY",
        width: int = 16,
        height: int = 8,
        stride: int = 0,
        formats: tuple[int, ...] = (),
    ) -> None:
        self.path = "/dev/video7"
        self.format = fourcc(pixel_format)
        self.formats = formats or (self.format,)
        self.width, self.height, self.stride = width, height, stride
        self.image_bytes = max(stride, 2 * width) * height * 2 + 4096
        self.timestamp_flags = ioctls.FLAG_TIMESTAMP_MONOTONIC
        self.controls: list[PlayedControl] = []
        self.interval = (1, 25)
        self.rates: tuple[tuple[int, int], ...] = ((1, 25), (1, 30))
        self.broken = 0  # an errno that every request gets
        self.queued: deque[int] = deque()
        self.filled: deque[ioctls.Buffer] = deque()
        self.maps: list[mmap.mmap] = []
        self.streaming = False

    def deliver(
        self, data: bytes, sequence: int, flags: int = 0, seconds: int = 1, microseconds: int = 0
    ) -> bool:
        """Fill the next buffer that is queued; False when there is none."""
        if not self.queued or not self.streaming:
            return False
        index = self.queued.popleft()
        self.maps[index][: len(data)] = data
        self.filled.append(ioctls.Buffer(
            index=index, bytesused=len(data), sequence=sequence, flags=flags | self.timestamp_flags,
            seconds=seconds, microseconds=microseconds,
        ))  # fmt: skip
        return True

    def map(self, offset: int, length: int) -> mmap.mmap:
        memory = mmap.mmap(-1, length)
        self.maps.append(memory)
        return memory

    def close(self) -> None:
        self.broken = errno.ENODEV

    def call(self, request: int, argument: ctypes.Structure | ctypes._SimpleCData[int]) -> None:
        if self.broken:
            raise OSError(self.broken, os.strerror(self.broken))
        answer = {
            ioctls.QUERYCAP: self._nothing, ioctls.ENUM_FMT: self._enum_format,
            ioctls.G_FMT: self._get_format, ioctls.S_FMT: self._set_format,
            ioctls.TRY_FMT: self._try_format, ioctls.REQBUFS: self._request_buffers,
            ioctls.QUERYBUF: self._query_buffer,
            ioctls.QBUF: self._queue, ioctls.DQBUF: self._dequeue,
            ioctls.STREAMON: self._on, ioctls.STREAMOFF: self._off,
            ioctls.G_PARM: self._get_interval, ioctls.S_PARM: self._set_interval,
            ioctls.ENUM_FRAMEINTERVALS: self._enum_interval,
            ioctls.QUERY_EXT_CTRL: self._query_control, ioctls.QUERYMENU: self._query_menu,
            ioctls.G_EXT_CTRLS: self._get_control, ioctls.S_EXT_CTRLS: self._set_control,
        }[request]  # fmt: skip
        answer(argument)

    def control(self, number: int) -> PlayedControl:
        for control in self.controls:
            if control.id == number:
                return control
        raise OSError(errno.EINVAL, "no such control")

    def _nothing(self, argument: ctypes.Structure) -> None:
        pass

    def _enum_format(self, argument: ioctls.FormatDescription) -> None:
        if argument.index >= len(self.formats):
            raise OSError(errno.EINVAL, "no more")
        argument.pixelformat = self.formats[argument.index]

    def _get_format(self, argument: ioctls.Format) -> None:
        pix = argument.fmt.pix
        pix.width, pix.height, pix.pixelformat = self.width, self.height, self.format
        pix.bytesperline = self.stride

    def _try_format(self, argument: ioctls.Format) -> None:
        argument.fmt.pix.width = min(argument.fmt.pix.width, 640)

    def _set_format(self, argument: ioctls.Format) -> None:
        if self.streaming:
            raise OSError(errno.EBUSY, "busy")
        self.format = argument.fmt.pix.pixelformat
        self.width, self.height = argument.fmt.pix.width, argument.fmt.pix.height
        self._get_format(argument)

    def _request_buffers(self, argument: ioctls.RequestBuffers) -> None:
        self.queued.clear()
        self.filled.clear()
        self.maps.clear()

    def _query_buffer(self, argument: ioctls.Buffer) -> None:
        argument.flags, argument.length = self.timestamp_flags, self.image_bytes

    def _queue(self, argument: ioctls.Buffer) -> None:
        self.queued.append(int(argument.index))

    def _dequeue(self, argument: ioctls.Buffer) -> None:
        if not self.filled:
            raise OSError(errno.EAGAIN, "nothing yet")
        filled = self.filled.popleft()
        ctypes.memmove(ctypes.byref(argument), ctypes.byref(filled), ctypes.sizeof(filled))

    def _on(self, argument: object) -> None:
        self.streaming = True

    def _off(self, argument: object) -> None:
        self.streaming = False

    def _get_interval(self, argument: ioctls.StreamParm) -> None:
        argument.timeperframe.numerator, argument.timeperframe.denominator = self.interval

    def _set_interval(self, argument: ioctls.StreamParm) -> None:
        asked = argument.timeperframe.numerator / argument.timeperframe.denominator
        self.interval = min(self.rates, key=lambda rate: abs(rate[0] / rate[1] - asked))
        self._get_interval(argument)

    def _enum_interval(self, argument: ioctls.FrameInterval) -> None:
        if argument.index >= len(self.rates):
            raise OSError(errno.EINVAL, "no more")
        argument.type = 1
        argument.shortest.numerator, argument.shortest.denominator = self.rates[argument.index]

    def _query_control(self, argument: ioctls.ControlQuery) -> None:
        number = argument.id & ~(ioctls.NEXT_CTRL | ioctls.NEXT_COMPOUND)
        if argument.id == number:
            found = self.control(number)
        else:
            later = [control for control in self.controls if control.id > number]
            if not later:
                raise OSError(errno.EINVAL, "no more")
            found = later[0]
        argument.id, argument.type, argument.name = found.id, found.type, found.name.encode()
        argument.minimum, argument.maximum, argument.step = found.minimum, found.maximum, 1
        argument.flags = found.flags

    def _query_menu(self, argument: ioctls.MenuQuery) -> None:
        menu = self.control(argument.id).menu
        if argument.index not in menu:
            raise OSError(errno.EINVAL, "no such entry")
        argument.u.name = menu[argument.index].encode()

    def _get_control(self, argument: ioctls.Controls) -> None:
        argument.controls[0].u.value = self.control(argument.controls[0].id).value

    def _set_control(self, argument: ioctls.Controls) -> None:
        control = self.control(argument.controls[0].id)
        control.value = argument.controls[0].u.value
        if control.id == AUTO:  # as UVC devices do: manual exposure makes the time effective
            self.control(ABSOLUTE).flags = 0 if control.value == 1 else ioctls.CTRL_INACTIVE


IDENTITY = NodeIdentity("SN7", "played", "usb-0000:00:14.0-2", 480.0)
SPEC = TriggerSpec(kind=TriggerKind.FREE_RUN, period_ns=PERIOD_NS, exposure_us=5000.0)


def device_of(driver: PlayedDriver) -> V4l2Device:
    """A device behind that driver."""
    return device_on(driver, "cam7", IDENTITY)


def started(driver: PlayedDriver, slots: int = 8) -> V4l2Device:
    """The same, streaming."""
    device = device_of(driver)
    device.frames.reserve(slots)
    device.trigger.prepare(SPEC)
    device.acquire.start()
    return device
