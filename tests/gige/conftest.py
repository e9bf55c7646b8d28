from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.gige.network import FakeNetwork, NoNetworkError, reason_against

DEVICES = 16


@pytest.fixture(scope="session")
def fakes() -> Iterator[FakeNetwork]:
    """Sixteen fake cameras that all run; a visible skip where they cannot be had."""
    reason = reason_against()
    if reason:
        pytest.skip(f"gige: {reason}")
    network = FakeNetwork(DEVICES)
    try:
        with network:
            yield network
    except NoNetworkError as error:
        pytest.skip(f"gige: {error}")
