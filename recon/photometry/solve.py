"""From brightness readings to the gain and the falloff of every device.

The logarithm of a reading is log gain + log V(pixel) + log light. Readings that share a light tie
the devices together and tell the lens from the light; every light is eliminated, so that what is
left to solve is as small as the array, however many lights there are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from capture.arrays import Bools, Floats, check_shape
from capture.errors import SolveError, TakeError
from recon.photometry.light_samples import LightSamples, half_diagonals
from recon.photometry.model import TERMS

_ABSOLUTE_STEPS, _CAUCHY_STEPS, _PLAIN_STEPS = 12, 40, 30
_ABSOLUTE_FLOOR = 0.3  # standard deviations below which deviations count as squares
_ROBUST_STOP = 1e-6  # largest change of a parameter, all of them about 1: only weights hang on it
_STOP = 1e-9  # of the last solve
_CAUCHY = 2.385  # scale of the loss in standard deviations: 95 % efficient for normal noise
_NORMAL_MAD = 1.4826
_LEAST_SCALE = 1e-6
_COEFFICIENT_SIGMA = 1.0  # weak belief about a1 a2 a3: it only settles what nothing else does
_CENTRE_SIGMA = 0.1  # of a free centre about the given one, half diagonals
_LEAST_FALL = 0.5  # V may shrink by this factor in a step: it must stay above 0


@dataclass(frozen=True, eq=False, kw_only=True)
class FitOptions:
    """What is solved for.

    Attributes:
        centres: (C, 2) centre of each device's falloff, px; where to start when it is free.
        terms: how many of a1 a2 a3 are free, 1 to 3; the others stay 0.
        free_centres: whether the centres are solved for.
        outlier_sigmas: readings further off than this many standard deviations are dropped.
    """

    centres: Floats
    terms: int = TERMS
    free_centres: bool = False
    outlier_sigmas: float = 4.0


@dataclass(frozen=True, eq=False, kw_only=True)
class PhotometricFit:
    """What the readings say of the devices.

    Attributes:
        samples: the readings that say something, those that share their light with others.
        kept: (M,) which of them the last solve used.
        residuals: (M,) logarithm of measured over predicted value.
        levels: (L,) logarithm of each light, in the order of the numbers in `samples.light`.
        log_gains: (C,) of mean 0; all 0 when they are not known.
        gains_known: whether lights shared by devices tie all gains together.
        coefficients: (C, 3) a1 a2 a3.
        centres: (C, 2) px.
        gain_sigma: (C,) standard deviation of the log gains; NaN when they are not known.
        covariance: (C, 3, 3) of the coefficients.
        scale: standard deviation of a residual over what was expected of it.
        converged: whether the steps became small enough.
    """

    samples: LightSamples
    kept: Bools
    residuals: Floats
    levels: Floats
    log_gains: Floats
    gains_known: bool
    coefficients: Floats
    centres: Floats
    gain_sigma: Floats
    covariance: Floats
    scale: float
    converged: bool


def solve_photometry(samples: LightSamples, options: FitOptions) -> PhotometricFit:
    """Solve gains and falloffs from readings of lights, robustly.

    Gauss-Newton steps, each a sparse linear least squares of the logarithms, with Cauchy weights
    until they settle; then what is off is dropped and the rest is solved with plain weights. The
    log gains have mean 0: a common factor belongs to the light.

    Args:
        samples: the readings; those that are alone with their light are left out.
        options: what is free.

    Raises:
        TakeError: naming devices that share no light with the others, or have no readings.
        SolveError: when the steps do not lead to an answer.

    References:
        Goldman, Vignette and exposure calibration and compensation, PAMI 32(12), 2010 (the model);
        Holland and Welsch, Robust regression using iteratively reweighted least squares, 1977;
        Cameron, Gelbach and Miller, Robust inference with multiway clustering, 2011, section 2.1.
    """
    count = len(samples.device_names)
    check_shape(centres=(options.centres, f"{count} 2"))
    used = _telling(samples)
    problem = _Problem(used, options, gains=_tied(used))
    state, standard = _robust(problem)
    keep = _shared(used, standard <= options.outlier_sigmas)
    state, converged = _plain(problem, state, keep)
    final = problem.linearise(state, np.ones(len(used)), keep)
    return problem.answer(state, final, keep, converged)


@dataclass(frozen=True, eq=False)
class _Step:
    """One linear problem with its lights eliminated.

    `change` (P,) solves it; `inverse` (P, P) is the inverse of its matrix under the gauge;
    `residuals` (M,) are those before the change, each light at its best; `spread` (M,) is the share
    of its noise that a residual keeps; `design` (M, P) are the derivatives, of which each light
    explains `nuisance @ taken`; `levels` are the lights.
    """

    change: Floats
    inverse: Floats
    residuals: Floats
    spread: Floats
    design: sparse.csr_matrix
    taken: Floats
    levels: Floats


class _Problem:
    """Unknowns by device: log gain when known, a1 .. ak, and the centre when it is free."""

    def __init__(self, samples: LightSamples, options: FitOptions, *, gains: bool) -> None:
        self.samples, self.options, self.gains = samples, options, gains
        self.count = len(samples.device_names)
        self.block = int(gains) + options.terms + 2 * int(options.free_centres)
        self.size = self.count * self.block
        self.unit = half_diagonals(samples.sizes)
        _, light = np.unique(samples.light, return_inverse=True)
        self.light = light.ravel()
        self.logs = np.log(samples.value)
        self.nuisance = self._lights()

    def _lights(self) -> sparse.csc_matrix:
        """The columns of the lights: a level each, and a slope along both axes where it may be."""
        rows = np.arange(len(self.light))
        lights = int(self.light.max()) + 1
        sloped = np.unique(self.light[self.samples.sloped])
        place = np.full(lights, -1)
        place[sloped] = lights + 2 * np.arange(len(sloped))
        middle = (np.array(self.samples.sizes, dtype=np.float64) - 1.0) / 2.0
        device = self.samples.device
        away = (self.samples.pixels - middle[device]) / self.unit[device, None]
        slope = np.flatnonzero(self.samples.sloped)
        column = np.concatenate([self.light, *(place[self.light[slope]] + k for k in (0, 1))])
        value = np.concatenate([np.ones(len(rows)), *(away[slope, k] for k in (0, 1))])
        return sparse.csc_matrix(
            (value, (np.concatenate([rows, slope, slope]), column)),
            shape=(len(rows), lights + 2 * len(sloped)),
        )

    def parts(self, state: Floats) -> tuple[Floats, Floats, Floats]:
        """Log gains (C,), coefficients (C, 3) and centres (C, 2) px of a state (P,)."""
        table = state.reshape(self.count, self.block)
        first, terms = int(self.gains), self.options.terms
        coefficients = np.zeros((self.count, TERMS))
        coefficients[:, :terms] = table[:, first : first + terms]
        gains = table[:, 0] if self.gains else np.zeros(self.count)
        moved = table[:, first + terms :] if self.options.free_centres else np.zeros((1, 2))
        return gains, coefficients, self.options.centres + moved * self.unit[:, None]

    def falloff(self, state: Floats) -> tuple[Floats, Floats]:
        """V (M,) at each reading and the powers (M, 3) of r^2."""
        _, coefficients, centres = self.parts(state)
        squared = self.samples.radius_squared(centres)
        powers = squared[:, None] ** np.arange(1, TERMS + 1)
        return 1.0 + (powers * coefficients[self.samples.device]).sum(axis=1), powers

    def rows(self, state: Floats) -> tuple[Floats, Floats]:
        """Predicted log values (M,) without the light, and their derivatives (M, block)."""
        gains, coefficients, centres = self.parts(state)
        device, terms = self.samples.device, self.options.terms
        fall, powers = self.falloff(state)
        columns = [np.ones((len(device), 1))] if self.gains else []
        columns.append(powers[:, :terms] / fall[:, None])
        if self.options.free_centres:
            away = (self.samples.pixels - centres[device]) / self.unit[device, None]
            one, two, three = coefficients[device].T
            slope = (one + powers[:, 0] * (2.0 * two + 3.0 * powers[:, 0] * three)) / fall
            columns.append(-2.0 * away * slope[:, None])
        return gains[device] + np.log(fall), np.concatenate(columns, axis=1)

    def prior(self) -> Floats:
        """Inverse variances (P,) of weak beliefs about each unknown."""
        row = [0.0] * int(self.gains) + [_COEFFICIENT_SIGMA**-2] * self.options.terms
        row += [_CENTRE_SIGMA**-2] * (2 * int(self.options.free_centres))
        return np.tile(np.array(row), self.count)

    def linearise(self, state: Floats, weights: Floats, keep: Bools) -> _Step:
        """The linear problem about a state, its readings weighted (M,) on top of their sigmas."""
        predicted, slopes = self.rows(state)
        weight = np.where(keep, weights / self.samples.sigma**2, 0.0)
        column = self.samples.device[:, None] * self.block + np.arange(self.block)
        row = np.repeat(np.arange(len(weight)), self.block)
        design = sparse.csr_matrix(
            (slopes.ravel(), (row, column.ravel())), shape=(len(weight), self.size)
        )
        scaled = sparse.diags(weight) @ self.nuisance
        own = (self.nuisance.T @ scaled).tocsc()
        own = own + sparse.diags((own.diagonal() == 0).astype(np.float64))  # lights without a row
        try:
            solver = splu(own.tocsc())
        except RuntimeError as error:  # what SuperLU says of a singular matrix
            raise SolveError(
                "photometric solve: readings on one line do not tell a slope"
            ) from error
        coupled = (scaled.T @ design).toarray()
        rest = self.logs - predicted
        level = solver.solve(scaled.T @ rest)
        residuals = rest - self.nuisance @ level
        taken = solver.solve(coupled)
        prior = self.prior()
        normal = (design.T @ sparse.diags(weight) @ design).toarray() - coupled.T @ taken
        inverse = self._inverse(normal + np.diag(prior))
        change = inverse @ (design.T @ (weight * residuals) - prior * state)
        share = np.bincount(self.light, weight, minlength=int(self.light.max()) + 1)[self.light]
        spread = np.sqrt(np.maximum(1.0 - weight / np.maximum(share, 1e-300), 0.05))
        return _Step(change, inverse, residuals, spread, design, taken, level)

    def _inverse(self, normal: Floats) -> Floats:
        """Inverse of a normal matrix, the changes of the log gains having mean 0."""
        bordered = normal
        if self.gains:
            gauge = np.zeros(self.size)
            gauge[:: self.block] = float(np.abs(np.diag(normal)).mean())
            wide = np.zeros((self.size + 1, self.size + 1))
            wide[:-1, :-1], wide[-1, :-1], wide[:-1, -1] = normal, gauge, gauge
            bordered = wide
        try:
            inverse = np.asarray(np.linalg.inv(bordered), dtype=np.float64)
        except np.linalg.LinAlgError as error:
            raise SolveError("photometric solve: the readings do not tell the devices") from error
        return inverse[: self.size, : self.size]

    def answer(self, state: Floats, step: _Step, keep: Bools, converged: bool) -> PhotometricFit:
        """The fit with its uncertainty: the larger of independent and of batchwise errors."""
        samples = self.samples
        gains, coefficients, centres = self.parts(state)
        standard = step.residuals / samples.sigma
        lights = len(np.unique(self.light[keep]))
        spare = max(int(keep.sum()) - lights - self.size, 1)
        scale = float(np.sqrt((standard[keep] ** 2).sum() / spare))
        plain = scale**2 * step.inverse
        grouped = step.inverse @ self._batch_scatter(step, keep) @ step.inverse
        gain_sigma = np.full(self.count, np.nan)
        covariance = np.zeros((self.count, TERMS, TERMS))
        first, terms = int(self.gains), self.options.terms
        for device in range(self.count):
            own = slice(device * self.block, (device + 1) * self.block)
            pair = [plain[own, own], grouped[own, own]]
            larger = pair[int(np.trace(pair[1]) > np.trace(pair[0]))]
            if self.gains:
                gain_sigma[device] = np.sqrt(max(float(larger[0, 0]), 0.0))
            inner = slice(first, first + terms)
            covariance[device, :terms, :terms] = larger[inner, inner]
        return PhotometricFit(
            samples=samples, kept=keep, residuals=step.residuals,
            levels=step.levels[: int(self.light.max()) + 1], log_gains=gains,
            gains_known=self.gains, coefficients=coefficients, centres=centres,
            gain_sigma=gain_sigma, covariance=covariance, scale=scale, converged=converged,
        )  # fmt: skip

    def _batch_scatter(self, step: _Step, keep: Bools) -> Floats:
        """Scatter (P, P) of the gradient's share of each batch of readings."""
        _, batch = np.unique(self.samples.batch, return_inverse=True)
        pull = np.where(keep, step.residuals, 0.0) / self.samples.sigma**2
        rows = np.arange(len(pull))
        gather = sparse.csr_matrix((pull, (batch.ravel(), rows)))
        sums = (gather @ step.design).toarray() - (gather @ self.nuisance) @ step.taken
        scatter: Floats = sums.T @ sums
        return scatter


