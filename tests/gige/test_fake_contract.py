"""The contract of every device, kept by a fake camera behind Aravis."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.gige.network import FakeNetwork

pytestmark = pytest.mark.gige

ROOT = Path(__file__).resolve().parents[2]


def test_a_fake_camera_keeps_the_contract_of_devices(fakes: FakeNetwork) -> None:
    suite = [str(path) for path in sorted((ROOT / "tests/capture/devices").glob("test_contract*"))]
    fake = fakes.fakes[-1]
    fake.ask("loss 0")
    fake.ask("rate 1000")  # it looks for software triggers so often
    done = subprocess.run(
        [
            sys.executable, "-m", "pytest", *suite, "-q", "-x", "-m", "not slow", "--device",
            f"aravis:{fake.address}", "--device-rate", "20", "-p", "no:cacheprovider",
        ],
        cwd=ROOT, capture_output=True, text=True, check=False, timeout=150,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-4000:]
