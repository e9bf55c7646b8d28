"""The photometric stage: takes of white, of a flat field, of darkness in; photometric.json out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from capture.arrays import Floats, Ints
from capture.camera import CameraArray
from capture.errors import InputError, SettingsError, SolveError, TakeError, raise_all
from capture.product import is_current, stage_record, write_record
from capture.progress import Progress, silent
from capture.take import Take
from recon.board.corner_cache import CornerCache
from recon.board.corners import CornerLimits
from recon.board.diagnosis import explain_blind, merged_words
from recon.board.sightings import observe_board
from recon.calibration.board_places import place_boards
from recon.photometry.flat_samples import DarkLevel, FlatReadings, dark_levels, sample_flats
from recon.photometry.light_samples import joined
from recon.photometry.model import (
    RANGES,
    DevicePhotometry,
    PhotometricModel,
    read_photometry,
    write_photometry,
)
from recon.photometry.solve import FitOptions, PhotometricFit, solve_photometry
from recon.photometry.sources import (
    LightSources,
    PhotometricSettings,
    check_sources,
    source_hashes,
)
from recon.photometry.white_samples import SampleLimits, WhiteReadings, sample_whites
from recon.photometry.words import Evidence, coverage_refusals, photometric_warnings

_CELLS = 8  # of the coverage, along the longer side
_MISS_PX = 2.0  # a board further off than this was not seen by the camera that is claimed
_MANY = 0.2  # share of a device's views that are off by so much, from which it is told


@dataclass(frozen=True, eq=False)
class _Seen:
    """All readings of one calibration; what is odd in the board's images, and of its places."""

    white: WhiteReadings | None
    flat: FlatReadings | None
    black: dict[str, DarkLevel]
    odd: tuple[str, ...] = ()
    displaced: tuple[str, ...] = ()


def calibrate_photometry(
    sources: LightSources,
    settings: PhotometricSettings,
    out: Path,
    *,
    progress: Progress = silent,
) -> PhotometricModel:
    """Measure black level, gain and falloff of every device, and write photometric.json.

    Args:
        sources: the takes.
        settings: of the stage.
        out: the file; its record stands beside it.
        progress: told after each frame read.

    Returns:
        The devices, in the order of the board take, or else of the flat field take.

    Raises:
        InputError: when sources or settings do not fit together, listing every device concerned.
        TakeError: naming devices that saw too little light, and where in their images.
        SolveError: when no answer is found.
    """
    out = Path(out)
    record = stage_record("photometric", settings, source_hashes(sources))
    if is_current(out, record):
        return read_photometry(out)
    check_sources(sources, settings)
    names = sources.first.device_names
    black: dict[str, DarkLevel] = {}
    if sources.dark is not None:
        black = dark_levels(sources.dark, names, progress=progress)
    seen = _read(sources, settings, black, progress)
    parts = [part.samples for part in (seen.white, seen.flat) if part is not None]
    samples = joined(parts)
    _check_counts(samples.counts(), seen, names, settings)
    fit = solve_photometry(samples, _options(sources, settings))
    if not fit.converged:
        raise SolveError("photometric solve: the steps did not settle; is every light steady?")
    model = _model(sources, settings, seen, fit)
    raise_all("light tells too little", coverage_refusals(model), TakeError)
    write_photometry(out, model, _report(sources, seen, fit, model))
    write_record(out, record)
    return read_photometry(out)  # as a second run finds them


def _read(
    sources: LightSources,
    settings: PhotometricSettings,
    black: dict[str, DarkLevel],
    progress: Progress,
) -> _Seen:
    names = sources.first.device_names
    levels = np.array([_black(sources, settings, black, name) for name in names])
    white = flat = None
    odd: tuple[str, ...] = ()
    displaced: tuple[str, ...] = ()
    if sources.board_take is not None:
        white, odd, displaced = _read_board(sources, settings, levels, progress)
    if sources.flat is not None:
        flat = sample_flats(
            sources.flat, names, black=levels, same_light=settings.same_light,
            slope=settings.flat_slope, progress=progress,
        )  # fmt: skip
    return _Seen(white, flat, black, odd, displaced)