def _robust(problem: _Problem) -> tuple[Floats, Floats]:
    """The robust state (P,), and residuals (M,) in standard deviations.

    Least absolute deviations first, which have one answer wherever they start; then Cauchy's loss,
    to which a reading far off says next to nothing.
    """
    every = np.ones(len(problem.samples), dtype=np.bool_)
    state, weights = np.zeros(problem.size), np.ones(len(every))
    standard, last = weights, np.inf
    for number in range(_ABSOLUTE_STEPS + _CAUCHY_STEPS):
        step = problem.linearise(state, weights, every)
        state, size = _moved(problem, state, step)
        standard = np.abs(step.residuals) / (problem.samples.sigma * step.spread)
        scale = _scale(standard)
        if number < _ABSOLUTE_STEPS:
            weights = 1.0 / np.maximum(standard / scale, _ABSOLUTE_FLOOR)
            continue
        weights = 1.0 / (1.0 + (standard / (_CAUCHY * scale)) ** 2)
        if max(size, last) < _ROBUST_STOP:
            break
        last = size
    return state, standard / _scale(standard)


def _plain(problem: _Problem, state: Floats, keep: Bools) -> tuple[Floats, bool]:
    """Gauss-Newton steps of what is kept, with plain weights, until they are done."""
    weights = np.ones(len(problem.samples))
    size = np.inf
    for _ in range(_PLAIN_STEPS):
        state, size = _moved(problem, state, problem.linearise(state, weights, keep))
        if size < _STOP:
            break
    return state, size < _STOP


