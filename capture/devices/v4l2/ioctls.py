"""What the kernel's video interface looks like in memory: structures and request numbers.

Written for kernels of 64 bits, where a time is two words of eight bytes. A request's number holds
the size of its structure, so that a structure of the wrong size is refused by the kernel.

References:
    linux/videodev2.h, and "Video for Linux API" in the kernel's documentation, part I.
"""

from __future__ import annotations

import ctypes
from ctypes import c_char, c_char_p, c_int32, c_int64, c_uint8, c_uint32, c_uint64

BUF_TYPE_CAPTURE = 1
MEMORY_MMAP = 1
FIELD_NONE = 1

CAP_CAPTURE, CAP_CAPTURE_MPLANE = 0x1, 0x1000
CAP_STREAMING, CAP_DEVICE_CAPS = 0x04000000, 0x80000000
PARM_TIMEPERFRAME = 0x1000

FLAG_ERROR = 0x40
FLAG_TIMESTAMP_MASK, FLAG_TIMESTAMP_MONOTONIC = 0xE000, 0x2000
FLAG_SOURCE_MASK, FLAG_SOURCE_START_OF_EXPOSURE = 0x70000, 0x10000

TYPE_INTEGER, TYPE_BOOLEAN, TYPE_MENU, TYPE_BUTTON, TYPE_INTEGER64 = 1, 2, 3, 4, 5
TYPE_CLASS, TYPE_STRING, TYPE_BITMASK, TYPE_INTEGER_MENU = 6, 7, 8, 9
CTRL_DISABLED, CTRL_GRABBED, CTRL_READ_ONLY, CTRL_INACTIVE, CTRL_WRITE_ONLY = (
    0x1,
    0x2,
    0x4,
    0x10,
    0x40,
)
NEXT_CTRL, NEXT_COMPOUND = 0x80000000, 0x40000000


class Capability(ctypes.Structure):
    """What a node is: `struct v4l2_capability`."""

    _fields_ = (
        ("driver", c_char * 16),
        ("card", c_char * 32),
        ("bus_info", c_char * 32),
        ("version", c_uint32),
        ("capabilities", c_uint32),
        ("device_caps", c_uint32),
        ("reserved", c_uint32 * 3),
    )


class FormatDescription(ctypes.Structure):
    """One pixel format on offer: `struct v4l2_fmtdesc`."""

    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("flags", c_uint32),
        ("description", c_char * 32),
        ("pixelformat", c_uint32),
        ("mbus_code", c_uint32),
        ("reserved", c_uint32 * 3),
    )


class PixFormat(ctypes.Structure):
    """Size and pixel format: `struct v4l2_pix_format`."""

    _fields_ = (
        ("width", c_uint32),
        ("height", c_uint32),
        ("pixelformat", c_uint32),
        ("field", c_uint32),
        ("bytesperline", c_uint32),
        ("sizeimage", c_uint32),
        ("colorspace", c_uint32),
        ("priv", c_uint32),
        ("flags", c_uint32),
        ("encoding", c_uint32),
        ("quantization", c_uint32),
        ("transfer", c_uint32),
    )


class _FormatUnion(ctypes.Union):
    # The kernel's union also holds a structure with a pointer, hence its alignment of 8 bytes.
    _fields_ = (("pix", PixFormat), ("raw", c_uint8 * 200), ("align", c_uint64))


class Format(ctypes.Structure):
    """What a node sends: `struct v4l2_format`."""

    _fields_ = (("type", c_uint32), ("fmt", _FormatUnion))


class RequestBuffers(ctypes.Structure):
    """How many buffers: `struct v4l2_requestbuffers`."""

    _fields_ = (
        ("count", c_uint32),
        ("type", c_uint32),
        ("memory", c_uint32),
        ("capabilities", c_uint32),
        ("flags", c_uint8),
        ("reserved", c_uint8 * 3),
    )


class _Timecode(ctypes.Structure):
    _fields_ = (("type", c_uint32), ("flags", c_uint32), ("digits", c_uint8 * 8))


class _Where(ctypes.Union):
    _fields_ = (("offset", c_uint32), ("userptr", c_uint64))


class Buffer(ctypes.Structure):
    """One buffer of the driver's: `struct v4l2_buffer`."""

    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("bytesused", c_uint32),
        ("flags", c_uint32),
        ("field", c_uint32),
        ("seconds", c_int64),
        ("microseconds", c_int64),
        ("timecode", _Timecode),
        ("sequence", c_uint32),
        ("memory", c_uint32),
        ("m", _Where),
        ("length", c_uint32),
        ("reserved2", c_uint32),
        ("request_fd", c_int32),
    )


