"""`likeness import`: a visiting take, or images with a COLMAP model, becomes a take of ours.

::

    SRC/cameras.json           optional; then devices and sizes come from the folders
    SRC/<camera>/0000.png ...  8- or 16-bit, mono or colour
    SRC/neutral.obj            optional

    SRC/images/<camera>/0000.png ... or SRC/images/<camera>.png
    SRC/sparse/0/cameras.bin ...     or SRC/sparse/, or .txt
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from capture.camera_file import write_cameras
from capture.errors import TakeError
from capture.frame_header import FrameHeader
from capture.ledger import all_present, write_ledger
from capture.manifest import DeviceEntry, TakeManifest
from capture.product import record_path, replacing, stage_record, write_record
from capture.progress import Progress, silent
from capture.take import MANIFEST, Take
from capture.take_writer import TakeWriter
from recon.png import decode_png
from recon.survey import Visit, survey


def import_take(source: Path, out: Path, *, progress: Progress = silent) -> Take:
    """Bring a visiting take in, frames lossless.

    All of the source is checked before anything is written. An import of the same files that stands
    there already is left as it is, products and later calibration included.

    Args:
        source: the visiting take, or images with a COLMAP model.
        out: the take folder to make.
        progress: told after each device is checked and each frame set is written.

    Raises:
        TakeError: listing all that does not fit, or saying what stands in the way.
    """
    source, out = Path(source), Path(out)
    _check_place(source, out)
    visit = survey(source, progress=progress)
    record = stage_record("import", None, visit.hashes)
    if (out / MANIFEST).is_file():
        if _inputs_of(out) == record["inputs"]:
            return Take.open(out)
        raise TakeError(
            f"{out}: holds a take made from other files; remove it, or give another --out"
        )
    with replacing(out) as partial:
        _write(visit, out.name, partial, progress)
        write_record(partial / MANIFEST, record)
    return Take.open(out)


def _check_place(source: Path, out: Path) -> None:
    here, there = source.resolve(), out.resolve()
    if here == there or here in there.parents or there in here.parents:
        raise TakeError(f"{out}: the new take and its source {source} must not lie in one another")
    if (source / MANIFEST).is_file():
        raise TakeError(f"{source}: is a take already; use it as it is")
    if not out.exists() or (out / MANIFEST).is_file():
        return
    if not out.is_dir() or any(out.iterdir()):
        raise TakeError(f"{out}: exists and is not a take; give another --out")


def _inputs_of(out: Path) -> object:
    try:
        found = json.loads(record_path(out / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    return found.get("inputs") if isinstance(found, dict) else None


def _write(visit: Visit, name: str, folder: Path, progress: Progress) -> None:
    count = len(visit.devices[0].files)
    with TakeWriter(folder, {device.name: device.layout for device in visit.devices}) as writer:
        for frame in range(count):
            for device in visit.devices:
                path = device.files[frame]
                image = decode_png(path.read_bytes(), path)
                writer.write(device.name, FrameHeader(frame, frame_id=frame), image)
            progress(frame + 1, count, "import")

        def describe(devices: tuple[DeviceEntry, ...]) -> TakeManifest:
            return TakeManifest(
                name=name,
                kind="import",
                devices=devices,
                frame_count=count,
                remarks={"first_source_number": visit.first_number},
            )

        manifest = writer.finish(describe)
    names = [device.name for device in manifest.devices]
    write_ledger(folder / "ledger.csv", all_present(names, count))
    if visit.cameras_file is not None:
        shutil.copyfile(visit.cameras_file, folder / "cameras.json")
    elif visit.cameras is not None:
        write_cameras(folder / "cameras.json", visit.cameras)
    if visit.neutral is not None:
        shutil.copyfile(visit.neutral, folder / "neutral.obj")