def _moved(problem: _Problem, state: Floats, step: _Step) -> tuple[Floats, float]:
    """The state after a step, and the step's largest part."""
    length = _length(problem, state, step.change)
    state = state + length * step.change
    if not np.isfinite(state).all():
        raise SolveError("photometric solve: the steps led to no finite answer")
    return state, float(np.abs(step.change).max())


def _length(problem: _Problem, state: Floats, change: Floats) -> float:
    """The longest of the steps 1, 1/2, 1/4 ... after which V is still well above 0."""
    before, _ = problem.falloff(state)
    length = 1.0
    while length > 1e-6:
        after, _ = problem.falloff(state + length * change)
        if (after > _LEAST_FALL * before).all():
            return length
        length *= 0.5
    raise SolveError("photometric solve: the readings want a falloff that is not above 0")


def _scale(standard: Floats) -> float:
    return max(_NORMAL_MAD * float(np.median(standard)), _LEAST_SCALE)


def _telling(samples: LightSamples) -> LightSamples:
    """The readings whose light is shared with more readings than it has unknowns."""
    used = samples.select(_shared(samples, np.ones(len(samples), dtype=np.bool_)))
    silent = [n for n, k in zip(used.device_names, used.counts(), strict=True) if k == 0]
    if silent:
        raise TakeError(
            f"{', '.join(silent)}: no reading that shares its light with another; "
            "hold the board where this device and others see it"
        )
    return used


