"""Takes of sixteen fake cameras by way of real Aravis: the pixels of every frame prove the ledger.

A fake camera skips periods now and then, and draws when it gets round to it: verdicts are asserted
here, and neither how many frames there are nor how well they go together.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from capture.devices.aravis import AravisDevice
from capture.devices.array import DeviceArray
from capture.devices.lines import HostLine
from capture.devices.preset import apply_preset
from capture.devices.protocol import TriggerKind
from capture.judgement import Colour
from capture.ledger import Verdict
from capture.live import LiveArray
from capture.live_take import TakePhase
from capture.recorder import RecordSettings
from capture.session import Session, Shot
from capture.take import Take
from tests.gige.network import FakeNetwork
from tests.gige.test_fakes import PLAIN
from tests.gige.witness import EXPOSURE_US, IDS, Evidence, check_take, open_watched

pytestmark = pytest.mark.gige

SETTINGS = RecordSettings(
    rate_hz=10, exposure_us=EXPOSURE_US, pre_roll=3, post_roll=2, retention_ms=500, ring_s=6
)


class Crew:
    """An array of fake cameras, and what was seen of each."""

    def __init__(self, devices: list[AravisDevice], seen: list[Evidence]) -> None:
        self.array = DeviceArray(tuple(devices), HostLine(), TriggerKind.FREE_RUN)
        self.seen = dict(zip(self.array.names, seen, strict=True))


@pytest.fixture
def crew(fakes: FakeNetwork, request: pytest.FixtureRequest) -> Iterator[Crew]:
    """The first so many fake cameras, set up alike; the number comes as a parameter."""
    with ExitStack() as stack:
        devices, seen = [], []
        for number, fake in enumerate(fakes.fakes[: request.param], start=1):
            fake.ask("loss 0")
            device, evidence = open_watched(fake.address, f"cam{number:02d}")
            stack.callback(device.close)
            assert apply_preset(device, PLAIN) == ()
            devices.append(device)
            seen.append(evidence)
        yield Crew(devices, seen)


@pytest.mark.parametrize("crew", [16], indirect=True)
def test_windows_of_a_stream_are_takes_whose_every_frame_is_proven(
    fakes: FakeNetwork, crew: Crew, tmp_path: Path
) -> None:
    session = Session.create(tmp_path / "session")
    with LiveArray(crew.array, SETTINGS) as live:
        time.sleep(2)  # sixteen that start at once draw late at first
        for slate, frames in (("rest", 20), ("smile", 30), ("frown", 30)):
            lossy = fakes.fakes[4:8] if slate == "smile" else []
            for fake in lossy:
                fake.ask("loss 0.03")
            take = live.record(session, Shot(slate=slate, kind="expression", frames=frames))
            assert take.wait(30), take.phase
            assert take.phase == TakePhase.DONE, take.error
            for fake in lossy:
                fake.ask("loss 0")
            assert take.check is not None
            assert take.check.sound, take.check
            counts = check_take(Take.open(take.folder), crew.seen)
            assert sum(counts.values()) == 16 * (frames + 5)
            if lossy:
                assert counts[Verdict.INCOMPLETE] + counts[Verdict.LOST] > 0
                assert take.judgement is not None
                assert take.judgement.colour == Colour.RED
    assert all(evidence.wrong == [] for evidence in crew.seen.values())


@pytest.mark.parametrize("crew", [4], indirect=True)
def test_a_device_that_dies_in_a_take_is_found_again_without_ending_the_session(
    fakes: FakeNetwork, crew: Crew, tmp_path: Path
) -> None:
    session = Session.create(tmp_path / "session")
    victim = fakes.fakes[1]
    with LiveArray(crew.array, SETTINGS) as live:
        dying = live.record(session, Shot(slate="dying", kind="expression", frames=45))
        time.sleep(1.5)
        victim.kill()
        assert dying.wait(30)
        assert dying.phase == TakePhase.DONE, dying.error
        state = next(one for one in live.states() if one.name == "cam02")
        assert state.colour == Colour.RED
        assert state.sentence.startswith("silent for")
        take = Take.open(dying.folder)
        check_take(take, crew.seen)
        verdicts = [take.ledger().entry(k, "cam02").verdict for k in range(45)]
        assert verdicts[-1] == Verdict.MISSING
        assert Verdict.OK in verdicts
        deadline = time.monotonic() + 10  # a look each second; a dead device answers after a while
        while live.health()["cam02"].connected and time.monotonic() < deadline:
            time.sleep(0.1)
        assert not live.health()["cam02"].connected

        victim.start()
        victim.await_running()
        live.reconnect("cam02")
        heard = len(crew.seen["cam02"].events)
        while len(crew.seen["cam02"].events) < heard + 5 and time.monotonic() < deadline + 10:
            time.sleep(0.05)
        after = live.record(session, Shot(slate="after", kind="expression", frames=20))
        assert after.wait(30)
        assert after.phase == TakePhase.DONE, after.error
        take = Take.open(after.folder)
        check_take(take, crew.seen)
        assert take.size("cam02") == (256, 256)  # the preset was written again
        assert Verdict.OK in {take.ledger().entry(k, "cam02").verdict for k in range(20)}
    assert all(evidence.wrong == [] for evidence in crew.seen.values())


@pytest.mark.parametrize("crew", [4], indirect=True)
def test_numbers_that_begin_again_after_65535_are_told_apart(
    fakes: FakeNetwork, crew: Crew, tmp_path: Path
) -> None:
    for fake, device in zip(fakes.fakes, crew.array.devices, strict=False):
        assert isinstance(device, AravisDevice)
        device.close()
        fake.kill()  # a fresh one begins at 65,400
        fake.start()
        fake.await_running()
        device.reconnect()
    session = Session.create(tmp_path / "session")
    settings = RecordSettings(
        rate_hz=25, exposure_us=EXPOSURE_US, post_roll=2, retention_ms=500, ring_s=6
    )
    with LiveArray(crew.array, settings) as live:
        take = live.record(session, Shot(slate="long", kind="expression", frames=190))
        assert take.wait(40)
        assert take.phase == TakePhase.DONE, take.error
    done = Take.open(take.folder)
    check_take(done, crew.seen)
    for name in crew.array.names:
        entries = [done.ledger().entry(k, name) for k in range(190)]
        numbers = [entry.frame_id for entry in entries if entry.verdict == Verdict.OK]
        assert numbers[0] > 65_400
        assert numbers[-1] < 1000
        ahead = [number + (IDS if number < 1000 else 0) for number in numbers]
        assert ahead == sorted(set(ahead))
    assert all(evidence.wrong == [] for evidence in crew.seen.values())
