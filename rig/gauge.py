"""What the data leave open: how large a shape is against its weights, and where rest lies.

`D_k s` with `w_k / s` fits as well as `D_k` with `w_k`, and the neutral plus `c D_k` with `w_k - c`
as well as both without c. The two functions here choose s and c by what is known beforehand.
"""

from __future__ import annotations

import numpy as np

from capture.arrays import Bools, Floats, Ints, check_shape

EXERCISED = 0.2
"""A shape whose weights never pass this may be imitating errors: nothing is learnt of it."""
_ACTIVE = 0.05  # weights above this are activations
_NOTABLE = 0.1  # weights above this tell how often shapes are activated
_MOST_PEAKS = 12  # more activations than this say no more about how far an actor goes
_SOFT = 0.04  # relative error of the largest activation
_WINDOW = 0.06  # width of weights that count as one resting value
_RESTING = 0.4  # share of the frames that must rest there
_FEWEST = 5  # frames that must, however few there are
_BELOW = 0.3  # share of the frames that may lie below
_LARGEST_REST = 0.35  # what is on by more is meant
_SMALLEST = 0.1  # of the template: a shape that shrank further has lost its meaning
_SCALES = np.geomspace(0.25, 4.0, 1201)


def count_peaks(weights: Floats, contiguous: Bools) -> Ints:
    """How often each shape is activated: runs of contiguous frames above rest, (B,).

    Args:
        weights: (F, B).
        contiguous: (F,) whether each frame follows the one before it in the same take.
    """
    check_shape(weights=(weights, "F B"), contiguous=(contiguous, "F"))
    active = weights > _ACTIVE
    before = np.zeros_like(active)
    before[1:] = active[:-1] & contiguous[1:, None]
    peaks: Ints = (active & ~before).sum(axis=0)
    return peaks


def without_gaps(seen: Bools, contiguous: Bools) -> tuple[Ints, Bools]:
    """The frames (n,) that were seen (F,), and which of those go on where the last one was.

    A gap inside a take does not end an activation: contiguity reaches across it.
    """
    check_shape(seen=(seen, "F"), contiguous=(contiguous, "F"))
    breaks = np.cumsum(~contiguous)
    kept = np.flatnonzero(seen)
    linked = np.zeros(len(kept), dtype=bool)
    linked[1:] = breaks[kept[1:]] == breaks[kept[:-1]]
    return kept, linked


def repetition(weights: Floats, contiguous: Bools) -> float:
    """How often, on average, a shape that is activated at all is activated: 0 when none is."""
    peaks = count_peaks(np.where(weights > _NOTABLE, weights, 0.0), contiguous)
    return float(peaks[peaks > 0].mean()) if (peaks > 0).any() else 0.0


def choose_scales(weights: Floats, contiguous: Bools, sizes: Floats, variation: float) -> Floats:
    """Factor s (B,) by which each shape is to grow, its weights being divided by it.

    The posterior mean of s under two beliefs: a shape's size, relative to the template's, is
    log-normal about 1 with deviation `variation`; and an actor who is asked for expressions goes
    anywhere between rest and the full shape, so that n activations, the largest of which is m,
    are n draws from a uniform distribution: likelihood `s^-n` for s >= m. The template alone
    decides for a shape that was hardly exercised, and nearly alone for one activated once.

    Args:
        weights: (F, B) in the present scale; may exceed 1.
        contiguous: (F,) as of `count_peaks`.
        sizes: (B,) the present size of each shape, relative to the template's.
        variation: expected departure of an actor's shape from the template's, as a share.
    """
    check_shape(weights=(weights, "F B"), contiguous=(contiguous, "F"), sizes=(sizes, "B"))
    peaks = np.minimum(count_peaks(weights, contiguous), _MOST_PEAKS)
    largest = weights.max(axis=0, initial=0.0)
    spread = np.log1p(variation)
    scales = np.ones(weights.shape[1])
    for k, (n, m) in enumerate(zip(peaks, largest, strict=True)):
        if n == 0 or m < EXERCISED:
            scales[k] = 1.0 / sizes[k]
            continue
        belief = -0.5 * (np.log(_SCALES * sizes[k]) / spread) ** 2 - n * np.log(_SCALES)
        over = np.maximum(m / _SCALES - 1.0, 0.0) / _SOFT
        belief -= 0.5 * over**2
        mass = np.exp(belief - belief.max())
        scales[k] = max(float((mass * _SCALES).sum() / mass.sum()), m)
    return scales


def resting_weights(weights: Floats) -> Floats:
    """The weight (B,) at which each shape rests: 0, unless many frames agree on another value.

    That value has to be small, and few frames may lie below it: an expression that is held through
    much of a take is no rest.

    Args:
        weights: (F, B).

    Returns:
        c: to be taken off the shape's weights, and `c D_k` added to the neutral.
    """
    check_shape(weights=(weights, "F B"))
    frames = len(weights)
    rest = np.zeros(weights.shape[1])
    for k, column in enumerate(np.sort(weights, axis=0).T if frames else ()):
        ends = np.searchsorted(column, column + _WINDOW, side="right")
        counts = ends - np.arange(frames)
        best = int(np.argmax(counts))
        value = float(np.median(column[best : ends[best]]))
        often = counts[best] >= max(_RESTING * frames, _FEWEST)
        low = best <= _BELOW * frames
        if often and low and column[best] > 0.0 and value <= _LARGEST_REST:
            rest[k] = value
    return rest


def shape_sizes(deltas: Floats, originals: Floats) -> Floats:
    """Size (B,) of each shape (B, V, 3) along the transferred one, at least 0.1."""
    check_shape(deltas=(deltas, "B V 3"), originals=(originals, "B V 3"))
    own = (originals**2).sum(axis=(1, 2))
    sizes: Floats = (deltas * originals).sum(axis=(1, 2)) / np.maximum(own, 1e-300)
    return np.where(sizes > _SMALLEST, sizes, _SMALLEST)
