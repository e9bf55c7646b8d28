"""What every device was set to, beside the take it recorded.

::

    TAKE/features/<device>.json   every setting and its value, and what could not be read
    TAKE/features/<sha256>.xml    the device's own description of its settings, once for all alike
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from capture.devices.capabilities import FeatureDump
from capture.documents import write_json
from capture.errors import WorkError
from capture.names import is_plain_name
from capture.product import replacing

_FORMAT = "likeness-features"
_VERSION = 1


def write_features(folder: Path, dumps: Mapping[str, FeatureDump]) -> None:
    """Write the settings of some devices into a take that is not finished yet.

    Args:
        folder: of the take.
        dumps: by device name, all its settings.

    Raises:
        WorkError: when the disk is full or fails.
    """
    try:
        for name, dump in dumps.items():
            (folder / "features").mkdir(exist_ok=True)
            document = {
                "format": _FORMAT,
                "version": _VERSION,
                "device": name,
                "description_sha256": dump.description_sha256,
                "values": dict(dump.values),
                "unread": dict(dump.unread),
            }
            write_json(folder / "features" / f"{name}.json", document)
            if dump.description and is_plain_name(dump.description_sha256):
                path = folder / "features" / f"{dump.description_sha256}.xml"
                with replacing(path) as partial:
                    partial.write_text(dump.description, encoding="utf-8")
    except OSError as error:
        raise WorkError(f"{folder}: features cannot be written: {error.strerror}") from error
