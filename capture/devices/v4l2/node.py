"""A device node: where the kernel's video drivers are asked."""

from __future__ import annotations

import ctypes
import errno
import fcntl
import mmap
import os
from pathlib import Path
from typing import Protocol

from capture.devices.v4l2 import ioctls
from capture.errors import DeviceError

_WORDS = {
    errno.ENOENT: "there is no such node",
    errno.ENODEV: "the device is gone",
    errno.ENXIO: "there is no device behind this node",
    errno.EIO: "the driver reports a fatal error",
    errno.EBUSY: "it is in use by another program",
    errno.ENOTTY: "the driver does not know the request",
    errno.EACCES: "no permission; the user must be in the group video",
    errno.EPERM: "no permission",
    errno.ENOMEM: "there is not enough memory",
    errno.ENOSPC: "the bus has no bandwidth left for it; choose a smaller image or a lower rate",
}


def said(error: OSError) -> str:
    """An error of the kernel's, in words."""
    return _WORDS.get(error.errno or 0, f"the driver said: {error.strerror or error}")


class Node(Protocol):
    """An open node. `call` and `map` raise `OSError` as the kernel does."""

    @property
    def path(self) -> str:
        """Of the node."""

    def call(self, request: int, argument: ctypes.Structure | ctypes._SimpleCData[int]) -> None:
        """Make a request; the driver reads and fills the argument."""

    def map(self, offset: int, length: int) -> mmap.mmap:
        """Map a buffer of the driver's."""

    def close(self) -> None:
        """Close it; a closed node may be closed again."""


class KernelNode:
    """A node of the running kernel, opened without blocking."""

    def __init__(self, path: str) -> None:
        self.path = path
        self._fd = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)

    def call(self, request: int, argument: ctypes.Structure | ctypes._SimpleCData[int]) -> None:
        """Make a request; the driver reads and fills the argument."""
        if self._fd < 0:
            raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))
        fcntl.ioctl(self._fd, request, argument, True)

    def map(self, offset: int, length: int) -> mmap.mmap:
        """Map a buffer of the driver's."""
        return mmap.mmap(
            self._fd, length, mmap.MAP_SHARED, mmap.PROT_READ | mmap.PROT_WRITE, offset=offset
        )

    def close(self) -> None:
        """Close it; a closed node may be closed again."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)


def open_node(path: str) -> tuple[KernelNode, ioctls.Capability]:
    """Open a node that images can be captured from.

    Raises:
        DeviceError: when there is none at that path, or it is of another kind.
    """
    if not Path(path).is_char_device():
        what = "this is not a device" if Path(path).exists() else "there is no such node"
        raise DeviceError(f"{path}: {what}; `likeness devices` lists what is there")
    try:
        node = KernelNode(path)
    except OSError as error:
        raise DeviceError(f"{path}: {said(error)}") from error
    capability = ioctls.Capability()
    try:
        node.call(ioctls.QUERYCAP, capability)
    except OSError as error:
        node.close()
        raise DeviceError(f"{path}: not a video device ({said(error)})") from error
    problem = capture_problem(capability)
    if problem:
        node.close()
        raise DeviceError(f"{path}: {problem}")
    return node, capability


def node_caps(capability: ioctls.Capability) -> int:
    """What this node can do; `capabilities` alone tells of all nodes of the device together."""
    if capability.capabilities & ioctls.CAP_DEVICE_CAPS:
        return int(capability.device_caps)
    return int(capability.capabilities)


def capture_problem(capability: ioctls.Capability) -> str:
    """Why images cannot be captured from a node; empty when they can."""
    caps = node_caps(capability)
    if not caps & ioctls.CAP_CAPTURE:
        if caps & ioctls.CAP_CAPTURE_MPLANE:
            return "its driver offers only the multi-planar interface, which is not supported"
        return "not a capture node: it takes or tells something other than images"
    if not caps & ioctls.CAP_STREAMING:
        return "its driver cannot stream into mapped memory"
    return ""
