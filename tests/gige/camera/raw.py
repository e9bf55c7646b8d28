"""Aravis itself, without our backend: to prove the device before the backend is proved with it."""

from __future__ import annotations

import time
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray


def require_aravis() -> Any:
    """The Aravis library; the test is skipped, visibly, where it is not installed."""
    gi = pytest.importorskip("gi", reason="PyGObject is not installed: see tools/setup_gige.sh")
    try:
        gi.require_version("Aravis", "0.8")
    except ValueError as error:
        pytest.skip(f"Aravis is not installed: {error}; see tools/setup_gige.sh")
    from gi.repository import Aravis

    return Aravis


@dataclass(frozen=True, eq=False)
class RawFrame:
    """One buffer of Aravis.

    Attributes:
        status: as Aravis names it: "success", "timeout", "missing-packets", ...
        frame_id: number on the wire.
        t_dev_ns: its time.
        data: bytes, as received; none of a frame that is not good.
        buffer: of Aravis.
    """

    status: str
    frame_id: int
    t_dev_ns: int
    data: NDArray[np.uint8]
    buffer: Any

    @property
    def good(self) -> bool:
        """Whether Aravis believes it."""
        return self.status == "success"

    def image(self, width: int = 128, height: int = 96, bits: int = 8) -> NDArray[Any]:
        """Its pixels."""
        kind = np.dtype(np.uint8 if bits == 8 else "<u2")
        return self.data[: width * height * kind.itemsize].view(kind).reshape(height, width)


class RawAravis:
    """A device opened by address, streaming; used in a `with` block."""

    def __init__(self, address: str, buffers: int = 20) -> None:
        aravis = require_aravis()
        from gi.repository import Gio

        self.device = aravis.GvDevice.new(
            Gio.InetAddress.new_from_string("127.0.0.1"), Gio.InetAddress.new_from_string(address)
        )
        self.aravis = aravis
        self.camera = aravis.Camera.new_with_device(self.device)
        self.stream: Any = None
        self._count = buffers

    def __enter__(self) -> RawAravis:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        # Stopping the thread of the stream first makes Aravis complain when it frees the stream.
        del self.stream, self.camera, self.device

    def write(self, **values: bool | int | float | str) -> None:
        """Set features, in order."""
        for name, value in values.items():
            if isinstance(value, bool):
                self.device.set_boolean_feature_value(name, value)
            elif isinstance(value, str):
                self.device.set_string_feature_value(name, value)
            elif isinstance(value, float):
                self.device.set_float_feature_value(name, value)
            else:
                self.device.set_integer_feature_value(name, value)

    def read(self, name: str) -> Any:
        """An integer, or a float where it is one."""
        node = self.device.get_feature(name)
        if isinstance(node, self.aravis.GcEnumeration):
            return self.device.get_string_feature_value(name)
        if isinstance(node, self.aravis.GcFloat) and not isinstance(node, self.aravis.GcInteger):
            return self.device.get_float_feature_value(name)
        return self.device.get_integer_feature_value(name)

    def run(self, name: str) -> None:
        """Execute a command."""
        self.device.execute_command(name)

    def start(self, retention_ms: int = 60) -> None:
        """Begin to acquire."""
        # The packet socket would take in packets of other devices: see capture.devices.aravis.
        self.camera.gv_set_stream_options(self.aravis.GvStreamOption.PACKET_SOCKET_DISABLED)
        self.stream = self.camera.create_stream(None, None)
        self.stream.set_property("frame-retention", 1000 * retention_ms)
        # Aravis asks for packets after 20 ms of silence, often when it is about to give a frame up.
        self.stream.set_property("packet-timeout", 1000 * retention_ms // 12)
        size = self.camera.get_payload()
        for _ in range(self._count):
            self.stream.push_buffer(self.aravis.Buffer.new_allocate(size))
        self.camera.start_acquisition()

    def frames(self, count: int, patience_s: float = 5.0) -> list[RawFrame]:
        """The next frames; fewer when they do not come."""
        got: list[RawFrame] = []
        end = time.monotonic() + patience_s
        while len(got) < count and time.monotonic() < end:
            buffer = self.stream.timeout_pop_buffer(100_000)
            if buffer is None:
                continue
            data = np.frombuffer(buffer.get_data(), np.uint8).copy()
            got.append(
                RawFrame(
                    buffer.get_status().value_nick,
                    buffer.get_frame_id(),
                    buffer.get_timestamp(),
                    data,
                    buffer,
                )
            )
            self.stream.push_buffer(self.aravis.Buffer.new_allocate(self.camera.get_payload()))
        return got
