"""Open the devices of an array file, write their presets, and find the line that triggers them."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from capture.array_file import ArrayDevice, ArrayFile
from capture.devices.array import DeviceArray
from capture.devices.backend import Backend, LineOwner, load_backend
from capture.devices.capabilities import Featured, PtpClocked
from capture.devices.common_clock import CommonClock
from capture.devices.lines import ActionLine, HostLine, SoftwareLine
from capture.devices.preset import apply_preset, read_preset
from capture.devices.protocol import Device, TriggerKind, TriggerLine
from capture.errors import DeviceError, ExtraError, InputError, SettingsError
from capture.names import named

_FORMATS = {
    ("Mono8", "GREY"): (1, "uint8"),
    ("Mono10", "Mono12", "Mono14", "Mono16", "Y10", "Y12"): (1, "uint16"),
    ("RGB8", "YUYV", "MJPEG"): (3, "uint8"),
}


def _unheard(sentence: str) -> None:
    """Nobody listens."""


def open_array(file: ArrayFile, *, told: Callable[[str], None] = _unheard) -> DeviceArray:
    """Open every device of an array file and write its preset; all are tried.

    Args:
        file: what the array file says.
        told: given a sentence for each setting that does not read back as its preset asks.

    Raises:
        DeviceError: listing every device that could not be opened or is not as the file says;
            those that were opened are closed again.
        SettingsError: naming a backend that there is not, or backends that cannot be triggered
            together.
        ExtraError: when all that failed is that a backend's optional packages are not installed.
    """
    backends = {name: load_backend(name) for name in {entry.backend for entry in file.devices}}
    devices: list[Device] = []
    problems = []
    try:
        for entry in file.devices:
            try:
                devices.append(_opened(entry, file, backends[entry.backend], told))
            except (DeviceError, InputError) as error:
                problems.append((entry.name, error))
        _raise(file, problems)
        return DeviceArray(
            tuple(devices), _line(file, backends, devices), trigger=file.trigger,
            source=file.source, action=file.action.keys,
        )  # fmt: skip
    except BaseException:
        for device in devices:
            device.close()
        raise


def _raise(file: ArrayFile, problems: list[tuple[str, DeviceError | InputError]]) -> None:
    if not problems:
        return
    if all(isinstance(error, ExtraError) for _, error in problems):
        raise problems[0][1]
    lines = "\n".join(f"  - {named(name, error)}" for name, error in problems)
    raise DeviceError(
        f"array {file.name!r}: {len(problems)} of {len(file.devices)} devices could not be opened; "
        f"`likeness devices --array` compares them with what is found\n{lines}"
    )


def _opened(
    entry: ArrayDevice, file: ArrayFile, backend: Backend, told: Callable[[str], None]
) -> Device:
    device = backend.open(entry.known_as, entry.name)
    try:
        if entry.preset is not None:
            if not isinstance(device, Featured):
                raise DeviceError(
                    f"has no named settings to write {entry.preset.name} to; take preset out of "
                    "the array file"
                )
            for difference in apply_preset(device, read_preset(entry.preset)):
                told(named(entry.name, f"{entry.preset.name}: {difference}"))
        if file.ptp and isinstance(device, PtpClocked):
            device.enable_ptp(True)
        _check(entry, file, device)
    except BaseException:
        device.close()
        raise
    return device


def _check(entry: ArrayDevice, file: ArrayFile, device: Device) -> None:
    info, problems = device.info, []
    if file.trigger not in info.triggers:
        offers = ", ".join(info.triggers)
        problems.append(
            f"asked for trigger {file.trigger}, offers {offers}; "
            f'set trigger = "{info.triggers[0]}" in the array file'
        )
    for key, found in (("width", info.layout.width), ("height", info.layout.height)):
        asked = getattr(entry, key)
        if asked is not None and asked != found:
            problems.append(
                f"asked for {key} = {asked}, has {found}; write the {key} in a preset, "
                f"or set {key} = {found} in the array file"
            )
    if entry.pixel_format is not None:
        problems += _format_problems(entry.pixel_format, device)
    if problems:
        raise DeviceError("; ".join(problems))


def _format_problems(asked: str, device: Device) -> list[str]:
    """What is wrong with the pixel format: the device's own word, else its kind of pixels."""
    if isinstance(device, Featured):
        try:
            found = device.read_feature("PixelFormat")
        except DeviceError:
            found = ""
        if found == asked:
            return []
        if found:
            return [
                f"asked for pixel_format {asked}, has {found}; write PixelFormat in a preset, "
                f'or set pixel_format = "{found}" in the array file'
            ]
    layout = device.info.layout
    has = (layout.channels, layout.dtype)
    meant = [formats for formats, kind in _FORMATS.items() if kind == has]
    if any(asked in formats for formats in meant):
        return []
    return [
        f"asked for pixel_format {asked}, has frames of {layout.channels} channels, "
        f"{layout.dtype}: {' or '.join(', '.join(formats) for formats in meant)}"
    ]


def _line(file: ArrayFile, backends: Mapping[str, Backend], devices: list[Device]) -> TriggerLine:
    """What triggers the devices; a backend whose devices hang on a wire of its own gives that."""
    if file.trigger == TriggerKind.SOFTWARE:
        return SoftwareLine(devices)
    if file.trigger == TriggerKind.ACTION:
        common = CommonClock(devices) if file.scheduled else None
        return ActionLine(devices, file.action, common)
    owners = {name: backend for name, backend in backends.items() if isinstance(backend, LineOwner)}
    if file.trigger == TriggerKind.FREE_RUN or not owners:
        return HostLine()
    if len(backends) > 1:
        others = ", ".join(sorted(set(backends) - {min(owners)}))
        raise SettingsError(
            f"array {file.name!r}: devices of backend {min(owners)} hang on a wire of their own "
            f"and cannot share hardware triggers with {others}"
        )
    return next(iter(owners.values())).line()
