"""The example of a third party's backend: installed by an entry point, it keeps the contract."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np

from capture.devices.array import DeviceArray
from capture.devices.lines import HostLine
from capture.devices.protocol import Device, TriggerKind
from capture.ledger import Verdict
from capture.live import LiveArray
from capture.recorder import RecordSettings
from capture.session import Session, Shot
from capture.take import Take
from tests.capture.devices.example_backend import backend

ROOT = Path(__file__).resolve().parents[3]


def test_a_backend_that_is_installed_by_an_entry_point_keeps_the_contract(tmp_path: Path) -> None:
    installed = tmp_path / "likeness_example-1.0.dist-info"
    installed.mkdir()
    (installed / "METADATA").write_text("Metadata-Version: 2.1\nName: likeness-example\n")
    (installed / "entry_points.txt").write_text(
        "[likeness.devices]\ncounting = tests.capture.devices.example_backend:backend\n"
    )
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "--color=no",
         "tests/capture/devices/test_contract.py", "--device=counting:c1", "--device-rate=250"],
        cwd=ROOT, env={**os.environ, "PYTHONPATH": f"{tmp_path}:{ROOT}"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    passed = re.search(r"(\d+) passed", done.stdout)
    assert passed
    assert int(passed[1]) >= 12


def test_its_devices_are_recorded_like_any_others(tmp_path: Path) -> None:
    devices: list[Device] = [backend.open(f"c{place}", f"cam{place:02d}") for place in range(2)]
    array = DeviceArray(tuple(devices), HostLine(), trigger=TriggerKind.FREE_RUN)
    with LiveArray(array, RecordSettings(rate_hz=100, exposure_us=1000)) as live:
        shot = Shot(slate="count", kind="expression", frames=20)
        take = live.record(Session.create(tmp_path / "session"), shot)
        assert take.wait(20)
        assert take.error == ""
    read = Take.open(take.folder)
    for entry in read.ledger().entries:
        if entry.verdict == Verdict.OK:
            image = read.image(entry.device, entry.trigger_index)
            assert np.all(image == entry.frame_id % 256)
    assert sum(entry.verdict == Verdict.OK for entry in read.ledger().entries) > 20
