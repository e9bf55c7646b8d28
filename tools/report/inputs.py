"""What a report is made of: takes, a calibration, a rig, timings, errors; all of it optional."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.parse import quote

from capture.arrays import Floats
from capture.camera import CameraArray
from capture.documents import read_json
from capture.errors import InputError
from capture.take import Take
from recon.mesh import Mesh, read_obj
from rig.face_rig import FaceRig, read_rig
from rig.template import Template, read_template
from track.performance import Performance, read_performance
from track.quality import TrackQuality, read_quality


@dataclass(frozen=True, eq=False, kw_only=True)
class TakeErrors:
    """Errors of a simulated take against its truth; whoever knows the truth fills them in.

    Attributes:
        track_mm: (F, V) distance of each tracked vertex from the truth, NaN where untold; or None.
        scan_mm: by frame, (N,) distance of each vertex of the scan from the true surface.
    """

    track_mm: Floats | None = None
    scan_mm: Mapping[int, Floats] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class ScanFile:
    """One reconstructed frame: its mesh file, and what the reconstruction says of itself."""

    frame: int
    path: Path
    report: Mapping[str, Any]


@dataclass(frozen=True, eq=False, kw_only=True)
class TakeInputs:
    """A take and what stages made of it, found in its folder.

    Attributes:
        folder: the take.
        errors: against the truth, when it is simulated.
    """

    folder: Path
    errors: TakeErrors | None = None

    @cached_property
    def take(self) -> Take:
        """The take on disk."""
        return Take.open(self.folder)

    @cached_property
    def cameras(self) -> CameraArray | None:
        """Its cameras, or None before calibration."""
        return self.take.cameras() if self.take.has_cameras else None

    @cached_property
    def neutral(self) -> Mesh | None:
        """Its neutral, or None."""
        path = self.folder / "neutral.obj"
        return read_obj(path) if path.is_file() else None

    @cached_property
    def scans(self) -> list[ScanFile]:
        """Its reconstructed frames, in order."""
        found = []
        for path in sorted((self.take.products / "recon").glob("frame_*.ply")):
            number = re.fullmatch(r"frame_(\d+)", path.stem)
            if number:
                report = json_object(path.with_suffix(".json"))
                found.append(ScanFile(frame=int(number.group(1)), path=path, report=report))
        return found

    @cached_property
    def performance(self) -> Performance | None:
        """What tracking made, or None."""
        path = self.take.products / "track" / "performance.npz"
        return read_performance(path) if path.is_file() else None

    @cached_property
    def quality(self) -> TrackQuality | None:
        """The quality of what tracking made, or None where it told none."""
        path = self.take.products / "track" / "quality.npz"
        return read_quality(path) if path.is_file() else None

    @cached_property
    def track_report(self) -> Mapping[str, Any]:
        """What tracking says of itself; empty when it says nothing."""
        return json_object(self.take.products / "track" / "report.json")

    @cached_property
    def records(self) -> dict[str, Mapping[str, Any]]:
        """By product, the record of how it was made; of many alike, the first."""
        out: dict[str, Mapping[str, Any]] = {}
        for path in sorted(self.take.products.glob("*/*.record.json")):
            stage = path.parent.name
            if stage not in out:
                out[stage] = json_object(path)
        return out


@dataclass(frozen=True, eq=False, kw_only=True)
class ReportInputs:
    """What to report on. Whatever is left out is left out of the page.

    Attributes:
        title: of the page: the session's or the take's name.
        takes: in the order shown.
        calibration: report.json of a calibration, or a cameras.json that holds a "report".
        told: the calibration's report itself, instead of its file.
        cameras: the array, when no take has it.
        rig: the folder that `solve_rig` wrote: rig.npz, report.json.
        template: template.npz, to show its shapes beside the actor's.
        timings: seconds by stage, in the order run.
        settings: by stage, whatever settings are worth printing.
        out: the page to be written, from which links start; without it there are none.
    """

    title: str
    takes: tuple[TakeInputs, ...] = ()
    calibration: Path | None = None
    told: Mapping[str, Any] = field(default_factory=dict)
    cameras: CameraArray | None = None
    rig: Path | None = None
    template: Path | None = None
    timings: Mapping[str, float] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    out: Path | None = None

    def address(self, page: Path) -> str:
        """Where another page is, seen from `out`; empty when it is not there."""
        if self.out is None or not page.is_file():
            return ""
        steps = os.path.relpath(page.resolve(), self.out.resolve().parent)
        return quote(Path(steps).as_posix())

    @cached_property
    def array(self) -> CameraArray | None:
        """The camera array: that given, or the first take's that has one."""
        if self.cameras is not None:
            return self.cameras
        return next((take.cameras for take in self.takes if take.cameras is not None), None)

    @cached_property
    def calibration_report(self) -> Mapping[str, Any]:
        """What the calibration says of itself; empty when there is none."""
        if self.calibration is None:
            return self.told
        document = json_object(self.calibration)
        if "cameras" not in document:
            return document
        inner = document.get("report")  # a cameras.json may say nothing of how it came to be
        if not isinstance(inner, dict):
            return {}
        full = json_object(self.calibration.with_name("report.json"))
        shared = [key for key in inner if key in full and key not in ("devices", "warnings")]
        same = bool(shared) and all(full[key] == inner[key] for key in shared)
        return full if same else inner  # the whole report has the long lists too

    @cached_property
    def face_rig(self) -> FaceRig | None:
        """The solved rig, or None."""
        path = None if self.rig is None else self.rig / "rig.npz"
        return read_rig(path) if path is not None and path.is_file() else None

    @cached_property
    def rig_report(self) -> Mapping[str, Any]:
        """What the rig solver says of itself; empty when it says nothing."""
        return {} if self.rig is None else json_object(self.rig / "report.json")

    @cached_property
    def artist(self) -> Template | None:
        """The template the rig was made from, or None."""
        return None if self.template is None else read_template(self.template)


def scan_page(take: Take) -> Path:
    """Where the page of a take's scans is, if `likeness recon` has made them."""
    return take.products / "recon" / "report.html"


def json_object(path: Path) -> dict[str, Any]:
    """The JSON object in a file; empty when there is no such file.

    Raises:
        InputError: when the file is there and is not a JSON object.
    """
    if not path.is_file():
        return {}
    document = read_json(path)
    if not isinstance(document, dict):
        raise InputError(f"{path}: expected a JSON object, found {type(document).__name__}")
    return document
