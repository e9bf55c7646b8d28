"""Where Aravis is loaded, and the one seam at which its errors become ours."""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from capture.errors import DeviceError, ExtraError, InputError

_LIBRARY = "libaravis-0.8.so.0"
_SYSTEM = "gir1.2-aravis-0.8 libgirepository1.0-dev libcairo2-dev pkg-config gcc"


class AravisMissingError(ExtraError):
    """Aravis, or what lets Python use it, is not installed."""

    def __init__(self, found: str) -> None:
        InputError.__init__(
            self,
            f"GigE Vision and USB3 Vision devices need Aravis ({found}); install it with: "
            f"sudo apt-get install -y {_SYSTEM} && pip install 'likeness[aravis]'",
        )


@functools.cache
def aravis() -> Any:
    """The library.

    Raises:
        AravisMissingError: naming what is missing and the commands that install it.
    """
    try:
        import gi
    except ImportError as error:
        raise AravisMissingError("PyGObject is not installed") from error
    try:
        gi.require_version("Aravis", "0.8")
        from gi.repository import Aravis
    except (ValueError, ImportError) as error:
        raise AravisMissingError(f"PyGObject is there; {error}") from error
    # Devices with an address of another network answer only when they may do so by broadcast.
    Aravis.set_interface_flags("GigEVision", 1)
    return Aravis


def genicam_xml(device: Any) -> bytes:
    """A device's description of its settings, as it came; empty when it has none.

    The call that PyGObject makes of it takes no notice of the length, and reads on behind the end.
    """
    pointer = ctypes.pythonapi.PyCapsule_GetPointer
    pointer.restype, pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    ask = ctypes.CDLL(_LIBRARY).arv_device_get_genicam_xml
    ask.restype = ctypes.c_void_p
    ask.argtypes = [ctypes.c_void_p, ctypes.POINTER(ctypes.c_size_t)]
    size = ctypes.c_size_t()
    text = ask(pointer(device.__gpointer__, None), ctypes.byref(size))
    return ctypes.string_at(text, size.value) if text else b""


@contextmanager
def translated(name: str, asked: str = "") -> Iterator[None]:
    """Turn errors of Aravis into ours.

    Args:
        name: of the device.
        asked: what was asked of it, for the message.

    Raises:
        DeviceError: naming the device, what was asked and what went wrong.
    """
    library = aravis()
    try:
        yield
    except _gerror() as error:
        what = f"{name}: {asked}: " if asked else f"{name}: "
        raise DeviceError(f"{what}{_words(library, error)}") from error


@functools.cache
def _gerror() -> type[Exception]:
    from gi.repository import GLib

    kind: type[Exception] = GLib.Error
    return kind


def _words(library: Any, error: Any) -> str:
    if error.domain == "arv-device-error-quark":
        codes = library.DeviceError
        if error.code == codes.TIMEOUT:
            return "it did not answer"
        if error.code == codes.PROTOCOL_ERROR_BUSY:
            return "it takes no such command now; stop it, and try again"
        if error.code in (codes.NOT_CONTROLLER, codes.PROTOCOL_ERROR_ACCESS_DENIED):
            return "another program holds it; close that program"
        if error.code == codes.NOT_FOUND:
            return "it is not there; `likeness devices` lists what is"
    return str(error.message)
