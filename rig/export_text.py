"""Text formats: weights as Live Link style CSV, shapes and performances as OBJ files."""

from __future__ import annotations

import csv
from fractions import Fraction
from pathlib import Path

import numpy as np

from capture.arrays import Floats
from capture.errors import InputError
from capture.product import replacing
from recon.mesh import Mesh, write_obj
from rig.exchange import single
from rig.face_rig import FaceRig
from rig.weight_table import WeightTable
from track.performance import Performance

_LEAD = ("Timecode", "BlendShapeCount")


def write_weights_csv(path: Path, track: WeightTable, fps: float) -> None:
    """Write weights as rows of `Timecode, BlendShapeCount, <names>`, names and order kept.

    The time code is `HH:MM:SS:FF.mmm` with frames of `fps` and thousandths of a frame, counted from
    the first frame; time stamps in nanoseconds are used when the track has them, else the frame
    number. Weights are written with as many digits as bring back the same float32.

    Args:
        path: the file to write or replace.
        track: weights (F, B).
        fps: frames per second.

    References:
        The layout of the Live Link Face app's CSV recordings.
    """
    with replacing(path) as partial, partial.open("w", newline="", encoding="utf-8") as handle:
        writer = csv.writer(handle, lineterminator="\n")
        writer.writerow([*_LEAD, *track.names])
        for frame, row in enumerate(track.weights.astype(np.float32)):
            if track.t_ns is None:
                frames = Fraction(frame)
            else:
                elapsed_ns = int(track.t_ns[frame]) - int(track.t_ns[0])
                frames = Fraction(elapsed_ns, 1_000_000_000) * Fraction(fps)
            cells = [_short(float(value)) for value in row]
            writer.writerow([_timecode(frames, fps), len(track.names), *cells])


def read_weights_csv(path: Path) -> WeightTable:
    """Read weights from a Live Link style CSV; time codes are left alone.

    Raises:
        InputError: naming the file, the line and what does not fit.
    """
    try:
        with Path(path).open(newline="", encoding="utf-8-sig") as handle:
            rows = [row for row in csv.reader(handle) if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: not readable as CSV: {error}") from error
    if not rows or tuple(cell.strip() for cell in rows[0][:2]) != _LEAD:
        raise InputError(f"{path}: expected a first line that begins with {', '.join(_LEAD)}")
    names = tuple(cell.strip() for cell in rows[0][2:])
    weights: Floats = np.zeros((len(rows) - 1, len(names)))
    for number, row in enumerate(rows[1:], start=2):
        if len(row) != len(names) + 2:
            raise InputError(f"{path}:{number}: expected {len(names) + 2} cells, found {len(row)}")
        try:
            weights[number - 2] = [float(cell) for cell in row[2:]]
        except ValueError as error:
            raise InputError(f"{path}:{number}: expected numbers: {error}") from error
    return WeightTable(weights=weights, names=names)


def write_rig_obj(path: Path, rig: FaceRig) -> list[Path]:
    """Write the neutral as `path`, and every shape as `<stem>_shapes/<name>.obj` beside it.

    Returns:
        The file and the folder.

    Raises:
        InputError: when two shape names would be one file name.
    """
    plain = {
        name: "".join(c if c.isalnum() or c in "-_." else "_" for c in name) for name in rig.names
    }
    if len({name.lower() for name in plain.values()}) != len(plain):
        raise InputError(
            f"{path}: shape names must stay different as file names; "
            f"export to .usdc, .glb or .npz instead"
        )
    neutral = single(rig.neutral)
    shapes = path.with_name(f"{path.stem}_shapes")
    with replacing(shapes) as folder:
        folder.mkdir()
        for name, delta in zip(rig.names, rig.deltas, strict=True):
            shape = (neutral + single(delta)).astype(np.float64)
            write_obj(folder / f"{plain[name]}.obj", Mesh(shape, rig.polygons))
    write_obj(path, Mesh(neutral.astype(np.float64), rig.polygons))
    return [path, shapes]


def write_performance_obj(path: Path, performance: Performance) -> list[Path]:
    """Write a sequence of meshes, `<stem>.0000.obj` and so on, numbered as the take's frames.

    Returns:
        The files, in order.
    """
    files = []
    for frame, vertices in zip(performance.frames, performance.vertices, strict=True):
        mesh = Mesh(vertices.astype(np.float64), performance.polygons)
        files.append(path.with_name(f"{path.stem}.{int(frame):04d}.obj"))
        write_obj(files[-1], mesh)
    return files


def _short(value: float) -> str:
    return f"{value:.9g}"


def _timecode(frames: Fraction, fps: float) -> str:
    rate = max(1, round(fps))
    thousandths = round(frames * 1000)
    whole, part = divmod(thousandths, 1000)
    seconds, frame = divmod(whole, rate)
    minutes, second = divmod(seconds, 60)
    hour, minute = divmod(minutes, 60)
    return f"{hour:02d}:{minute:02d}:{second:02d}:{frame:02d}.{part:03d}"
