"""Controls of a device: what there is, with ranges and menus; reading and writing them."""

from __future__ import annotations

import ctypes
import errno
import re
from dataclasses import dataclass, field

from capture.devices.capabilities import FeatureValue
from capture.devices.v4l2 import ioctls
from capture.devices.v4l2.node import Node, said
from capture.errors import DeviceError
from capture.names import known_hint

_SIMPLE = {
    ioctls.TYPE_INTEGER: "integer",
    ioctls.TYPE_BOOLEAN: "switch",
    ioctls.TYPE_MENU: "menu",
    ioctls.TYPE_BUTTON: "button",
    ioctls.TYPE_INTEGER64: "integer",
    ioctls.TYPE_STRING: "text",
    ioctls.TYPE_BITMASK: "bits",
    ioctls.TYPE_INTEGER_MENU: "menu of numbers",
}


@dataclass(frozen=True)
class ControlInfo:
    """One control.

    Attributes:
        name: in lower case with underscores, as v4l2-ctl writes it.
        id: the kernel's number.
        type: the kernel's number of its type.
        minimum: lowest value; of a text, its shortest length.
        maximum: highest value; of a text, its longest length.
        step: from value to value.
        default: as the driver starts.
        flags: the kernel's, when it was asked.
        menu: of a menu, its entries by number.
    """

    name: str
    id: int
    type: int
    minimum: int
    maximum: int
    step: int
    default: int
    flags: int
    menu: dict[int, str | int] = field(default_factory=dict)

    @property
    def kind(self) -> str:
        """Its type in a word; "compound" for what has no single value."""
        return _SIMPLE.get(self.type, "compound")

    @property
    def offers(self) -> str:
        """What it takes, in words."""
        if self.menu:
            return ", ".join(repr(entry) for entry in self.menu.values())
        if self.type == ioctls.TYPE_BOOLEAN:
            return "true or false"
        if self.type == ioctls.TYPE_BUTTON:
            return "true, to press it"
        if self.type == ioctls.TYPE_STRING:
            return f"texts of {self.minimum} to {self.maximum} bytes"
        steps = f" in steps of {self.step}" if self.step > 1 else ""
        return f"{self.minimum} to {self.maximum}{steps}"


def list_controls(node: Node) -> dict[str, ControlInfo]:
    """All controls of a node that are not disabled, by name, in the driver's order.

    Raises:
        DeviceError: when the device is gone.
    """
    found: dict[str, ControlInfo] = {}
    query = ioctls.ControlQuery(id=ioctls.NEXT_CTRL | ioctls.NEXT_COMPOUND)
    while True:
        try:
            node.call(ioctls.QUERY_EXT_CTRL, query)
        except OSError as error:
            if error.errno in (errno.EINVAL, errno.ENOTTY):  # no more of them, or none at all
                return found
            raise DeviceError(
                f"{node.path}: its controls cannot be listed: {said(error)}"
            ) from error
        if query.type != ioctls.TYPE_CLASS and not query.flags & ioctls.CTRL_DISABLED:
            info = _info(node, query)
            name = info.name if info.name not in found else f"{info.name}_{info.id:08x}"
            found[name] = info
        query = ioctls.ControlQuery(id=query.id | ioctls.NEXT_CTRL | ioctls.NEXT_COMPOUND)


def find_control(controls: dict[str, ControlInfo], name: str, others: list[str]) -> ControlInfo:
    """The control of that name.

    Raises:
        DeviceError: naming the nearest known name.
    """
    if name not in controls:
        raise DeviceError(f"no setting {name!r}; {known_hint(name, [*others, *controls])}")
    return controls[name]


def read_control(node: Node, info: ControlInfo) -> FeatureValue:
    """The value of a control: of a menu, the entry's text or number.

    Raises:
        DeviceError: when it has none, or the device does not answer.
    """
    if info.kind == "compound" or info.type == ioctls.TYPE_BUTTON:
        raise DeviceError(f"{info.name}: a {info.kind} setting has no value to read")
    if info.flags & ioctls.CTRL_WRITE_ONLY:
        raise DeviceError(f"{info.name}: can only be written")
    control = ioctls.Control(id=info.id)
    text = ctypes.create_string_buffer(info.maximum + 1) if _is_text(info) else None
    if text is not None:
        control.size, control.u.string = len(text), ctypes.cast(text, ctypes.c_char_p)
    _exchange(node, ioctls.G_EXT_CTRLS, control, info)
    if text is not None:
        return text.value.decode("utf-8", "replace")
    if info.type == ioctls.TYPE_INTEGER64:
        return int(control.u.value64)
    value = int(control.u.value)
    if info.type == ioctls.TYPE_BOOLEAN:
        return bool(value)
    if info.type == ioctls.TYPE_BITMASK:
        return value & 0xFFFFFFFF
    return info.menu.get(value, value)


