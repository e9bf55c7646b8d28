"""The driver's buffers: mapped into our memory, queued, and taken one by one."""

from __future__ import annotations

import ctypes
import errno
import mmap

import numpy as np

from capture.arrays import Image
from capture.devices.v4l2 import ioctls
from capture.devices.v4l2.node import Node, said
from capture.errors import DeviceError

_NOTHING_YET = (errno.EAGAIN, errno.EPIPE)


class DriverBuffers:
    """Buffers that a driver fills in turn, from `start` to `stop`."""

    def __init__(self, node: Node, wanted: int) -> None:
        """Ask for buffers and map them.

        Args:
            node: whose.
            wanted: how many; a driver may give more or fewer.

        Raises:
            DeviceError: when it refuses, or gives fewer than two.
        """
        self._node = node
        self._maps: list[mmap.mmap] = []
        self._bytes: list[Image] = []
        self._idle: list[int] = []
        self.requeue_failures = 0
        request = _request(wanted)
        self._ask("asked for memory", ioctls.REQBUFS, request)
        self.count = int(request.count)
        if self.count < 2:
            self.free()
            raise DeviceError(f"{node.path}: the driver gives {self.count} buffers, 2 are needed")
        try:
            for index in range(self.count):
                buffer = _buffer(index)
                self._ask("asked for a buffer", ioctls.QUERYBUF, buffer)
                self._maps.append(node.map(int(buffer.m.offset), int(buffer.length)))
                self._bytes.append(np.frombuffer(self._maps[-1], np.uint8))
        except (OSError, DeviceError) as error:
            self.free()
            why = said(error) if isinstance(error, OSError) else str(error)
            raise DeviceError(f"{node.path}: a buffer cannot be mapped: {why}") from error

    def start(self) -> None:
        """Queue all buffers and begin to stream.

        Raises:
            DeviceError: when the driver refuses; the buffers are given back then.
        """
        try:
            for index in range(self.count):
                self._ask("queueing a buffer", ioctls.QBUF, _buffer(index))
            self._ask("starting to stream", ioctls.STREAMON, ctypes.c_int(ioctls.BUF_TYPE_CAPTURE))
        except DeviceError:
            self.free()
            raise

    def take(self) -> tuple[ioctls.Buffer, Image] | None:
        """The next filled buffer and its used bytes; None when there is none yet.

        Raises:
            OSError: when the driver has failed, or the device is gone.
        """
        self._retry()
        buffer = _buffer(0)
        try:
            self._node.call(ioctls.DQBUF, buffer)
        except OSError as error:
            if error.errno in _NOTHING_YET:
                return None
            raise
        used = min(int(buffer.bytesused), self._bytes[buffer.index].size)
        return buffer, self._bytes[buffer.index][:used]

    def give(self, index: int) -> None:
        """Queue a buffer again; one that the driver refuses is tried again at the next `take`."""
        try:
            self._node.call(ioctls.QBUF, _buffer(index))
        except OSError:
            self.requeue_failures += 1
            self._idle.append(index)

    def free(self) -> None:
        """Stop streaming and give the memory back; a driver that is gone needs no more of us."""
        self._quietly(ioctls.STREAMOFF, ctypes.c_int(ioctls.BUF_TYPE_CAPTURE))
        self._bytes.clear()
        for each in self._maps:
            each.close()
        self._maps.clear()
        self._idle.clear()
        self._quietly(ioctls.REQBUFS, _request(0))

    def _retry(self) -> None:
        idle, self._idle = self._idle, []
        for index in idle:
            self.give(index)

    def _ask(
        self, doing: str, request: int, argument: ctypes.Structure | ctypes._SimpleCData[int]
    ) -> None:
        try:
            self._node.call(request, argument)
        except OSError as error:
            raise DeviceError(f"{self._node.path}: {doing}: {said(error)}") from error

    def _quietly(self, request: int, argument: ctypes.Structure | ctypes._SimpleCData[int]) -> None:
        try:
            self._node.call(request, argument)
        except OSError:
            return


def clock_flags(node: Node) -> int:
    """The flags of a node's buffers that tell which clock dates its frames.

    A buffer is asked for and given back, which also tells whether another program streams.

    Raises:
        DeviceError: when another program streams from it, or the driver refuses.
    """
    try:
        node.call(ioctls.REQBUFS, _request(2))
        try:
            buffer = _buffer(0)
            node.call(ioctls.QUERYBUF, buffer)
        finally:
            node.call(ioctls.REQBUFS, _request(0))
    except OSError as error:
        raise DeviceError(f"{node.path}: {said(error)}") from error
    return int(buffer.flags)


def busy(node: Node) -> bool:
    """Whether another program streams from a node."""
    try:
        node.call(ioctls.REQBUFS, _request(0))
    except OSError as error:
        return error.errno == errno.EBUSY
    return False


def _request(count: int) -> ioctls.RequestBuffers:
    return ioctls.RequestBuffers(
        count=count, type=ioctls.BUF_TYPE_CAPTURE, memory=ioctls.MEMORY_MMAP
    )


def _buffer(index: int) -> ioctls.Buffer:
    return ioctls.Buffer(index=index, type=ioctls.BUF_TYPE_CAPTURE, memory=ioctls.MEMORY_MMAP)
