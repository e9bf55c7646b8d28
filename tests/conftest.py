"""Options of the suite: `--device BACKEND[:ADDRESS]` says which devices must keep the contract.

::

    pytest tests/capture/devices --device sim --device replay       what runs by default
    pytest tests/capture/devices --device aravis:10.0.0.11 --device-rate 20
    pytest tests/capture/devices --device v4l2:/dev/video0 --device-rate 30
"""

from __future__ import annotations

import pytest

_PLAYED = ("sim", "replay")


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("likeness")
    group.addoption(
        "--device",
        action="append",
        default=[],
        metavar="BACKEND[:ADDRESS]",
        help="device that must keep the contract; may be repeated (default: sim, replay)",
    )
    group.addoption(
        "--device-rate",
        type=float,
        default=25.0,
        metavar="HZ",
        help="at which --device runs, when it is not sim or replay, which run at 250 Hz",
    )


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "device_address" in metafunc.fixturenames:
        chosen = metafunc.config.getoption("--device") or list(_PLAYED)
        metafunc.parametrize("device_address", chosen, scope="session")
