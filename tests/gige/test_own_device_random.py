"""Random faults on real transport: for every trigger, ledger, device and pixels say the same."""

from __future__ import annotations

import contextlib
import random
from collections.abc import Iterator
from pathlib import Path

import pytest

from capture.devices.aravis import backend
from capture.devices.array import DeviceArray
from capture.devices.protocol import TriggerKind
from capture.ledger import Verdict
from capture.live import LiveArray
from capture.recorder import RecordSettings
from capture.session import Session, Shot
from capture.take import Take
from tests.gige.camera.raw import require_aravis
from tests.gige.camera.running import RunningDevice, free_addresses
from tests.gige.camera.setup import Setup
from tests.gige.camera.wiring import Wire, untruths

pytestmark = [pytest.mark.gige, pytest.mark.slow]

NAMES = ("cam01", "cam02", "cam03", "cam04")
TRIGGERS = 150
SETTINGS = RecordSettings(rate_hz=40.0, exposure_us=1000.0, ring_s=3.0, retention_ms=300.0)


@pytest.fixture(scope="module")
def running() -> Iterator[list[RunningDevice]]:
    require_aravis()
    with contextlib.ExitStack() as stack:
        yield [
            stack.enter_context(RunningDevice(Setup(address=address)))
            for address in free_addresses(len(NAMES))
        ]


def plan_faults(device: RunningDevice, generator: random.Random) -> int:
    """Faults that do not touch each other, so that their order can be told; how many."""
    device.set(resend=generator.choice(["answer", "answer", "silent", "unavailable"]))
    planned, at = 0, generator.randrange(4, 10)
    while at < TRIGGERS - 8:
        defect = generator.choice(["lose", "ignore", "drop", "repeat"])
        count = generator.randrange(1, 4) if defect in ("lose", "ignore") else 1
        packets = tuple(generator.sample(range(11), generator.randrange(1, 3)))
        device.plan(defect, after=at, count=count, packets=packets)
        planned += 1
        at += count + generator.randrange(4, 25)
    return planned


@pytest.mark.parametrize("seed", range(8))
def test_random_faults_are_told_exactly(
    running: list[RunningDevice], tmp_path: Path, seed: int
) -> None:
    generator = random.Random(seed)
    for number, one in enumerate(running):
        one.renew(
            serial=f"OWN-{number}",
            path_mtu=1500,
            first_id=generator.choice([1, 65_500, 3_000_000_000]),
            drift_ppm=generator.uniform(-100, 100),
        )
    named = dict(zip(NAMES, running, strict=True))
    session = Session.create(tmp_path / "day")
    with contextlib.ExitStack() as stack:
        devices = [
            stack.enter_context(contextlib.closing(backend.open(one.address, name)))
            for name, one in named.items()
        ]
        for device, one in zip(devices, running, strict=True):
            if one.setup.first_id < 1 << 16 and generator.random() < 0.5:
                device.write_feature("GevGVSPExtendedIDMode", "Off")
            elif one.setup.first_id > 1 << 16:
                device.write_feature("GevGVSPExtendedIDMode", "On")
        array = DeviceArray(
            tuple(devices), Wire(running), trigger=TriggerKind.HARDWARE, source="Line0"
        )
        with LiveArray(array, SETTINGS) as live:
            planned = sum(plan_faults(one, generator) for one in running)
            shot = Shot(slate=f"seed{seed}", kind="expression", frames=TRIGGERS)
            take = live.record(session, shot)
            assert take.wait(60)
    assert take.recording is not None, take.error
    assert planned > 20
    assert untruths(take.recording, Take.open(take.folder), named) == []
    ledger = take.recording.ledger
    assert sum(ledger.counts().values()) == TRIGGERS * len(NAMES)
    assert ledger.counts()[Verdict.MISSING] == 0