def _read_board(
    sources: LightSources, settings: PhotometricSettings, levels: Floats, progress: Progress
) -> tuple[WhiteReadings, tuple[str, ...], tuple[str, ...]]:
    """The readings, what is odd in the images, and which devices are off their cameras at times."""
    take, board, array = sources.board_take, sources.board, sources.cameras
    if take is None or board is None or array is None:
        raise InputError("a board take needs its board and cameras")
    unplaced = [face.name for face in board.faces if face.body_from_board is None]
    if unplaced:
        raise SettingsError(
            f"boards {', '.join(unplaced)}: their place on the body is not known; give "
            "body_from_board, or a file without them"
        )
    cameras = CameraArray(tuple(array.by_name(name) for name in take.device_names))
    limits = CornerLimits(max_poses=settings.max_poses)
    cache = CornerCache(take, board)
    found = observe_board(take, board, limits, cache=cache, progress=progress)
    observations = found.observations
    odd = merged_words(explain_blind(take, board, found), len(take.device_names))
    if not len(observations):
        raise_all(f"{take.folder}: no device sees this board", odd or ["no usable view"], TakeError)
    places = place_boards(observations, board.shape(), cameras)
    misses: list[list[float]] = [[] for _ in cameras]
    views = []
    for place in places:
        for device, miss in place.miss_px.items():
            misses[device].append(miss)
        good = [cameras[d].name for d, miss in sorted(place.miss_px.items()) if miss <= _MISS_PX]
        views.append((place.frame, place.world_from_board, good))
    problems = [
        f"{camera.name}: the board is {np.median(miss):.3g} px from where its camera expects it in "
        f"{len(miss)} views; calibrate the array again, or give the cameras of this take"
        for camera, miss in zip(cameras, misses, strict=True)
        if miss and min(miss) > _MISS_PX
    ]
    raise_all(str(take.folder), problems, TakeError)
    wanted = SampleLimits(edge_px=settings.edge_px, max_tilt_deg=settings.max_tilt_deg)
    readings = sample_whites(
        take, board, cameras, views, black=levels, limits=wanted, progress=progress
    )
    return readings, tuple(odd), tuple(_displaced(cameras.names, misses))


def _displaced(names: tuple[str, ...], misses: list[list[float]]) -> list[str]:
    """Devices of whose views many were not read, the board lying elsewhere in them."""
    off = [sum(miss > _MISS_PX for miss in mine) for mine in misses]
    return [
        f"{name}: in {count} of {len(mine)} views the board is more than {_MISS_PX:g} px from "
        "where its camera expects it, and was not read: has it moved since it was calibrated?"
        for name, mine, count in zip(names, misses, off, strict=True)
        if count > _MANY * len(mine)
    ]


def _check_counts(
    counts: Ints, seen: _Seen, names: tuple[str, ...], settings: PhotometricSettings
) -> None:
    problems = []
    for index, (name, count) in enumerate(zip(names, counts.tolist(), strict=True)):
        if count >= settings.least_samples:
            continue
        told = []
        if seen.white is not None:
            told += [f"{n[index]} places of white {why}" for why, n in seen.white.left_out.items()]
        if seen.flat is not None:
            told += [
                f"{100 * seen.flat.clipped[index]:.0f} % of its flat field clipped",
                f"{100 * seen.flat.dark[index]:.0f} % too dark",
            ]
        problems.append(
            f"{name}: {count} readings of light ({', '.join(told)}); at least "
            f"{settings.least_samples} are needed: hold the board nearer and fill the image, "
            "with light and exposure that keep white below clipping"
        )
    if problems:
        problems += [*seen.odd, *seen.displaced]
    raise_all("devices saw too little light", problems, TakeError)


def _options(sources: LightSources, settings: PhotometricSettings) -> FitOptions:
    take = sources.first
    centres = (np.array([take.size(n) for n in take.device_names], dtype=np.float64) - 1.0) / 2.0
    if settings.centre == "axis" and sources.cameras is not None:
        cameras = [sources.cameras.by_name(name) for name in take.device_names]
        centres = np.array([[camera.cx, camera.cy] for camera in cameras])
    return FitOptions(
        centres=centres, terms=settings.terms, free_centres=settings.centre == "free",
        outlier_sigmas=settings.outlier_sigmas,
    )  # fmt: skip


def _range(take: Take, name: str) -> int:
    layouts = {entry.name: entry.layout for entry in take.manifest.devices}
    return RANGES[layouts[name].dtype]


def _black(
    sources: LightSources,
    settings: PhotometricSettings,
    black: dict[str, DarkLevel],
    name: str,
) -> float:
    """The black level of a device as a part of its range."""
    level = black[name].black_dn if name in black else settings.black_dn
    top = _range(sources.first, name)
    if not level < top:
        raise SettingsError(f"photometric.black_dn = {level:g}: {name} shows at most {top}")
    return level / top


