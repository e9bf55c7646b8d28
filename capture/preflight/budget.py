"""Budgets: what links, memory, disk and host must carry against what they can."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from capture.devices.capabilities import Featured
from capture.devices.protocol import Device, DeviceInfo
from capture.errors import DeviceError
from capture.judgement import Colour
from capture.preflight.finding import Finding, steps

# What a link carries of pixels: 118 of 125 MB/s on Gigabit Ethernet with frames of 9000 bytes,
# 450 of 625 MB/s on USB at 5 Gbit/s.
_SHARES = {"gige": 0.944, "usb3": 0.72, "v4l2": 0.72}
_FULL = 0.9  # of that: a link this full has no room to send lost packets again
_RMEM_BYTES = 10_000_000
_PACKET_BYTES = 8000
_SLOW_MBPS = 200.0  # below, small packets do no harm
_READOUTS_US = ("SensorReadoutTime", "ReadoutTime", "ReadoutTimeAbs")
_RATES_HZ = ("ResultingFrameRate", "AcquisitionResultingFrameRate", "ResultingFrameRateAbs")
_KEPT_BYTES = 1 << 29  # for the rest of the host


@dataclass(frozen=True)
class SharedLink:
    """A link that several devices share: an uplink of a switch, a USB controller.

    Attributes:
        name: for the operator.
        mbps: what it carries of pixels, Mbit/s.
        devices: names of those behind it.
    """

    name: str
    mbps: float
    devices: tuple[str, ...]


def needed_mbps(info: DeviceInfo, rate_hz: float) -> float:
    """Pixels that a device sends at that rate, Mbit/s."""
    return frame_bytes(info) * rate_hz * 8e-6


def frame_bytes(info: DeviceInfo) -> int:
    """Bytes of one frame of a device."""
    layout = info.layout
    deep = 2 if layout.dtype == "uint16" else 1
    return layout.width * layout.height * layout.channels * deep


def link_findings(
    infos: Sequence[DeviceInfo], rate_hz: float, shared: Sequence[SharedLink] = ()
) -> list[Finding]:
    """Hold the rate against each device's link and each shared one; too little is refused.

    Args:
        infos: what the devices say of themselves.
        rate_hz: of the triggers.
        shared: links that several devices share.
    """
    found = []
    by_name = {info.name: info for info in infos}
    for info in infos:
        if info.link_mbps is None:
            continue
        carries = info.link_mbps * _SHARES.get(info.transport, 1.0)
        found += _over(
            info.name, f"the link of {info.name}", needed_mbps(info, rate_hz), carries, rate_hz
        )
    for link in shared:
        behind = [by_name[name] for name in link.devices if name in by_name]
        need = sum(needed_mbps(info, rate_hz) for info in behind)
        what = f"{link.name}, shared by {len(behind)} devices,"
        found += _over("", what, need, link.mbps, rate_hz)
    if not found:
        total = sum(needed_mbps(info, rate_hz) for info in infos)
        unknown = [info.name for info in infos if info.link_mbps is None]
        words = f"Links carry {total:.0f} Mbit/s at {rate_hz:g} Hz"
        words += f"; not known of {len(unknown)} devices." if unknown else "."
        found.append(Finding("link", "", Colour.GREEN, words))
    return found


def _over(device: str, what: str, need: float, carries: float, rate_hz: float) -> list[Finding]:
    if need <= _FULL * carries:
        return []
    most = rate_hz * carries / need if need else 0.0
    red = need > carries
    words = (
        f"{what[0].upper()}{what[1:]} must carry {need:.0f} Mbit/s of pixels at {rate_hz:g} Hz and "
        f"{'carries' if red else 'has room for'} {carries:.0f}: "
        + (f"at most {most:.1f} Hz." if red else "no room to send lost packets again.")
    )
    remedies = (
        f"Set rate_hz to {_FULL * most:.0f} or less, or a smaller image, or 8 bits a pixel.",
        "Or put the device on a faster link: a loose plug or an old cable also makes it slow.",
    )
    return [Finding("link", device, Colour.RED if red else Colour.AMBER, words, steps(remedies))]


def timing_findings(
    devices: Sequence[Device], rate_hz: float, exposure_us: float, readout_us: float | None = None
) -> list[Finding]:
    """Whether exposure and readout fit the period of each device, and whether it limits itself.

    Args:
        devices: of the array.
        rate_hz: of the triggers.
        exposure_us: of every device.
        readout_us: of devices that do not tell theirs; None: not known.
    """
    period = 1e6 / rate_hz
    found = []
    for device in devices:
        name = device.info.name
        read = _number(device, _READOUTS_US)
        readout = read if read is not None else readout_us
        takes = exposure_us + (readout or 0.0)
        if takes >= period:
            parts = f"exposure {exposure_us:.0f} us and readout {readout or 0:.0f} us"
            found.append(
                Finding(
                    "link", name, Colour.RED,
                    f"{name} needs {takes:.0f} us for a frame ({parts}), the period is "
                    f"{period:.0f} us: it would miss triggers.",
                    f"Set exposure_us to {max(period - (readout or 0) - 50, 1):.0f} or less, or "
                    f"rate_hz to {1e6 / (takes + 50):.0f} or less.",
                )
            )  # fmt: skip
        most = _number(device, _RATES_HZ)
        if most is not None and most < rate_hz * 0.999:
            found.append(
                Finding(
                    "link", name, Colour.RED,
                    f"{name} says that it reaches {most:.2f} Hz with its settings; {rate_hz:g} Hz "
                    "are asked for: it would miss triggers.",
                    steps((
                        "Shorten the exposure, or make the image smaller.",
                        "Raise DeviceLinkThroughputLimit, or set its mode to Off.",
                    )),
                )
            )  # fmt: skip
    if not found:
        words = f"Exposure and readout fit the period of {period:.0f} us."
        found.append(Finding("link", "", Colour.GREEN, words))
    return found


def memory_findings(need_bytes: int, proc: Path = Path("/proc")) -> list[Finding]:
    """Whether the ring fits into memory.

    Args:
        need_bytes: frames reserved, all devices together; what of it is resident already counts.
        proc: where the kernel tells.
    """
    free = _kib(proc / "meminfo", "MemAvailable")
    if free is None:
        return []
    resident = _kib(proc / "self" / "status", "RssShmem") or 0
    still = max(0, need_bytes - resident)
    ring = f"The ring of frames takes {need_bytes / 1e9:.1f} GB"
    if still + _KEPT_BYTES > free:
        return [
            Finding(
                "memory", "", Colour.RED,
                f"{ring}, {still / 1e9:.1f} GB more than now; {free / 1e9:.1f} GB are free.",
                steps((
                    "Close other programs on this machine.",
                    "Reserve fewer frames: pre-roll and takes in flight make the ring large.",
                )),
            )
        ]  # fmt: skip
    return [Finding("memory", "", Colour.GREEN, f"{ring}; {free / 1e9:.1f} GB are free.")]


def network_findings(
    devices: Sequence[Device], rate_hz: float, proc: Path = Path("/proc")
) -> list[Finding]:
    """Whether receive buffers and packets are large enough for GigE Vision."""
    wired = [device for device in devices if device.info.transport == "gige"]
    if not wired:
        return []
    found = []
    largest = _whole_number(proc / "sys" / "net" / "core" / "rmem_max")
    if largest is not None and largest < _RMEM_BYTES:
        found.append(
            Finding(
                "network", "", Colour.AMBER,
                f"The host lets a socket buffer {largest} bytes; {_RMEM_BYTES} are wanted: a busy "
                "moment would lose packets.",
                "Run as root: sysctl -w net.core.rmem_max=33554432",
            )
        )  # fmt: skip
    for device in wired:
        packet = _number(device, ("GevSCPSPacketSize",))
        if packet is None or packet >= _PACKET_BYTES:
            continue
        if needed_mbps(device.info, rate_hz) >= _SLOW_MBPS:
            name = device.info.name
            found.append(
                Finding(
                    "network", name, Colour.AMBER,
                    f"{name} sends packets of {packet:.0f} bytes; 9000 are wanted: six times the "
                    "packets, six times the chances to lose one.",
                    steps((
                        "Set an MTU of 9000 on this machine's interface: ip link set dev NAME mtu "
                        "9000",
                        "Switch on jumbo frames in every switch between.",
                        f"Open {name} again.",
                    )),
                )
            )  # fmt: skip
    if not found:
        words = "Packets and receive buffers are large enough."
        found.append(Finding("network", "", Colour.GREEN, words))
    return found


def host_links(infos: Sequence[DeviceInfo], root: Path = Path("/")) -> list[SharedLink]:
    """Interfaces and USB controllers of this machine that devices share, as far as it tells.

    Args:
        infos: what the devices say of themselves.
        root: where proc and sys are.
    """
    behind: dict[tuple[str, float], list[str]] = {}
    routes = _routes(root / "proc" / "net" / "route")
    for info in infos:
        if info.transport == "gige":
            name = _interface(info.address, routes)
            speed = _whole_number(root / "sys" / "class" / "net" / name / "speed") if name else None
            if speed is not None and speed > 0:
                key = (f"interface {name}", speed * _SHARES["gige"])
                behind.setdefault(key, []).append(info.name)
        elif info.transport == "v4l2":
            node = root / "sys" / "class" / "video4linux" / Path(info.address).name / "device"
            parts = node.resolve().parts
            buses = [place for place, part in enumerate(parts) if part.startswith("usb")]
            if buses:
                key = (f"USB controller {parts[buses[0] - 1]}", 5000 * _SHARES["usb3"])
                behind.setdefault(key, []).append(info.name)
    return [
        SharedLink(name, mbps, tuple(names))
        for (name, mbps), names in behind.items()
        if len(names) > 1
    ]


def _routes(path: Path) -> list[tuple[int, int, str]]:
    """(destination, mask, interface), the narrowest first."""
    try:
        lines = path.read_text(encoding="ascii").splitlines()[1:]
    except (OSError, UnicodeDecodeError):
        return []
    routes = []
    for line in lines:
        fields = line.split()
        if len(fields) >= 8:
            # The kernel writes them as little-endian words.
            at, mask = (int.from_bytes(bytes.fromhex(fields[k]), "little") for k in (1, 7))
            routes.append((at, mask, fields[0]))
    return sorted(routes, key=lambda route: -route[1])


def _interface(address: str, routes: Sequence[tuple[int, int, str]]) -> str:
    parts = address.split(".")
    if len(parts) != 4 or not all(part.isdigit() and int(part) < 256 for part in parts):
        return ""
    number = int.from_bytes(bytes(int(part) for part in parts), "big")
    return next((name for at, mask, name in routes if number & mask == at), "")


def _number(device: object, features: Sequence[str]) -> float | None:
    """The first of the features that the device has, when it is a number."""
    if not isinstance(device, Featured):
        return None
    for feature in features:
        try:
            value = device.read_feature(feature)
        except DeviceError:
            continue
        if isinstance(value, int | float) and not isinstance(value, bool):
            return float(value)
    return None


def _kib(path: Path, key: str) -> int | None:
    """Bytes of a line such as `MemAvailable:  1234 kB`."""
    try:
        lines = path.read_text(encoding="ascii").splitlines()
    except (OSError, UnicodeDecodeError):
        return None
    for line in lines:
        fields = line.split()
        if len(fields) >= 2 and fields[0] == f"{key}:" and fields[1].isdigit():
            return int(fields[1]) * 1024
    return None


def _whole_number(path: Path) -> int | None:
    try:
        return int(path.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None


def ring_bytes(infos: Sequence[DeviceInfo], reserved: Mapping[str, int]) -> int:
    """Memory that the reserved frames of all devices take."""
    return sum(frame_bytes(info) * reserved.get(info.name, 0) for info in infos)
