"""The named settings of a device, as a table: XML and rules of registers follow from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from tests.gige.camera.clock import PTP_STATES
from tests.gige.camera.pixels import FORMATS
from tests.gige.camera.setup import Setup
from tests.gige.camera.wire import Reg

SETTINGS_START = 0x10000  # of the registers that are not in the standard, 16 bytes each
CHUNK_SWITCHES = 0x18000  # one word a kind of chunk
CHUNKS = {"Image": 0, "Timestamp": 1, "ExposureTime": 2, "FrameID": 3, "LineStatusAll": 4}
CHUNK_IDS = {name: 0xA0000000 + number for name, number in CHUNKS.items()}
CHUNK_BYTES = {"Timestamp": 8, "ExposureTime": 8, "FrameID": 8, "LineStatusAll": 4}


class Kind(StrEnum):
    """What a setting holds."""

    INT = "Integer"
    FLOAT = "Float"
    ENUM = "Enumeration"
    SWITCH = "Boolean"
    COMMAND = "Command"
    TEXT = "StringReg"


@dataclass(frozen=True, kw_only=True)
class Feature:
    """One setting.

    Attributes:
        name: of the standard, where it has one.
        group: of the standard's groups.
        kind: what it holds.
        default: when the device is switched on; the value that a command writes.
        writable: whether an application may set it.
        low: least value.
        high: greatest.
        step: between values of an integer.
        entries: of an enumeration.
        unit: for the reader.
        size: bytes of its register.
        signed: of an integer.
        held: not to be changed while frames are being sent.
        address: of its register; 0 for the next free one.
        bits: highest and lowest bit of the word, from 0 at the top; None for all of it.
    """

    name: str
    group: str
    kind: Kind = Kind.INT
    default: float | str = 0
    writable: bool = True
    low: float = 0
    high: float = 0xFFFFFFFF
    step: int = 1
    entries: Mapping[str, int] = field(default_factory=dict)
    unit: str = ""
    size: int = 4
    signed: bool = False
    held: bool = False
    address: int = 0
    bits: tuple[int, int] | None = None


def _number(name: str, group: str, **rest: object) -> Feature:
    return Feature(name=name, group=group, **rest)  # type: ignore[arg-type]


def _real(name: str, group: str, default: float, low: float, high: float, unit: str) -> Feature:
    return Feature(
        name=name,
        group=group,
        kind=Kind.FLOAT,
        default=default,
        low=low,
        high=high,
        unit=unit,
        size=8,
    )


def _choice(name: str, group: str, entries: Mapping[str, int], **rest: object) -> Feature:
    rest.setdefault("default", next(iter(entries.values())))
    return Feature(name=name, group=group, kind=Kind.ENUM, entries=entries, **rest)  # type: ignore[arg-type]


def _switch(name: str, group: str, **rest: object) -> Feature:
    return Feature(name=name, group=group, kind=Kind.SWITCH, high=1, **rest)  # type: ignore[arg-type]


def _command(name: str, group: str, value: int = 1, **rest: object) -> Feature:
    return Feature(name=name, group=group, kind=Kind.COMMAND, default=value, **rest)  # type: ignore[arg-type]


def _text(name: str, address: int, size: int, *, writable: bool = False) -> Feature:
    return Feature(
        name=name,
        group="DeviceControl",
        kind=Kind.TEXT,
        address=address,
        size=size,
        writable=writable,
    )


def _device(setup: Setup) -> list[Feature]:
    group = "DeviceControl"
    fixed = {"writable": False}
    return [
        _text("DeviceVendorName", Reg.MAKER, 32),
        _text("DeviceModelName", Reg.MODEL, 32),
        _text("DeviceVersion", Reg.DEVICE_VERSION, 32),
        _text("DeviceSerialNumber", Reg.SERIAL, 16),
        _text("DeviceUserID", Reg.USER_NAME, 16, writable=True),
        Feature(
            name="DeviceTemperature",
            group=group,
            kind=Kind.FLOAT,
            default=setup.temperature_c,
            writable=False,
            low=-40,
            high=125,
            unit="C",
            size=8,
        ),
        _number("DeviceLinkSpeed", group, default=setup.link_mbps * 125_000, unit="Bps", **fixed),
        _command("DeviceReset", group),
        _command("TimestampLatch", group),
        _command("TimestampReset", group),
        _number(
            "TimestampLatchValue", group, address=Reg.TIME_HIGH, size=8, high=2**63 - 1, **fixed
        ),
    ]


def _image(setup: Setup) -> list[Feature]:
    group = "ImageFormatControl"
    width, height = setup.width, setup.height
    fixed = {"writable": False}
    formats = {"Mono12p": 0x010C0047} if setup.packed else {n: c for n, (c, _) in FORMATS.items()}
    return [
        _number("SensorWidth", group, default=width, **fixed),
        _number("SensorHeight", group, default=height, **fixed),
        _number("WidthMax", group, default=width, **fixed),
        _number("HeightMax", group, default=height, **fixed),
        _number("Width", group, default=width, low=32, high=width, step=16, held=True),
        _number("Height", group, default=height, low=8, high=height, step=8, held=True),
        _number("OffsetX", group, default=0, high=0, held=True),
        _number("OffsetY", group, default=0, high=0, held=True),
        _choice("PixelFormat", group, formats, held=True),
    ]


def _acquisition() -> list[Feature]:
    group = "AcquisitionControl"
    return [
        _choice("AcquisitionMode", group, {"Continuous": 0, "SingleFrame": 1}, held=True),
        _command("AcquisitionStart", group),
        _command("AcquisitionStop", group),
        _switch("AcquisitionFrameRateEnable", group, default=1),
        _real("AcquisitionFrameRate", group, 25.0, 0.1, 500.0, "Hz"),
        _choice("ExposureMode", group, {"Timed": 0}),
        _real("ExposureTime", group, 1000.0, 10.0, 1_000_000.0, "us"),
        _real("Gain", "AnalogControl", 0.0, 0.0, 24.0, "dB"),
        _choice("TriggerSelector", group, {"FrameStart": 0}),
        _choice("TriggerMode", group, {"Off": 0, "On": 1}),
        _choice("TriggerSource", group, {"Software": 0, "Line0": 1, "Line1": 2, "Action1": 3}),
        _choice("TriggerActivation", group, {"RisingEdge": 0, "FallingEdge": 1}),
        _command("TriggerSoftware", group),
    ]


def _transport() -> list[Feature]:
    group = "TransportLayerControl"
    fixed = {"writable": False}
    return [
        _number("PayloadSize", group, **fixed),
        _switch("GevIEEE1588", group),
        _choice("GevIEEE1588Status", group, PTP_STATES, address=Reg.PTP_STATUS, **fixed),
        _switch("PtpEnable", group),
        _choice("PtpStatus", group, PTP_STATES, **fixed),
        _command("PtpDataSetLatch", group),
        _number(
            "PtpOffsetFromMaster",
            group,
            size=8,
            signed=True,
            low=-(2**62),
            high=2**62,
            unit="ns",
            **fixed,
        ),
        _number("PtpGrandmasterClockID", group, size=8, high=2**63 - 1, **fixed),
        _number(
            "GevHeartbeatTimeout", group, address=Reg.HEARTBEAT, default=3000, low=200, high=60_000
        ),
        _number("GevLinkSpeed", group, address=Reg.LINK_SPEED, unit="Mbps", **fixed),
        _number(
            "GevTimestampTickFrequency",
            group,
            address=Reg.TICKS_HIGH,
            size=8,
            high=2**63 - 1,
            **fixed,
        ),
        _command("GevTimestampControlLatch", group, 2, address=Reg.TIME_CONTROL),
        _command("GevTimestampControlReset", group, 1, address=Reg.TIME_CONTROL),
        _number("GevTimestampValue", group, address=Reg.TIME_HIGH, size=8, high=2**63 - 1, **fixed),
        _number("GevSCPHostPort", group, address=Reg.STREAM_PORT, bits=(16, 31), high=65535),
        _number("GevSCDA", group, address=Reg.STREAM_ADDRESS),
        _number(
            "GevSCSP", group, address=Reg.STREAM_SOURCE_PORT, bits=(16, 31), high=65535, **fixed
        ),
        _number(
            "GevSCPSPacketSize",
            group,
            address=Reg.PACKET_SIZE,
            bits=(16, 31),
            low=220,
            high=9000,
            step=4,
        ),
        _switch("GevSCPSFireTestPacket", group, address=Reg.PACKET_SIZE, bits=(0, 0)),
        _switch("GevSCPSDoNotFragment", group, address=Reg.PACKET_SIZE, bits=(1, 1)),
        _number("GevSCPD", group, address=Reg.PACKET_DELAY, high=1_000_000, unit="ticks"),
        _choice(
            "GevGVSPExtendedIDMode",
            group,
            {"Off": 0, "On": 1},
            address=Reg.GVSP_CONFIGURATION,
            bits=(1, 1),
            held=True,
        ),
    ]


def _action() -> list[Feature]:
    group = "ActionControl"
    return [
        _number("ActionSelector", group, default=1, low=1, high=1),
        _number("ActionDeviceKey", group, address=Reg.ACTION_DEVICE_KEY),
        _number("ActionGroupKey", group, address=Reg.ACTION_GROUP_KEY),
        _number("ActionGroupMask", group, address=Reg.ACTION_GROUP_MASK),
    ]


def feature_table(setup: Setup) -> tuple[Feature, ...]:
    """All settings of a device."""
    chunks = [
        _switch("ChunkModeActive", "ChunkDataControl", held=True),
        _choice("ChunkSelector", "ChunkDataControl", CHUNKS, default=CHUNKS["Timestamp"]),
    ]
    table = _device(setup) + _image(setup) + _acquisition() + chunks + _transport() + _action()
    placed, free = [], SETTINGS_START
    for feature in table:
        if feature.address:
            placed.append(feature)
            continue
        values = {name: getattr(feature, name) for name in feature.__dataclass_fields__}
        placed.append(Feature(**(values | {"address": free})))
        free += 16
    return tuple(placed)
