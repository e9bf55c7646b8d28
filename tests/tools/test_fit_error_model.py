"""The fit of the error model: what made the errors is found again; flags are counted; tables."""

from __future__ import annotations

import numpy as np
import pytest

from tools.bench.fit_error_model import (
    Sample,
    fit,
    flag_count,
    main,
    reliability,
    told_mm,
)
from track.error_model import TERMS, ErrorModel, Terms, combined

SHARES = (0.3, 0.2, 0.7, 0.5, 0.0, 0.8, 0.0, 0.0)
TRUE = ErrorModel(shares=SHARES, haste=1.5, spread=0.5)


def _samples(count: int, seed: int, spread: float = 0.5) -> list[Sample]:
    """Frames of 900 vertices, from well measured to lost, whose errors follow `TRUE`."""
    rng = np.random.default_rng(seed)
    out = []
    for frame in range(count):
        level = 0.02 * 40.0 ** rng.uniform()
        own = level * np.exp(rng.normal(0.0, 1.0, (len(TERMS), 900)))
        terms = Terms(mm=own, unsettled_mm=float(level * rng.uniform(0.0, 0.6)))
        error = combined(terms, TRUE) * np.exp(spread * rng.normal(size=900))
        seen = np.ones(900, np.bool_)
        out.append(
            Sample(take=f"t{frame % 3}", frame=frame, terms=terms, error_mm=error, seen=seen)
        )
    return out


def test_the_fit_finds_what_made_the_errors() -> None:
    model = fit(_samples(60, 1))
    assert model.spread == pytest.approx(0.5, rel=0.05)
    assert model.haste == pytest.approx(1.5, rel=0.25)
    found = dict(zip(TERMS, model.shares, strict=True))
    for name, share in zip(TERMS, SHARES, strict=True):
        assert found[name] == pytest.approx(share, rel=0.15, abs=0.08), name


def test_what_is_told_is_found_on_other_frames() -> None:
    model = fit(_samples(60, 1))
    for count, told, _, median, _, _ in reliability(_samples(40, 2), model):
        if count > 400:
            assert median == pytest.approx(told, rel=0.15)
    ratios = [told_mm(s, model) / s.worst_mm for s in _samples(40, 3)]
    assert np.median(ratios) == pytest.approx(1.0, abs=0.1)


def test_flags_are_counted_against_a_millimetre() -> None:
    samples = _samples(80, 4)
    count = flag_count(samples, TRUE, 1.0)
    assert count.bad == sum(s.worst_mm > 1.0 for s in samples)
    assert count.recall > 0.9
    assert count.precision > 0.9
    none = flag_count(samples, TRUE, 1e6)
    assert none.flagged == none.both == 0
    assert none.recall == 0.0
    assert np.isnan(none.precision)


def test_without_takes_the_model_in_use_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    told = capsys.readouterr().out
    assert "motion_around" in told
    assert "held out" not in told
