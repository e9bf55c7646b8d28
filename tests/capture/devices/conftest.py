"""The device that must keep the contract, on its bench: running freely, and on a wire."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from capture.devices.protocol import TriggerKind
from tests.capture.devices.bench import PLAYED_HZ, Bench, recorded_take

SIMULATED = "64x48?seed=3&latency_ms=1&latency_jitter_ms=0.3"


@pytest.fixture(scope="session")
def opened_by(
    device_address: str, tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest
) -> tuple[str, str, float]:
    """Backend, address and rate of the device."""
    backend, _, address = device_address.partition(":")
    rate_hz = float(request.config.getoption("--device-rate"))
    if backend == "sim":
        return backend, address or SIMULATED, PLAYED_HZ
    if backend == "replay":
        if not address:
            folder = recorded_take(tmp_path_factory.mktemp("replay") / "session")
            address = f"{folder}#cam01?loop=1"
        return backend, address, PLAYED_HZ
    return backend, address, rate_hz


@pytest.fixture(params=[TriggerKind.FREE_RUN, TriggerKind.HARDWARE])
def bench(opened_by: tuple[str, str, float], request: pytest.FixtureRequest) -> Iterator[Bench]:
    """The device, with a kind of trigger that it offers and that can be sent here."""
    with Bench(*opened_by, request.param) as made:
        if made.unable:
            pytest.skip(f"{made.device.info.model}: {made.unable}")
        yield made


@pytest.fixture
def plain(opened_by: tuple[str, str, float]) -> Iterator[Bench]:
    """The device, triggered in whatever way it can be: for tests of anything else."""
    for kind in (TriggerKind.FREE_RUN, TriggerKind.HARDWARE, TriggerKind.SOFTWARE):
        with Bench(*opened_by, kind) as made:
            if not made.unable:
                yield made
                return
    pytest.skip("no trigger of the device can be sent here")