def _shared(samples: LightSamples, keep: Bools) -> Bools:
    """Those of the readings to keep (M,) whose light has more of them than it has unknowns."""
    have = np.bincount(samples.light[keep], minlength=int(samples.light.max(initial=0)) + 1)
    return keep & (have[samples.light] > np.where(samples.sloped, 3, 1))


def _tied(samples: LightSamples) -> bool:
    """Whether lights tie the gains of all devices; False when no light is seen by two of them.

    Raises:
        TakeError: when they tie some and not all.
    """
    count = len(samples.device_names)
    lights = int(samples.light.max()) + 1
    link = sparse.coo_matrix(
        (np.ones(len(samples)), (samples.device, count + samples.light)),
        shape=(count + lights, count + lights),
    )
    _, label = connected_components(link, directed=False)
    groups: dict[int, list[str]] = {}
    for name, group in zip(samples.device_names, label[:count].tolist(), strict=True):
        groups.setdefault(group, []).append(name)
    if len(groups) == count and count > 1:
        return False
    if len(groups) > 1:
        parts = sorted(groups.values(), key=len, reverse=True)
        raise TakeError(
            f"{', '.join(name for part in parts[1:] for name in part)}: never saw the same white "
            f"as {', '.join(parts[0])}; hold the board where both see it"
        )
    return count > 1
