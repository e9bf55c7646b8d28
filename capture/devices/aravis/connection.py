"""An open device of Aravis: how it is opened, what it is, what its transport is set to."""

from __future__ import annotations

import ipaddress
import time
from typing import Any

from capture.devices.aravis import finding
from capture.devices.aravis.features import Features
from capture.devices.aravis.formats import check_format, is_known, layout_of
from capture.devices.aravis.handle import Handle
from capture.devices.aravis.library import aravis, translated
from capture.devices.aravis.network import (
    ORDINARY_PACKET,
    interface_of,
    packet_pause_ns,
)
from capture.devices.aravis.triggers import Triggers
from capture.devices.protocol import DeviceInfo
from capture.errors import DeviceError

_SERIAL_AT, _SERIAL_END = 0x00D8, 0x00E8  # in the memory that every GigE Vision device has
_TEST_PACKET = "GevSCPSFireTestPacket"
_LONG_IDS = "GevGVSPExtendedIDMode"
_FREED_S = 3.5  # a device frees itself 3 s after a program that held it has died


class Connection:
    """An open device. All calls belong on the device's own control thread."""

    def __init__(self, name: str, asked: str, serial: str = "") -> None:
        """Open a device.

        Args:
            name: that it has in the array.
            asked: its IP address, serial number or device id.
            serial: that it must have; empty: any.

        Raises:
            DeviceError: when it is not there, is in use, or is another one.
        """
        self.name = name
        self._handle = Handle(name, None)
        self.address, device_id = _locate(name, asked)
        finding.remember(self.address, self)
        try:
            self._handle = Handle(name, _open(name, asked, device_id))
            self._enter(serial)
        except DeviceError:
            self.drop()
            raise

    def _enter(self, serial: str) -> None:
        self.features = Features(self._handle)
        self.triggers = Triggers(self._handle, self.features)
        self._written: set[str] = set()
        self._packet_bytes = 0
        self.gige = bool(self.camera.is_gv_device())
        if self.gige:
            # Aravis opens its packet socket before it sets the filter. When a stream starts while
            # other devices send, it takes in frames of theirs and calls them complete: measured, 45
            # frames in 103 starts beside one other device. An ordinary socket is bound to one port.
            self.camera.gv_set_stream_options(aravis().GvStreamOption.PACKET_SOCKET_DISABLED)
        self.serial = self._read_serial()
        if serial and self.serial != serial:
            raise DeviceError(
                f"{self.name}: at {self.address} there is the device {self.serial}, "
                f"expected {serial}"
            )
        self.link_mbps = finding.link_mbps(self.address) if self.gige else None
        self._notes = self._make_fit()

    @property
    def camera(self) -> Any:
        """The device, as what Aravis calls a camera."""
        return self._handle.camera

    @property
    def problems(self) -> tuple[str, ...]:
        """What may lose frames, in words; host and packets are the preflight's."""
        return (*self._notes, *self.triggers.problems)

    def describe(self, name: str) -> DeviceInfo:
        """What the device is, as it is set now."""
        features = self.features
        with translated(self.name, "its make"):
            model = f"{self.camera.get_vendor_name()} {self.camera.get_model_name()}"
        pixel_format = str(features.read("PixelFormat"))
        check_format(name, pixel_format, features.entries("PixelFormat"))
        width, height = int(features.read("Width")), int(features.read("Height"))
        long_ids = features.has(_LONG_IDS) and features.read(_LONG_IDS) == "On"
        return DeviceInfo(
            name=name,
            serial=self.serial,
            model=model,
            layout=layout_of(pixel_format, width, height),
            id_bits=64 if long_ids or not self.gige else 16,
            triggers=self.triggers.kinds(),
            first_id=1 if self.gige else 0,
            transport="gige" if self.gige else "usb3",
            address=self.address,
            link_mbps=self.link_mbps,
        )

    def wrote(self, feature: str) -> None:
        """Remember that a setting was written on purpose, so that it is not negotiated."""
        self._written.add(feature)

    def payload_bytes(self) -> int:
        """What the device sends for each frame."""
        with translated(self.name, "its payload"):
            return int(self.camera.get_payload())

    def negotiate(self) -> int:
        """Agree on the longest packets that get through, and read back what the device took.

        Returns:
            Bytes of a packet; 0 when the transport has none.
        """
        if not self.gige:
            return 0
        camera = self.camera
        with translated(self.name, "a packet size"):
            if not self._written & {"GevSCPSPacketSize", "ArvGevSCPSPacketSize"}:
                if self.features.has(_TEST_PACKET):
                    camera.gv_auto_packet_size()
                elif self._mtu() > ORDINARY_PACKET:
                    # It sends no packets to try with: take what the host can, and read it back.
                    camera.gv_set_packet_size(self._mtu())
            self._packet_bytes = int(camera.gv_get_packet_size())
        return self._packet_bytes

    def ticks_per_s(self) -> int:
        """How many ticks a second the device's clock counts."""
        with translated(self.name, "the rate of its clock"):
            return int(self._handle.device.get_timestamp_tick_frequency()) or 10**9

    def pace(self, share: float, period_ns: int) -> int:
        """Spread the packets of a frame over a share of the period; the pause it took, ns."""
        if not self.gige or not self.features.has("GevSCPD") or self.link_mbps is None:
            raise DeviceError(f"{self.name}: it has no pause between packets, or no known link")
        packet_bytes = self._packet_bytes or self.negotiate()
        spread_ns = round(share * period_ns)
        asked = packet_pause_ns(self.payload_bytes(), packet_bytes, spread_ns, self.link_mbps)
        most_ticks = self.features.bounds("GevSCPD")[1]
        asked = min(asked, int(most_ticks) * 10**9 // self.ticks_per_s())
        with translated(self.name, f"a pause of {asked} ns between packets"):
            self.camera.gv_set_packet_delay(asked)
            return int(self.camera.gv_get_packet_delay())

    def figures(self) -> dict[str, int]:
        """Figures of the transport for the log."""
        return {"packet_bytes": self._packet_bytes} if self.gige else {}

    def command(self, name: str) -> None:
        """Run a command."""
        self.features.run(name)

    def knock(self) -> None:
        """Ask something that every device answers.

        Raises:
            DeviceError: when this one does not.
        """
        with translated(self.name):
            if self.gige and not self._handle.device.is_controller():
                raise DeviceError(f"{self.name}: another program has taken it, or it was restarted")
            self.camera.get_payload()
            if self.gige:
                self._handle.device.read_register(0)

    def again(self) -> Connection:
        """Open the same device anew, wherever it is now.

        Raises:
            DeviceError: when it is not there.
        """
        try:
            return Connection(self.name, self.address, self.serial)
        except DeviceError:
            there = finding.seek(self.serial)
            if there is None or there.address == self.address:
                raise
            return Connection(self.name, there.address, self.serial)

    def drop(self) -> None:
        """Let the device go; one that is gone takes seconds. May be called again."""
        self.forget()
        self._handle.drop()

    def forget(self) -> None:
        """Let the address be opened anew."""
        finding.forget(self.address, self)

    def _read_serial(self) -> str:
        with translated(self.name, "its serial number"):
            if not self.gige:
                return str(self.camera.get_device_serial_number())
            device = self._handle.device
            words = [device.read_register(at) for at in range(_SERIAL_AT, _SERIAL_END, 4)]
        raw = b"".join(int(word).to_bytes(4, "big") for word in words)
        return raw.split(b"\0")[0].decode("ascii", "replace")

    def _make_fit(self) -> tuple[str, ...]:
        """Bring the device into a state that can be recorded; what was changed, in words."""
        features = self.features
        if "On" in features.entries(_LONG_IDS):
            features.write(_LONG_IDS, "On")
        found, offered = str(features.read("PixelFormat")), features.entries("PixelFormat")
        fit = [one for one in offered if is_known(one)]
        if is_known(found) or not fit:
            return ()
        features.write("PixelFormat", fit[0])
        return (f"it was set to {found}, which cannot be recorded; it is now set to {fit[0]}",)

    def _mtu(self) -> int:
        there = interface_of(self.address)
        return ORDINARY_PACKET if there is None else there.mtu


def _locate(name: str, asked: str) -> tuple[str, str]:
    """The address of a device, and by what Aravis opens it; an IP address needs no search."""
    if _is_ip(asked):
        return asked, asked
    found = finding.seek(asked)
    if found is None:
        known = ", ".join(f"{one.serial} ({one.address})" for one in finding.listed(anew=False))
        raise DeviceError(f"{name}: no device {asked!r} answers; found {known or 'none'}")
    return found.address, found.address if found.gige else found.device_id


def _open(name: str, asked: str, device_id: str) -> Any:
    library = aravis()
    # Asked first: some devices do not answer when they are held, and Aravis tries for seconds. Not
    # asked often: a fake camera takes any such question as a sign of life of whoever holds it.
    held = _is_ip(device_id) and finding.held(device_id)
    if held:
        time.sleep(_FREED_S)
        held = finding.held(device_id)
    if not held:
        with translated(name, f"opening {asked}"):
            camera = library.Camera.new(device_id)
        device = camera.get_device()
        if not isinstance(device, library.GvDevice) or device.is_controller():
            return camera
    raise DeviceError(f"{name}: {asked} is in use by another program; close that program")


def _is_ip(text: str) -> bool:
    try:
        ipaddress.IPv4Address(text)
    except ValueError:
        return False
    return True
