"""The disk's forecast: takes left at the size and retake rate observed so far."""

from __future__ import annotations

from pathlib import Path

import pytest

from capture.disk import DiskUse, bytes_in_words, folder_bytes, forecast, free_bytes
from capture.errors import WorkError

GB = 10**9
TAKE = 150  # triggers


def use(free: float, **more: object) -> DiskUse:
    """Sixteen devices of 4 MP: 67 MB a trigger, 10 GB a take."""
    settings: dict[str, object] = {
        "free_bytes": round(free * GB), "frame_set_bytes": 67_108_864, "next_triggers": TAKE,
        "reserve_bytes": GB,
    }  # fmt: skip
    return DiskUse(**(settings | more))  # type: ignore[arg-type]


@pytest.mark.parametrize(("free", "left"), [(0, 0), (11.0, 0), (11.1, 1), (21.1, 1), (21.2, 2)])
def test_takes_left_before_the_first_take_come_from_the_layouts(free: float, left: int) -> None:
    found = forecast(use(free))
    assert found.take_bytes == 10_066_329_600
    assert found.takes_left == left
    assert (found.colour == "red") == (left == 0)


def test_observed_sizes_replace_the_layouts() -> None:
    found = forecast(use(101, observed=[(TAKE, 5 * GB), (2 * TAKE, 10 * GB)]))
    assert found.take_bytes == 5 * GB
    assert found.takes_left == 20


@pytest.mark.parametrize("retakes", [0, 1, 3])
def test_the_prompts_that_fit_are_those_of_the_plain_sum(retakes: int) -> None:
    coming = [TAKE, TAKE, 5 * TAKE, TAKE]
    for free in range(1, 120, 3):
        found = forecast(
            use(free, observed=[(TAKE, 10 * GB)] * 6, retakes=retakes, coming_triggers=coming)
        )
        rate = retakes / (6 - retakes)
        left, fits = (free - 1) * GB, 0
        for triggers in coming:
            left -= int(triggers * 10 * GB / TAKE * (1 + rate))
            fits += left >= 0
        assert found.prompts_left == fits
        assert found.prompts_coming == 4
        if fits < 4:
            assert found.colour != "green"


def test_what_is_being_written_is_spoken_for() -> None:
    assert forecast(use(21.2)).takes_left == 2
    assert forecast(use(21.2, pending_bytes=10 * GB)).takes_left == 1


def test_the_sentences_say_what_fits() -> None:
    observed = [(TAKE, 10 * GB)] * 4
    assert forecast(use(5)).sentence == (
        "5 GB free: not enough for one take of 10.1 GB beside 1 GB that must stay free. "
        "Free some before you arm."
    )
    assert forecast(use(1000, observed=observed, coming_triggers=[TAKE] * 50)).sentence == (
        "1 TB free: room for 99 takes; the 50 to come need 500 GB."
    )
    assert forecast(
        use(400, observed=observed, retakes=1, coming_triggers=[TAKE] * 50)
    ).sentence == (
        "400 GB free: room for 39 takes; of the 50 to come, with 0.33 retakes each as so far, "
        "only 29 fit. Free some."
    )
    assert forecast(use(501, observed=observed, coming_triggers=[TAKE] * 50)).sentence == (
        "501 GB free: room for 50 takes; the 50 to come barely fit. Free some."
    )
    assert forecast(use(12)).sentence == "12 GB free: room for 1 take."


@pytest.mark.parametrize(
    ("count", "words"),
    [(0, "0 B"), (999, "999 B"), (1000, "1 kB"), (10_066_329_600, "10.1 GB"), (5e15, "5000 TB")],
)
def test_sizes_are_told_for_people(count: float, words: str) -> None:
    assert bytes_in_words(count) == words


def test_folders_and_disks_are_measured(tmp_path: Path) -> None:
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "a" / "x").write_bytes(b"12345")
    (tmp_path / "a" / "b" / "y").write_bytes(b"123")
    assert folder_bytes(tmp_path) == 8
    assert folder_bytes(tmp_path / "none") == 0
    assert free_bytes(tmp_path) > 0
    with pytest.raises(WorkError, match="none: free space not known: No such file"):
        free_bytes(tmp_path / "none")
