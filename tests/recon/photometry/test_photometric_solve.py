"""Gains and falloffs recovered from simulated readings, against a literal slow solve, refusals."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest

from capture.arrays import Floats
from capture.errors import TakeError
from recon.photometry.light_samples import LightSamples, joined
from recon.photometry.solve import FitOptions, PhotometricFit, solve_photometry
from tests.synthetic_light import TrueLight, board_readings, true_light
from tools.bench.board_scene import BoardScene, make_state

SCENE = BoardScene(size_px=1024, focal_px=1500.0, radius_mm=700.0, devices=6, poses=18)
GOAL = 0.005  # of V and of a gain


@cache
def readings(gloss: float, seed: int = 0, off_px: float = 0.0) -> tuple[TrueLight, LightSamples]:
    scene = dataclasses.replace(SCENE, seed=seed)
    cameras = make_state(scene).cameras
    sizes = tuple((camera.width, camera.height) for camera in cameras)
    truth = true_light(sizes, seed, off_centre_px=off_px)
    return truth, board_readings(scene, truth, cameras, gloss=gloss, every=9)


def middles(samples: LightSamples) -> Floats:
    return (np.array(samples.sizes, dtype=float) - 1.0) / 2.0


def found_falloff(fit: PhotometricFit, device: int, pixels: Floats) -> Floats:
    found = TrueLight(
        log_gains=fit.log_gains, coefficients=fit.coefficients, centres=fit.centres,
        black=np.zeros(len(fit.log_gains)), sizes=fit.samples.sizes,
    )  # fmt: skip
    return found.falloff(device, pixels)


def falloff_errors(truth: TrueLight, fit: PhotometricFit) -> list[float]:
    """Largest relative error of V, by device, where the middle 98 % of the readings lie."""
    out = []
    for device in range(len(truth.sizes)):
        pixels = fit.samples.pixels[fit.samples.device == device]
        away = np.linalg.norm(pixels - truth.centres[device], axis=1)
        pixels = pixels[away <= np.percentile(away, 98)]
        error = found_falloff(fit, device, pixels) / truth.falloff(device, pixels) - 1.0
        out.append(float(np.abs(error).max()))
    return out


@pytest.mark.parametrize("gloss", [0.0, 0.25])
def test_the_board_tells_the_lens_from_the_light(gloss: float) -> None:
    truth, samples = readings(gloss)
    fit = solve_photometry(samples, FitOptions(centres=middles(samples)))
    assert fit.gains_known
    assert fit.converged
    assert max(falloff_errors(truth, fit)) < GOAL
    assert np.abs(fit.log_gains - truth.log_gains).max() < GOAL
    assert abs(fit.log_gains.mean()) < 1e-9
    assert abs((1.0 - fit.kept.mean()) - gloss) < 0.06


def test_a_free_centre_is_found() -> None:
    truth, samples = readings(0.1, seed=1, off_px=40.0)
    fit = solve_photometry(samples, FitOptions(centres=middles(samples), free_centres=True))
    assert np.abs(fit.centres - truth.centres).max() < 10.0  # px of 1024
    assert max(falloff_errors(truth, fit)) < GOAL
    fixed = solve_photometry(samples, FitOptions(centres=middles(samples)))
    assert max(falloff_errors(truth, fixed)) > max(falloff_errors(truth, fit))


def test_what_is_predicted_of_the_error_is_its_size() -> None:
    ratios = []
    for seed in range(4):
        truth, samples = readings(0.1, seed)
        fit = solve_photometry(samples, FitOptions(centres=middles(samples)))
        ratios += ((fit.log_gains - truth.log_gains) / fit.gain_sigma).tolist()
        for device, size in enumerate(samples.sizes):
            squared = 0.6 ** (2 * np.arange(1, 4))
            pixel = middles(samples)[device] + [0.6 * 0.5 * np.hypot(*size), 0.0]
            true = truth.falloff(device, pixel[None])
            sigma = np.sqrt(squared @ fit.covariance[device] @ squared)
            ratios.append(float((found_falloff(fit, device, pixel[None]) - true)[0] / sigma))
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.6


def literal(samples: LightSamples, centres: Floats, kept: np.ndarray) -> tuple[Floats, Floats]:
    """Log gains and coefficients by dense Gauss-Newton with every light among the unknowns."""
    count = len(samples.sizes)
    lights = int(samples.light.max()) + 1
    powers = samples.radius_squared(centres)[:, None] ** [1, 2, 3]
    rows = np.arange(len(samples))
    gains, bend = np.zeros(count), np.zeros((count, 3))
    weight = np.where(kept, 1.0 / samples.sigma, 0.0)
    for _ in range(40):
        fall = 1.0 + (powers * bend[samples.device]).sum(axis=1)
        design = np.zeros((len(samples) + 3 * count + 1, 4 * count + lights))
        right = np.zeros(len(design))
        design[rows, samples.device] = weight
        for k in range(3):
            design[rows, count + 3 * samples.device + k] = weight * powers[:, k] / fall
        design[rows, 4 * count + samples.light] = weight
        right[rows] = weight * (np.log(samples.value) - gains[samples.device] - np.log(fall))
        prior = len(samples) + np.arange(3 * count)  # the solver's weak belief
        design[prior, count + np.arange(3 * count)] = 1.0
        right[prior] = -bend.ravel()
        design[-1, :count] = 1e4  # mean log gain 0
        step = np.linalg.lstsq(design, right, rcond=None)[0]
        gains, bend = gains + step[:count], bend + step[count : 4 * count].reshape(count, 3)
        if np.abs(step[: 4 * count]).max() < 1e-12:
            break
    return gains, bend


def test_the_literal_dense_solve_gives_the_same() -> None:
    _, samples = readings(0.1, seed=2)
    samples = samples.select((samples.light % 13 == 0) & (samples.device < 4))
    part = LightSamples(
        device_names=samples.device_names[:4], sizes=samples.sizes[:4], device=samples.device,
        pixels=samples.pixels, value=samples.value, sigma=samples.sigma,
        light=np.unique(samples.light, return_inverse=True)[1].ravel(), batch=samples.batch,
        sloped=samples.sloped,
    )  # fmt: skip
    fit = solve_photometry(part, FitOptions(centres=middles(part)))
    samples = fit.samples
    renumbered = dataclasses.replace(
        samples, light=np.unique(samples.light, return_inverse=True)[1].ravel()
    )
    gains, bend = literal(renumbered, middles(samples), fit.kept)
    np.testing.assert_allclose(fit.log_gains, gains, atol=1e-7)
    np.testing.assert_allclose(fit.coefficients, bend, atol=1e-6)


def flat_readings(
    truth: TrueLight, names: tuple[str, ...], *, shared: bool, slope: float, sloped: bool
) -> LightSamples:
    random = np.random.default_rng(5)
    columns = []
    for frame in range(3):
        for device, (width, height) in enumerate(truth.sizes):
            x, y = np.meshgrid(np.arange(12, width, 25), np.arange(12, height, 25))
            pixels = np.stack([x, y], -1).reshape(-1, 2).astype(float)
            away = (pixels - [width / 2, height / 2]) / (0.5 * np.hypot(width, height))
            brightness = 0.3 + 0.1 * frame if shared else random.uniform(0.3, 0.5)
            value = brightness * truth.falloff(device, pixels) * np.exp(
                truth.log_gains[device] + slope * away @ random.normal(0, 1, 2)
                + random.normal(0, 0.002, len(pixels))
            )  # fmt: skip
            light = frame if shared else frame * len(names) + device
            n = len(pixels)
            columns.append(np.column_stack([
                np.full(n, device), pixels, value, np.full(n, light), 10000 * device + np.arange(n)
            ]))  # fmt: skip
    rows = np.concatenate(columns)
    return LightSamples(
        device_names=names, sizes=truth.sizes, device=rows[:, 0].astype(np.int64),
        pixels=rows[:, 1:3], value=rows[:, 3], sigma=np.full(len(rows), 0.002),
        light=rows[:, 4].astype(np.int64), batch=rows[:, 5].astype(np.int64),
        sloped=np.full(len(rows), sloped),
    )  # fmt: skip


FLAT = true_light(((640, 480), (480, 640), (500, 500)), 3)
NAMES = ("cam00", "cam01", "cam02")


@pytest.mark.parametrize("shared", [False, True])
def test_a_flat_field_tells_gains_only_of_one_light(shared: bool) -> None:
    samples = flat_readings(FLAT, NAMES, shared=shared, slope=0.0, sloped=False)
    fit = solve_photometry(samples, FitOptions(centres=middles(samples)))
    assert fit.gains_known == shared
    assert max(falloff_errors(FLAT, fit)) < GOAL
    if shared:
        assert np.abs(fit.log_gains - FLAT.log_gains).max() < GOAL
    else:
        assert not fit.log_gains.any()
        assert np.isnan(fit.gain_sigma).all()


def test_a_slope_of_the_light_is_separated_when_allowed() -> None:
    samples = flat_readings(FLAT, NAMES, shared=False, slope=0.05, sloped=True)
    fit = solve_photometry(samples, FitOptions(centres=middles(samples)))
    assert max(falloff_errors(FLAT, fit)) < GOAL
    stiff = dataclasses.replace(samples, sloped=np.zeros(len(samples), dtype=np.bool_))
    blind = solve_photometry(stiff, FitOptions(centres=middles(samples)))
    assert blind.scale > 3 * fit.scale


def test_board_and_flat_field_join() -> None:
    truth, board = readings(0.0, seed=4)
    flat = flat_readings(truth, board.device_names, shared=False, slope=0.0, sloped=False)
    fit = solve_photometry(joined([board, flat]), FitOptions(centres=middles(board)))
    alone = solve_photometry(board, FitOptions(centres=middles(board)))
    assert fit.gains_known
    assert max(falloff_errors(truth, fit)) < GOAL
    corner = np.ones(3)  # r = 1
    spread = [np.sqrt(corner @ each @ corner) for each in fit.covariance]
    before = [np.sqrt(corner @ each @ corner) for each in alone.covariance]
    assert max(spread) < 0.5 * max(before)


def test_a_common_factor_of_the_light_changes_nothing() -> None:
    _, samples = readings(0.1)
    options = FitOptions(centres=middles(samples))
    brighter = dataclasses.replace(samples, value=3.0 * samples.value)
    one, other = solve_photometry(samples, options), solve_photometry(brighter, options)
    np.testing.assert_allclose(one.log_gains, other.log_gains, atol=1e-8)
    np.testing.assert_allclose(one.coefficients, other.coefficients, atol=1e-7)


def test_the_same_readings_give_the_same_bytes() -> None:
    _, samples = readings(0.1)
    options = FitOptions(centres=middles(samples))
    one, other = solve_photometry(samples, options), solve_photometry(samples, options)
    assert one.coefficients.tobytes() == other.coefficients.tobytes()
    assert one.covariance.tobytes() == other.covariance.tobytes()


def test_devices_without_a_common_light_are_named() -> None:
    _, samples = readings(0.0)
    apart = samples.select((samples.device < 4) == (samples.batch // 6 % 2 == 0))
    with pytest.raises(TakeError, match="cam04, cam05: never saw the same white as cam00, cam01"):
        solve_photometry(apart, FitOptions(centres=middles(samples)))
    blind = samples.select(samples.device != 2)
    with pytest.raises(TakeError, match="cam02: no reading that shares its light"):
        solve_photometry(blind, FitOptions(centres=middles(samples)))