def _model(
    sources: LightSources, settings: PhotometricSettings, seen: _Seen, fit: PhotometricFit
) -> PhotometricModel:
    devices, problems = [], []
    for index in range(len(fit.samples.device_names)):
        try:
            devices.append(_device(sources, settings, seen, fit, index))
        except InputError as error:
            problems.append(
                f"{error}; is the black level right, was the light even, and was white seen in "
                "all of the image?"
            )
    raise_all("light that no lens passes", problems, TakeError)
    return PhotometricModel(tuple(devices))


def _device(
    sources: LightSources,
    settings: PhotometricSettings,
    seen: _Seen,
    fit: PhotometricFit,
    index: int,
) -> DevicePhotometry:
    name = fit.samples.device_names[index]
    width, height = fit.samples.sizes[index]
    mine = fit.kept & (fit.samples.device == index)
    longer = max(width, height)
    shape = (max(1, round(_CELLS * height / longer)), max(1, round(_CELLS * width / longer)))
    cell = ((fit.samples.pixels[mine] + 0.5) / [width, height] * shape[::-1]).astype(int)
    coverage = np.zeros(shape, dtype=np.int64)
    np.add.at(coverage, tuple(np.clip(cell, 0, np.array(shape[::-1]) - 1).T[::-1]), 1)
    top = _range(sources.first, name)
    return DevicePhotometry(
        name=name, width=width, height=height, range_dn=top,
        black_dn=top * _black(sources, settings, seen.black, name),
        gain=float(np.exp(fit.log_gains[index])), gain_sigma=float(fit.gain_sigma[index]),
        centre_px=fit.centres[index], coefficients=fit.coefficients[index],
        covariance=fit.covariance[index],
        residual=float(np.sqrt(np.mean(fit.residuals[mine] ** 2))) if mine.any() else 0.0,
        samples=int(mine.sum()), coverage=coverage,
    )  # fmt: skip


def _report(
    sources: LightSources, seen: _Seen, fit: PhotometricFit, model: PhotometricModel
) -> dict[str, Any]:
    """What is said beside the model: sources, evidence, warnings; NaN becomes null."""
    count = len(model)
    offered = fit.samples.counts()
    used = np.array([device.samples for device in model])
    nothing = np.full(count, np.nan)
    clipped, darkest = np.zeros(count), np.full(count, np.inf)
    if seen.white is not None:
        lost = seen.white.left_out["clipped"]
        clipped = np.maximum(clipped, lost / np.maximum(lost + seen.white.samples.counts(), 1))
        darkest = np.minimum(darkest, seen.white.darkest)
    if seen.flat is not None:
        clipped = np.maximum(clipped, seen.flat.clipped)
        darkest = np.minimum(darkest, seen.flat.darkest)
    evidence = Evidence(
        readings=offered, dropped=1.0 - used / np.maximum(offered, 1), clipped=clipped,
        ink_ratio=nothing if seen.white is None else seen.white.ink_ratio,
        exposure_slope=nothing if seen.flat is None else seen.flat.exposure_slope,
        darkest=darkest,
    )  # fmt: skip
    warnings = [
        f"{name}: {100 * level.at_zero:.0f} % of its dark frames are 0, so its black level lies "
        "below what it can show; raise the device's own black level"
        for name, level in seen.black.items()
        if level.held_back
    ]
    warnings += [
        f"{name}: its dark frames vary by {level.spread_dn:.2g} over the image: light leaks in; "
        "cap the lens tightly"
        for name, level in seen.black.items()
        if level.uneven
    ]
    warnings += [*seen.odd, *seen.displaced, *photometric_warnings(model, evidence)]
    black = "dark take" if seen.black else "settings"
    return {
        "sources": {
            key: None if take is None else take.name
            for key, take in (
                ("flat", sources.flat), ("board_take", sources.board_take), ("dark", sources.dark)
            )
        },
        "black": black,
        "gains_known": fit.gains_known,
        "readings": int(offered.sum()),
        "lights": len(fit.levels),
        "residual_over_expected": fit.scale,
        "warnings": warnings,
        "devices": [
            {
                "name": device.name,
                "dropped": float(evidence.dropped[index]),
                "clipped": float(evidence.clipped[index]),
                "ink_ratio": _or_null(evidence.ink_ratio[index]),
                "exposure_slope": _or_null(evidence.exposure_slope[index]),
            }
            for index, device in enumerate(model)
        ],
    }  # fmt: skip


def _or_null(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
