"""What a device streams: pixel format, size and rate, set and read back."""

from __future__ import annotations

import errno
from fractions import Fraction

from capture.devices.v4l2 import ioctls
from capture.devices.v4l2.formats import SUPPORTED, fourcc_text, refusal
from capture.devices.v4l2.node import Node, said
from capture.errors import DeviceError

_RATE_TOLERANCE = 5e-4  # 30 Hz is not 29.97 Hz
_MOST = 256  # a driver that never ends a list is cut off here


def offered_formats(node: Node) -> tuple[str, ...]:
    """The names of all pixel formats that a node offers, whether we take them or not."""
    names: list[str] = []
    for index in range(_MOST):
        description = ioctls.FormatDescription(index=index, type=ioctls.BUF_TYPE_CAPTURE)
        try:
            node.call(ioctls.ENUM_FMT, description)
        except OSError:
            break
        names.append(fourcc_text(description.pixelformat))
    return tuple(names)


def format_problem(offered: tuple[str, ...]) -> str:
    """Why none of the formats on offer can be taken; empty when one can."""
    if any(not refusal(name) for name in offered):
        return ""
    if not offered:
        return "it offers no pixel format"
    return "no pixel format that is taken: " + "; ".join(
        f"{name}: {refusal(name)}" for name in offered
    )


def present_format(node: Node) -> ioctls.PixFormat:
    """The format that is set.

    Raises:
        DeviceError: when the driver does not say.
    """
    asked = ioctls.Format(type=ioctls.BUF_TYPE_CAPTURE)
    return _format_call(node, ioctls.G_FMT, asked, "its format cannot be read")


def set_format(node: Node, name: str, width: int, height: int) -> ioctls.PixFormat:
    """Set pixel format and size; the driver may round the size.

    Raises:
        DeviceError: saying what is on offer.
    """
    return _ask_format(node, ioctls.S_FMT, name, width, height)


def set_size(node: Node, width: int | None, height: int | None) -> ioctls.PixFormat:
    """Set the width, or the height; the other side stays, or else keeps the shape of the image.

    Raises:
        DeviceError: when the device does not offer it; then nothing is changed.
    """
    now = present_format(node)
    name = fourcc_text(now.pixelformat)
    if width is not None:
        sizes = [(width, int(now.height)), (width, max(now.height * width // now.width, 1))]
    else:
        tall = height or int(now.height)
        sizes = [(int(now.width), tall), (max(now.width * tall // now.height, 1), tall)]
    found = now
    for size in sizes:
        found = _ask_format(node, ioctls.TRY_FMT, name, *size)
        if (found.width if width is not None else found.height) == (width or height):
            return set_format(node, name, int(found.width), int(found.height))
    raise DeviceError(
        f"asked for {width or height}, the device sets {found.width} x {found.height} px"
    )


def _ask_format(node: Node, request: int, name: str, width: int, height: int) -> ioctls.PixFormat:
    offered = offered_formats(node)
    why = refusal(name) if name in SUPPORTED or name in offered else "the device does not offer it"
    if not why and name not in offered:
        why = "the device does not offer it"
    if why:
        usable = ", ".join(each for each in offered if not refusal(each)) or "none that is taken"
        raise DeviceError(f"{node.path}: pixel format {name}: {why}; usable here: {usable}")
    asked = ioctls.Format(type=ioctls.BUF_TYPE_CAPTURE)
    pix = asked.fmt.pix
    pix.width, pix.height, pix.pixelformat = width, height, SUPPORTED[name].fourcc
    pix.field = ioctls.FIELD_NONE
    found = _format_call(node, request, asked, f"{name} of {width} x {height} px")
    if fourcc_text(found.pixelformat) != name:
        raise DeviceError(f"{node.path}: asked for {name}, set {fourcc_text(found.pixelformat)}")
    return found


def usable_format(node: Node) -> ioctls.PixFormat:
    """The format that is set when we take it, else the first on offer that we do, at that size.

    Raises:
        DeviceError: when there is none.
    """
    found = present_format(node)
    if not refusal(fourcc_text(found.pixelformat)):
        return found
    offered = offered_formats(node)
    problem = format_problem(offered)
    if problem:
        raise DeviceError(f"{node.path}: {problem}")
    name = next(each for each in SUPPORTED if each in offered and not refusal(each))
    return set_format(node, name, int(found.width), int(found.height))


def period_ns(node: Node) -> int | None:
    """From frame to frame; None when the driver does not say."""
    parameters = ioctls.StreamParm(type=ioctls.BUF_TYPE_CAPTURE)
    try:
        node.call(ioctls.G_PARM, parameters)
    except OSError:
        return None
    return _fraction_ns(parameters)


def set_period(node: Node, wanted_ns: int) -> int | None:
    """Set the time from frame to frame.

    Returns:
        What the driver set; None when it has no say in it.

    Raises:
        DeviceError: when it sets another rate, saying which there are; the old one is set again.
    """
    before = period_ns(node)
    found = _ask_period(node, wanted_ns)
    if found is not None and abs(found - wanted_ns) > _RATE_TOLERANCE * wanted_ns:
        rates = _rates(node)
        offers = f"; at this size it offers {', '.join(rates)} Hz" if rates else ""
        if before is not None:
            _ask_period(node, before)
        raise DeviceError(
            f"{node.path}: asked for {1e9 / wanted_ns:.3f} Hz, sets {1e9 / found:.3f} Hz{offers}"
        )
    return found


def _ask_period(node: Node, wanted_ns: int) -> int | None:
    seconds = Fraction(wanted_ns, 10**9).limit_denominator(1_000_000)
    parameters = ioctls.StreamParm(type=ioctls.BUF_TYPE_CAPTURE)
    parameters.timeperframe.numerator = seconds.numerator
    parameters.timeperframe.denominator = seconds.denominator
    try:
        node.call(ioctls.S_PARM, parameters)
    except OSError as error:
        if error.errno not in (errno.ENOTTY, errno.EINVAL):
            raise DeviceError(f"{node.path}: its rate cannot be set: {said(error)}") from error
        return period_ns(node)
    return _fraction_ns(parameters)


def _rates(node: Node) -> list[str]:
    pix = present_format(node)
    rates: list[str] = []
    for index in range(_MOST):
        each = ioctls.FrameInterval(
            index=index, pixel_format=pix.pixelformat, width=pix.width, height=pix.height
        )
        try:
            node.call(ioctls.ENUM_FRAMEINTERVALS, each)
        except OSError:
            break
        if each.shortest.numerator:
            rates.append(f"{each.shortest.denominator / each.shortest.numerator:g}")
        if each.type != 1:  # stepwise or continuous: from the shortest to the longest
            if each.longest.numerator:
                rates.append(f"down to {each.longest.denominator / each.longest.numerator:g}")
            break
    return rates


def _fraction_ns(parameters: ioctls.StreamParm) -> int | None:
    fraction = parameters.timeperframe
    if not fraction.numerator or not fraction.denominator:
        return None
    return round(Fraction(int(fraction.numerator), int(fraction.denominator)) * 10**9)


def _format_call(node: Node, request: int, asked: ioctls.Format, doing: str) -> ioctls.PixFormat:
    try:
        node.call(request, asked)
    except OSError as error:
        why = said(error)
        if request == ioctls.S_FMT and error.errno == errno.EBUSY:
            why = "it is streaming, here or in another program; stop it first"
        raise DeviceError(f"{node.path}: {doing}: {why}") from error
    return ioctls.PixFormat.from_buffer_copy(asked.fmt.pix)