class _Fraction(ctypes.Structure):
    _fields_ = (("numerator", c_uint32), ("denominator", c_uint32))


class StreamParm(ctypes.Structure):
    """How often a node sends: `struct v4l2_streamparm`, its part for capture."""

    _fields_ = (
        ("type", c_uint32),
        ("capability", c_uint32),
        ("capturemode", c_uint32),
        ("timeperframe", _Fraction),
        ("extendedmode", c_uint32),
        ("readbuffers", c_uint32),
        ("reserved", c_uint8 * 176),
    )


class FrameInterval(ctypes.Structure):
    """One frame interval on offer: `struct v4l2_frmivalenum`; `shortest` to `step` if stepwise."""

    _fields_ = (
        ("index", c_uint32),
        ("pixel_format", c_uint32),
        ("width", c_uint32),
        ("height", c_uint32),
        ("type", c_uint32),
        ("shortest", _Fraction),
        ("longest", _Fraction),
        ("step", _Fraction),
        ("reserved", c_uint32 * 2),
    )


class ControlQuery(ctypes.Structure):
    """What a control is: `struct v4l2_query_ext_ctrl`."""

    _fields_ = (
        ("id", c_uint32),
        ("type", c_uint32),
        ("name", c_char * 32),
        ("minimum", c_int64),
        ("maximum", c_int64),
        ("step", c_uint64),
        ("default_value", c_int64),
        ("flags", c_uint32),
        ("elem_size", c_uint32),
        ("elems", c_uint32),
        ("nr_of_dims", c_uint32),
        ("dims", c_uint32 * 4),
        ("reserved", c_uint32 * 32),
    )


class _MenuUnion(ctypes.Union):
    _pack_ = 1
    _fields_ = (("name", c_char * 32), ("value", c_int64))


class MenuQuery(ctypes.Structure):
    """One entry of a menu: `struct v4l2_querymenu`."""

    _pack_ = 1
    _fields_ = (("id", c_uint32), ("index", c_uint32), ("u", _MenuUnion), ("reserved", c_uint32))


class _ValueUnion(ctypes.Union):
    _pack_ = 1
    _fields_ = (("value", c_int32), ("value64", c_int64), ("string", c_char_p))


class Control(ctypes.Structure):
    """The value of one control: `struct v4l2_ext_control`."""

    _pack_ = 1
    _fields_ = (
        ("id", c_uint32),
        ("size", c_uint32),
        ("reserved2", c_uint32),
        ("u", _ValueUnion),
    )


class Controls(ctypes.Structure):
    """Values of several controls: `struct v4l2_ext_controls`; `which` 0 asks for those in use."""

    _fields_ = (
        ("which", c_uint32),
        ("count", c_uint32),
        ("error_idx", c_uint32),
        ("request_fd", c_int32),
        ("reserved", c_uint32),
        ("controls", ctypes.POINTER(Control)),
    )


def _request(direction: int, number: int, size: int) -> int:
    """A request number of the kernel's: direction 1 write, 2 read, 3 both; letter V."""
    return direction << 30 | size << 16 | ord("V") << 8 | number


QUERYCAP = _request(2, 0, ctypes.sizeof(Capability))
ENUM_FMT = _request(3, 2, ctypes.sizeof(FormatDescription))
G_FMT = _request(3, 4, ctypes.sizeof(Format))
S_FMT = _request(3, 5, ctypes.sizeof(Format))
TRY_FMT = _request(3, 64, ctypes.sizeof(Format))
REQBUFS = _request(3, 8, ctypes.sizeof(RequestBuffers))
QUERYBUF = _request(3, 9, ctypes.sizeof(Buffer))
QBUF = _request(3, 15, ctypes.sizeof(Buffer))
DQBUF = _request(3, 17, ctypes.sizeof(Buffer))
STREAMON = _request(1, 18, ctypes.sizeof(c_int32))
STREAMOFF = _request(1, 19, ctypes.sizeof(c_int32))
G_PARM = _request(3, 21, ctypes.sizeof(StreamParm))
S_PARM = _request(3, 22, ctypes.sizeof(StreamParm))
QUERYMENU = _request(3, 37, ctypes.sizeof(MenuQuery))
G_EXT_CTRLS = _request(3, 71, ctypes.sizeof(Controls))
S_EXT_CTRLS = _request(3, 72, ctypes.sizeof(Controls))
ENUM_FRAMEINTERVALS = _request(3, 75, ctypes.sizeof(FrameInterval))
QUERY_EXT_CTRL = _request(3, 103, ctypes.sizeof(ControlQuery))
