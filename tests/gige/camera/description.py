"""A device's description of its settings (GenICam XML), made from the table of `features`."""

from __future__ import annotations

from collections.abc import Iterable
from xml.sax.saxutils import escape

from tests.gige.camera.features import CHUNK_BYTES, CHUNK_IDS, CHUNK_SWITCHES, CHUNKS, Feature, Kind

_ROOT = (
    '<?xml version="1.0" encoding="utf-8"?>\n'
    '<RegisterDescription ModelName="OwnDevice" VendorName="Likeness" ToolTip="A device for tests"'
    ' StandardNameSpace="GEV" SchemaMajorVersion="1" SchemaMinorVersion="1"'
    ' SchemaSubMinorVersion="0"'
    ' MajorVersion="1" MinorVersion="0" SubMinorVersion="0"'
    ' ProductGuid="6f1d7d3e-0c36-4d0b-9d0a-2f6f2b7c1a01"'
    ' VersionGuid="6f1d7d3e-0c36-4d0b-9d0a-2f6f2b7c1a02"'
    ' xmlns="http://www.genicam.org/GenApi/Version_1_1">\n'
)


def describe(table: Iterable[Feature]) -> bytes:
    """The whole description."""
    table = tuple(table)
    groups: dict[str, list[str]] = {}
    for feature in table:
        groups.setdefault(feature.group, []).append(feature.name)
    groups["TransportLayerControl"].append("TLParamsLocked")
    groups["ChunkDataControl"] += ["ChunkEnable", *(f"Chunk{name}" for name in CHUNK_BYTES)]
    nodes = [_tag("Category", "Root", "".join(f"<pFeature>{name}</pFeature>" for name in groups))]
    for name, members in groups.items():
        nodes.append(_tag("Category", name, "".join(f"<pFeature>{m}</pFeature>" for m in members)))
    nodes += [node for feature in table for node in _feature(feature)]
    nodes += _chunk_switch()
    nodes += [node for name in CHUNK_BYTES for node in _chunk(name)]
    nodes.append(_tag("Integer", "TLParamsLocked", "<Value>0</Value><Min>0</Min><Max>1</Max>"))
    nodes.append('<Port Name="Device"/>')
    return (_ROOT + "\n".join(nodes) + "\n</RegisterDescription>\n").encode()


def _tag(kind: str, name: str, inside: str) -> str:
    return f'<{kind} Name="{name}">{inside}</{kind}>'


def _feature(feature: Feature) -> list[str]:
    mode = "WO" if feature.kind is Kind.COMMAND else "RW" if feature.writable else "RO"
    place = f"<Address>{feature.address:#x}</Address><Length>{feature.size}</Length>"
    place += f"<AccessMode>{mode}</AccessMode><pPort>Device</pPort><Cachable>NoCache</Cachable>"
    if feature.kind is Kind.TEXT:
        return [_tag("StringReg", feature.name, place)]
    inside = f"<pValue>{feature.name}Reg</pValue>"
    if feature.held:
        inside += "<pIsLocked>TLParamsLocked</pIsLocked>"
    if feature.kind in (Kind.INT, Kind.FLOAT):
        inside += f"<Min>{feature.low}</Min><Max>{feature.high}</Max>"
    if feature.kind is Kind.INT:
        inside += f"<Inc>{feature.step}</Inc>"
    if feature.unit and feature.kind in (Kind.INT, Kind.FLOAT):
        inside += f"<Unit>{escape(feature.unit)}</Unit>"
    if feature.kind is Kind.COMMAND:
        inside += f"<CommandValue>{feature.default}</CommandValue>"
    if feature.kind is Kind.SWITCH:
        inside += "<OnValue>1</OnValue><OffValue>0</OffValue>"
    inside += "".join(
        _tag("EnumEntry", name, f"<Value>{value}</Value>")
        for name, value in feature.entries.items()
    )
    if feature.name == "ChunkSelector":
        inside += "<pSelected>ChunkEnable</pSelected>"
    return [_tag(feature.kind, feature.name, inside), _register(feature, place)]


def _register(feature: Feature, place: str) -> str:
    name = f"{feature.name}Reg"
    if feature.kind is Kind.FLOAT:
        return _tag("FloatReg", name, place + "<Endianess>BigEndian</Endianess>")
    sign = "Signed" if feature.signed else "Unsigned"
    tail = f"<Sign>{sign}</Sign><Endianess>BigEndian</Endianess>"
    if feature.bits is None:
        return _tag("IntReg", name, place + tail)
    top, bottom = feature.bits
    return _tag("MaskedIntReg", name, f"{place}<LSB>{bottom}</LSB><MSB>{top}</MSB>{tail}")


def _chunk_switch() -> list[str]:
    return [
        _tag("Boolean", "ChunkEnable", "<pValue>ChunkEnableReg</pValue>"),
        _tag(
            "IntReg",
            "ChunkEnableReg",
            f"<Address>{CHUNK_SWITCHES:#x}</Address><pAddress>ChunkEnablePlace</pAddress>"
            "<Length>4</Length><AccessMode>RW</AccessMode><pPort>Device</pPort>"
            "<Cachable>NoCache</Cachable><Sign>Unsigned</Sign><Endianess>BigEndian</Endianess>",
        ),
        _tag(
            "IntSwissKnife",
            "ChunkEnablePlace",
            '<pVariable Name="SEL">ChunkSelectorReg</pVariable><Formula>SEL * 4</Formula>',
        ),
    ]


def _chunk(name: str) -> list[str]:
    size, port = CHUNK_BYTES[name], f"Chunk{name}Port"
    place = (
        f"<Address>0</Address><Length>{size}</Length><AccessMode>RO</AccessMode>"
        f"<pPort>{port}</pPort><Cachable>NoCache</Cachable>"
    )
    ports = _tag("Port", port, f"<ChunkID>{CHUNK_IDS[name]:08x}</ChunkID>")
    value = f"<pValue>Chunk{name}Reg</pValue>"
    if name == "ExposureTime":
        register = _tag("FloatReg", f"Chunk{name}Reg", place + "<Endianess>BigEndian</Endianess>")
        return [_tag("Float", f"Chunk{name}", value), register, ports]
    place += "<Sign>Unsigned</Sign><Endianess>BigEndian</Endianess>"
    return [
        _tag("Integer", f"Chunk{name}", value),
        _tag("IntReg", f"Chunk{name}Reg", place),
        ports,
    ]


def chunk_names() -> tuple[str, ...]:
    """Chunks that can be switched."""
    return tuple(name for name in CHUNKS if name != "Image")