def write_control(node: Node, info: ControlInfo, value: FeatureValue) -> None:
    """Set a control; what the driver makes of it is read by `read_control`.

    Raises:
        DeviceError: saying what it offers, or why it cannot be written now.
    """
    _check_writable(node, info)
    control = ioctls.Control(id=info.id)
    if _is_text(info):
        if not isinstance(value, str) or not info.minimum <= len(value.encode()) <= info.maximum:
            raise DeviceError(f"{info.name}: asked for {value!r}, offers {info.offers}")
        text = ctypes.create_string_buffer(value.encode(), info.maximum + 1)
        control.size, control.u.string = len(text), ctypes.cast(text, ctypes.c_char_p)
    elif info.type == ioctls.TYPE_INTEGER64:
        control.u.value64 = _number(info, value)
    else:
        number = _number(info, value)
        control.u.value = number - (1 << 32) if number >= 1 << 31 else number
    _exchange(node, ioctls.S_EXT_CTRLS, control, info)


def control_table(controls: dict[str, ControlInfo]) -> dict[str, dict[str, object]]:
    """All that the driver says of its controls, for a file."""
    return {
        name: {
            "id": f"0x{info.id:08x}",
            "kind": info.kind,
            "minimum": info.minimum,
            "maximum": info.maximum,
            "step": info.step,
            "default": info.default,
            **({"menu": {str(k): v for k, v in info.menu.items()}} if info.menu else {}),
        }
        for name, info in controls.items()
    }


def _info(node: Node, query: ioctls.ControlQuery) -> ControlInfo:
    label = query.name.decode("ascii", "replace")
    compound = query.nr_of_dims or query.type not in _SIMPLE
    name = re.sub(r"[^a-z0-9]+", "_", label.lower()).strip("_") or f"control_{query.id:08x}"
    info = ControlInfo(
        name, query.id, 0 if compound else query.type, query.minimum, query.maximum,
        query.step, query.default_value, query.flags,
    )  # fmt: skip
    if info.type in (ioctls.TYPE_MENU, ioctls.TYPE_INTEGER_MENU):
        for index in range(info.minimum, info.maximum + 1):
            entry = ioctls.MenuQuery(id=info.id, index=index)
            try:
                node.call(ioctls.QUERYMENU, entry)
            except OSError:
                continue  # a menu may have gaps
            number = info.type == ioctls.TYPE_INTEGER_MENU
            info.menu[index] = (
                int(entry.u.value) if number else entry.u.name.decode("utf-8", "replace")
            )
    return info


def _is_text(info: ControlInfo) -> bool:
    return info.type == ioctls.TYPE_STRING


def _number(info: ControlInfo, value: FeatureValue) -> int:
    """The kernel's number for a value, refused here with all that would be right."""
    if isinstance(value, str):
        by_text = {entry: index for index, entry in info.menu.items()}
        if value in by_text:
            return by_text[value]
    elif info.type == ioctls.TYPE_BUTTON:
        if value == 1:
            return 1
    elif info.type == ioctls.TYPE_BOOLEAN:
        if value in (0, 1):
            return int(value)
    elif info.type == ioctls.TYPE_INTEGER_MENU:
        by_number = {entry: index for index, entry in info.menu.items()}
        if value in by_number:
            return by_number[int(value)]
    elif info.menu:
        if value in info.menu and not isinstance(value, bool):
            return int(value)
    elif not isinstance(value, bool) and float(value).is_integer():
        on_step = (int(value) - info.minimum) % max(info.step, 1) == 0
        if info.minimum <= int(value) <= info.maximum and on_step:
            return int(value)
    raise DeviceError(f"{info.name}: asked for {value!r}, offers {info.offers}")


def _check_writable(node: Node, info: ControlInfo) -> None:
    if info.kind == "compound":
        raise DeviceError(f"{info.name}: a compound setting cannot be written here")
    query = ioctls.ControlQuery(id=info.id)
    try:
        node.call(ioctls.QUERY_EXT_CTRL, query)
    except OSError as error:
        raise DeviceError(f"{info.name}: {said(error)}") from error
    if query.flags & ioctls.CTRL_READ_ONLY:
        raise DeviceError(f"{info.name}: can only be read")
    if query.flags & ioctls.CTRL_GRABBED:
        raise DeviceError(f"{info.name}: cannot be changed while the device streams; stop it first")
    if query.flags & ioctls.CTRL_INACTIVE:
        raise DeviceError(
            f"{info.name}: has no effect now, since another setting rules it; "
            "switch off the automatic mode that belongs to it first"
        )


def _exchange(node: Node, request: int, control: ioctls.Control, info: ControlInfo) -> None:
    controls = ioctls.Controls(count=1, controls=ctypes.pointer(control))
    try:
        node.call(request, controls)
    except OSError as error:
        why = f"the driver refused; it offers {info.offers}" if error.errno in (
            errno.EINVAL, errno.ERANGE,
        ) else said(error)  # fmt: skip
        raise DeviceError(f"{info.name}: {why}") from error
