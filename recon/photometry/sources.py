"""What a photometric calibration is made of: its settings, and the takes that belong together."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import dataclass
from typing import Literal

import numpy as np

from capture.camera import CameraArray
from capture.errors import InputError, SettingsError, raise_all
from capture.settings import check_ranges
from capture.take import Take
from recon.board.body import BoardBody


@dataclass(frozen=True, kw_only=True)
class PhotometricSettings:
    """How light is measured.

    Attributes:
        terms: how many of a1 a2 a3 are solved for; the others are 0.
        centre: where the falloff is centred: at the "image"'s middle, on the "axis" of the lens
            (needs cameras), or "free".
        same_light: whether all devices look at one light in a flat field frame, so that it tells
            their gains as well.
        flat_slope: whether the flat field may be brighter on one side than on the other.
        black_dn: black level of all devices, in the images' numbers; a dark take wins over it.
        edge_px: the board is not read nearer to ink than this, px.
        max_tilt_deg: views of the board flatter than this are left out.
        max_poses: of more board poses, so many are used.
        least_samples: a device with fewer readings is refused.
        outlier_sigmas: readings further off than this many standard deviations are dropped.
    """

    terms: int = 3
    centre: Literal["image", "axis", "free"] = "image"
    same_light: bool = False
    flat_slope: bool = False
    black_dn: float = 0.0
    edge_px: float = 2.5
    max_tilt_deg: float = 60.0
    max_poses: int = 60
    least_samples: int = 80
    outlier_sigmas: float = 4.0

    def __post_init__(self) -> None:
        check_ranges(
            "photometric", self, terms=(1, 3), black_dn=(0.0, 65534.0), edge_px=(0.5, 50.0),
            max_tilt_deg=(10.0, 80.0), max_poses=(2, 10000), least_samples=(10, 1000000),
            outlier_sigmas=(2.0, 100.0),
        )  # fmt: skip
        if self.centre not in ("image", "axis", "free"):
            raise SettingsError(
                f'photometric.centre: "image", "axis" or "free", found {self.centre!r}'
            )


@dataclass(frozen=True, eq=False, kw_only=True)
class LightSources:
    """The takes that tell how devices answer to light; any of them together.

    Attributes:
        flat: every device sees something evenly lit.
        board_take: a board waved before the array; needs `board` and `cameras`.
        board: the board in it.
        cameras: of the array.
        dark: every lens is capped.
    """

    flat: Take | None = None
    board_take: Take | None = None
    board: BoardBody | None = None
    cameras: CameraArray | None = None
    dark: Take | None = None

    def __post_init__(self) -> None:
        if self.flat is None and self.board_take is None:
            raise InputError(
                "photometric calibration needs a flat field take (--flat TAKE), or a board take "
                "(--board-take TAKE --board BOARD.toml --cameras CAMERAS.json), or both"
            )
        if self.board_take is not None and (self.board is None or self.cameras is None):
            raise InputError(
                f"{self.board_take.folder}: reading the white of a board needs the board's file "
                "and the cameras: --board BOARD.toml --cameras CAMERAS.json"
            )

    @property
    def first(self) -> Take:
        """The take whose devices are calibrated: the board take when there is one."""
        take = self.board_take if self.board_take is not None else self.flat
        if take is None:
            raise InputError("photometric calibration: no take")
        return take


def check_sources(sources: LightSources, settings: PhotometricSettings) -> None:
    """Refuse takes and cameras of other devices or sizes, and settings they cannot serve."""
    first = sources.first
    problems = []
    for take in (sources.flat, sources.dark):
        if take is None or take is first:
            continue
        layouts = {entry.name: entry.layout for entry in take.manifest.devices}
        for entry in first.manifest.devices:
            found = layouts.get(entry.name)
            if found is None:
                problems.append(f"{take.folder}: no device {entry.name}")
            elif found != entry.layout:
                problems.append(f"{entry.name}: {entry.layout} in {first.folder}, {found} "
                                f"in {take.folder}")  # fmt: skip
    if sources.cameras is not None:
        for entry in first.manifest.devices:
            if entry.name not in sources.cameras.names:
                problems.append(f"{entry.name}: no camera of that name in the cameras given")
                continue
            camera = sources.cameras.by_name(entry.name)
            if (camera.width, camera.height) != first.size(entry.name):
                problems.append(
                    f"{entry.name}: camera of {camera.width} x {camera.height} px, images of "
                    f"{entry.layout.width} x {entry.layout.height} px"
                )
    raise_all("photometric calibration", problems)
    if settings.centre == "axis" and sources.cameras is None:
        raise SettingsError('photometric.centre = "axis" needs cameras: --cameras CAMERAS.json')
    if settings.centre == "free" and settings.flat_slope and sources.board_take is None:
        raise SettingsError(
            "photometric: a flat field alone cannot tell a slope of the light from a falloff that "
            "is off centre; switch off flat_slope, fix the centre, or add a board take"
        )


def source_hashes(sources: LightSources) -> dict[str, str]:
    """By name of a source, the hash of what it holds."""
    out = {}
    for key in ("flat", "board_take", "dark"):
        take = getattr(sources, key)
        if take is not None:
            out[key] = take.frames_hash()
    if sources.board is not None:
        faces = [
            (
                dataclasses.asdict(face.board),
                None if face.body_from_board is None else face.body_from_board.matrix().tolist(),
            )
            for face in sources.board.faces
        ]
        told = json.dumps(faces, sort_keys=True)
        out["board"] = hashlib.sha256(told.encode()).hexdigest()
    if sources.cameras is not None:
        digest = hashlib.sha256()
        for camera in sources.cameras:
            digest.update(f"{camera.name} {camera.width} {camera.height}".encode())
            place = camera.camera_from_world.matrix()
            for array in (camera.matrix, camera.distortion, place):
                digest.update(np.ascontiguousarray(array).tobytes())
        out["cameras"] = digest.hexdigest()
    return out
