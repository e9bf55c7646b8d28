"""Arrays of devices of our own, recorded through Aravis: the ledger against the truth."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from capture.devices.aravis import AravisDevice, backend
from capture.devices.array import DeviceArray
from capture.devices.capabilities import PtpClocked
from capture.devices.lines import ActionLine, ActionSettings, HostLine
from capture.devices.protocol import ActionKeys, TriggerKind
from capture.judgement import Colour
from capture.ledger import Ledger, Oddity, Verdict
from capture.live import LiveArray
from capture.live_take import LiveTake, TakePhase
from capture.preflight.ptp import PtpGate, wait_for_lock
from capture.recorder import Recording, RecordSettings
from capture.session import Session, Shot
from capture.take import Take
from tests.gige.camera.pixels import read_stamp
from tests.gige.camera.raw import require_aravis
from tests.gige.camera.running import RunningDevice, free_addresses
from tests.gige.camera.setup import MASTER_EPOCH_NS, Setup
from tests.gige.camera.wiring import Wire, untruths

pytestmark = pytest.mark.gige

KEYS = ActionKeys(device_key=7, group_key=9, group_mask=0b10)
NAMES = ("cam01", "cam02", "cam03")
SETTINGS = RecordSettings(rate_hz=25.0, exposure_us=1000.0, ring_s=3.0, retention_ms=300.0)
SLOW = replace(SETTINGS, rate_hz=12.5)  # where a host that is busy for half a period would tell


@pytest.fixture(scope="module")
def running() -> Iterator[list[RunningDevice]]:
    require_aravis()
    with contextlib.ExitStack() as stack:
        yield [stack.enter_context(RunningDevice(Setup(address=a))) for a in free_addresses(3)]


@pytest.fixture
def own(running: list[RunningDevice]) -> list[RunningDevice]:
    for number, one in enumerate(running):
        one.renew(
            serial=f"OWN-{number}",
            path_mtu=1500,
            clock_start_ns=10**9 * (number + 3),
            drift_ppm=20.0 * (number - 1),
            ptp_settle_s=0.0,
        )
    return running


@pytest.fixture
def opened(own: list[RunningDevice]) -> Iterator[list[AravisDevice]]:
    with contextlib.ExitStack() as stack:
        yield [
            stack.enter_context(contextlib.closing(backend.open(one.address, name)))
            for one, name in zip(own, NAMES, strict=True)
        ]


@pytest.fixture
def session(tmp_path: Path) -> Session:
    return Session.create(tmp_path / "day")


def wired(opened: list[AravisDevice], own: list[RunningDevice]) -> DeviceArray:
    return DeviceArray(tuple(opened), Wire(own), trigger=TriggerKind.HARDWARE, source="Line0")


def until(so: Callable[[], bool], patience_s: float = 20.0) -> bool:
    end = time.monotonic() + patience_s
    while not so() and time.monotonic() < end:
        time.sleep(0.02)
    return so()


def finished(take: LiveTake) -> tuple[Recording, Take]:
    """A take once it is done."""
    assert take.wait(30)
    assert take.phase == TakePhase.DONE, take.error
    assert take.recording is not None
    return take.recording, Take.open(take.folder)


def counts(ledger: Ledger, device: str) -> dict[Verdict | str, int]:
    """How often each verdict was given; what a busy machine kept waiting arrived all the same."""
    entries = [entry for entry in ledger.entries if entry.device == device]
    found = [
        "arrived" if entry.verdict in (Verdict.OK, Verdict.INCOMPLETE) else entry.verdict
        for entry in entries
    ]
    return {verdict: found.count(verdict) for verdict in set(found)}


def test_a_take_with_every_fault_of_the_wire_is_as_the_devices_and_the_pixels_say(
    own: list[RunningDevice], opened: list[AravisDevice], session: Session
) -> None:
    own[1].set(resend="silent")
    with LiveArray(wired(opened, own), SETTINGS) as live:
        own[0].plan("drop", after=10, packets=(4,))  # comes when it is asked for
        own[1].plan("drop", after=12, packets=(2, 5))  # never comes
        own[1].plan("lose", after=20, count=2)
        own[2].plan("ignore", after=15, count=3)
        own[2].plan("lose", after=25)
        recording, take = finished(
            live.record(session, Shot(slate="all", kind="expression", frames=40))
        )
    assert untruths(recording, take, dict(zip(NAMES, own, strict=True))) == []
    ledger = recording.ledger
    assert counts(ledger, "cam01") == {"arrived": 40}
    assert counts(ledger, "cam02") == {"arrived": 38, Verdict.LOST: 2}
    assert counts(ledger, "cam03") == {"arrived": 36, Verdict.MISSED_TRIGGER: 3, Verdict.LOST: 1}
    broken = [entry for entry in ledger.entries if entry.verdict == Verdict.INCOMPLETE]
    assert "cam02" in {entry.device for entry in broken}
    notes = [entry.note for entry in ledger.entries if entry.device == "cam01"]
    assert any("packets resent" in note for note in notes)
    assert ledger.remarks == ()


def test_a_generator_on_the_wire_is_made_out_and_a_slow_device_misses_every_other_trigger(
    own: list[RunningDevice], opened: list[AravisDevice], session: Session
) -> None:
    first_ns = time.monotonic_ns() + 300_000_000
    for one in own:
        one.tell("train", source="Line0", first_ns=first_ns, period_ns=40_000_000, count=500)
    array = DeviceArray(tuple(opened), HostLine(), trigger=TriggerKind.HARDWARE, source="Line0")
    with LiveArray(array, SETTINGS) as live:
        own[1].set(readout_us=50_000.0)  # its numbers will show no gap
        time.sleep(0.2)
        take = live.record(session, Shot(slate="slow", kind="expression", frames=16))
        recording, written = finished(take)
    assert untruths(recording, written, dict(zip(NAMES, own, strict=True))) == []
    assert counts(recording.ledger, "cam02") == {"arrived": 8, Verdict.MISSED_TRIGGER: 8}


def test_numbers_wrap_jump_and_clocks_step_and_every_frame_is_kept(
    own: list[RunningDevice], opened: list[AravisDevice], session: Session
) -> None:
    own[0].set(first_id=65_528)
    opened[0].write_feature("GevGVSPExtendedIDMode", "Off")
    own[1].set(first_id=5_000)
    with LiveArray(wired(opened, own), SLOW) as live:  # after a jump, placed by its arrival
        take = live.record(session, Shot(slate="jumps", kind="expression", frames=20))
        time.sleep(0.5)
        own[1].set(next_id=1)
        own[2].ask("step_clock", by_ns=12_345_678_901)
        recording, written = finished(take)
    assert untruths(recording, written, dict(zip(NAMES, own, strict=True))) == []
    ledger = recording.ledger
    assert [counts(ledger, name) for name in NAMES] == [{"arrived": 20}] * 3
    assert {entry.frame_id for entry in ledger.entries if entry.device == "cam01"} >= {65_535, 1}
    found = [(remark.device, remark.oddity) for remark in ledger.remarks]
    assert found.count(("cam02", Oddity.ID_RESET)) == 1
    assert found.count(("cam03", Oddity.CLOCK_STEP)) == 1
    assert len(found) == 2


def test_a_device_that_reboots_is_taken_up_again_while_the_others_go_on(
    own: list[RunningDevice], opened: list[AravisDevice], session: Session
) -> None:
    with LiveArray(wired(opened, own), SETTINGS) as live:
        take = live.record(session, Shot(slate="reboot", kind="expression", frames=500))
        time.sleep(0.5)
        own[1].ask("reboot", off_s=0.2)
        assert until(lambda: not own[1].state().off)
        assert until(lambda: live.states()[1].colour == Colour.RED)
        assert "silent" in live.states()[1].sentence
        live.reconnect("cam02")
        time.sleep(0.5)
        take.stop()
        recording, written = finished(take)
    assert untruths(recording, written, dict(zip(NAMES, own, strict=True))) == []
    ledger = recording.ledger
    assert counts(ledger, "cam01") == counts(ledger, "cam03") == {"arrived": ledger.triggers}
    verdicts = [entry.verdict for entry in ledger.entries if entry.device == "cam02"]
    gone = [k for k, verdict in enumerate(verdicts) if verdict != Verdict.OK]
    assert 3 < gone[0] < gone[-1] < ledger.triggers - 5
    assert gone == list(range(gone[0], gone[-1] + 1))  # one gap, and good frames on either side
    after = ledger.entry(gone[-1] + 1, "cam02")
    assert after.frame_id < 50  # it began to count anew


def test_a_cable_that_is_pulled_for_a_while_costs_the_frames_of_that_while(
    own: list[RunningDevice], opened: list[AravisDevice], session: Session
) -> None:
    with LiveArray(wired(opened, own), SETTINGS) as live:
        take = live.record(session, Shot(slate="cable", kind="expression", frames=40))
        time.sleep(0.4)
        own[2].set(dead=True)
        time.sleep(0.6)
        own[2].set(dead=False)
        recording, written = finished(take)
    assert untruths(recording, written, dict(zip(NAMES, own, strict=True))) == []
    ledger = recording.ledger
    assert counts(ledger, "cam01") == counts(ledger, "cam02") == {"arrived": 40}
    lost = counts(ledger, "cam03")
    assert set(lost) == {"arrived", Verdict.LOST}
    assert 10 <= lost[Verdict.LOST] <= 30


def test_frames_that_a_mislabelled_packet_spoilt_are_noted_in_the_ledger(
    own: list[RunningDevice], opened: list[AravisDevice], session: Session
) -> None:
    own[0].set(resend="wrong_frame")
    with LiveArray(wired(opened, own), SETTINGS) as live:
        own[0].plan("drop", after=8, packets=(4,))
        take = live.record(session, Shot(slate="mislabelled", kind="expression", frames=20))
        recording, written = finished(take)
    spoilt = [
        entry
        for entry in recording.ledger.entries
        if entry.verdict == Verdict.OK
        and read_stamp(written.image(entry.device, entry.trigger_index)) is None
    ]
    assert spoilt
    assert {entry.device for entry in spoilt} == {"cam01"}
    assert all("packets resent" in entry.note for entry in spoilt)


def test_devices_that_follow_one_clock_are_dated_by_it(
    own: list[RunningDevice], opened: list[AravisDevice]
) -> None:
    own[1].set(offset_ns=40_000)
    own[2].set(offset_ns=-500)
    for device in opened:
        assert isinstance(device, PtpClocked)
        device.enable_ptp(True)
    with LiveArray(wired(opened, own), SETTINGS) as live:
        recording = live.burst(15)
    assert recording.basis == "ptp"
    ledger, whole = recording.ledger, 0
    for k in range(15):
        t_ns = [ledger.entry(k, name).t_ns for name in NAMES]
        if min(t_ns) >= 0:
            assert (t_ns[1] - t_ns[0], t_ns[2] - t_ns[0]) == (40_000, -500)
            whole += 1
    assert whole >= 10


def test_devices_that_run_free_keep_every_frame(
    own: list[RunningDevice], opened: list[AravisDevice], session: Session
) -> None:
    array = DeviceArray(tuple(opened), HostLine(), trigger=TriggerKind.FREE_RUN)
    with LiveArray(array, SETTINGS) as live:
        own[1].plan("lose", after=10)
        take = live.record(session, Shot(slate="free", kind="expression", frames=16))
        recording, written = finished(take)
    ledger = recording.ledger
    assert recording.basis == "free"
    assert counts(ledger, "cam01") == counts(ledger, "cam03") == {"arrived": 16}
    assert counts(ledger, "cam02") == {"arrived": 15, Verdict.LOST: 1}
    for entry in ledger.entries:
        if entry.verdict == Verdict.OK:
            stamp = read_stamp(written.image(entry.device, entry.trigger_index))
            assert stamp is not None
            assert stamp.frame_id == entry.frame_id


def test_the_gate_opens_when_every_clock_follows_one_master_closely(
    own: list[RunningDevice], opened: list[AravisDevice]
) -> None:
    clocked = {
        name: device
        for name, device in zip(NAMES, opened, strict=True)
        if isinstance(device, PtpClocked)
    }
    quick = PtpGate(offset_ns=1000, hold_s=0.2, deadline_s=0.5, pause_s=0.05)

    def said() -> list[str]:
        return [finding.sentence for finding in wait_for_lock(clocked, quick)]

    assert said() == [f"The clock of {name} is not locked: disabled." for name in NAMES]
    for device in clocked.values():
        device.enable_ptp(True)
    own[1].set(offset_ns=2_500)
    own[2].set(ptp_state="Listening")
    assert said() == [
        "The clock of cam02 is +2.5 us from its master; less than 1 us is wanted.",
        "The clock of cam03 is not locked: listening.",
    ]
    own[1].set(offset_ns=-300)
    own[2].set(ptp_state=None, grandmaster=0x77)
    assert said() == [
        f"cam03 follows grandmaster {0x77:016x}, the others {own[0].setup.grandmaster:016x}: "
        "2 clocks are in charge."
    ]
    own[2].set(grandmaster=own[0].setup.grandmaster)
    assert said() == ["3 clocks have been locked for 0.2 s, at most 300 ns off."]


def test_action_commands_trigger_an_array_and_a_device_with_another_key_is_named(
    own: list[RunningDevice], opened: list[AravisDevice], session: Session
) -> None:
    told: list[str] = []
    line = ActionLine(opened, ActionSettings(keys=KEYS, timeout_ms=15.0), told=told.append)
    array = DeviceArray(tuple(opened), line, trigger=TriggerKind.ACTION, action=KEYS)
    with LiveArray(array, SLOW) as live:  # devices expose when the command comes
        take = live.record(session, Shot(slate="action", kind="expression", frames=28))
        time.sleep(0.3)
        opened[1].write_feature("ActionDeviceKey", 99)
        own[2].set(mute_actions=1)
        time.sleep(0.4)
        opened[1].write_feature("ActionDeviceKey", KEYS.device_key)
        recording, written = finished(take)
    assert untruths(recording, written, dict(zip(NAMES, own, strict=True))) == []
    missed = counts(recording.ledger, "cam02")[Verdict.MISSED_TRIGGER]
    assert 3 <= missed <= 25
    assert len(own[2].deeds()) == len(own[0].deeds())  # it exposed when it said nothing
    assert line.unanswered[own[1].address] >= missed
    assert any(f"no answer from {own[1].address}" in sentence for sentence in told)
    assert any("cam02 accepts action commands again" in sentence for sentence in told)


def test_scheduled_action_commands_expose_all_devices_at_one_instant(
    own: list[RunningDevice], opened: list[AravisDevice], session: Session
) -> None:
    for device in opened:
        assert isinstance(device, PtpClocked)
        device.enable_ptp(True)
    ahead = ActionSettings(keys=KEYS, timeout_ms=15.0, ahead_ms=60.0)
    line = ActionLine(opened, ahead, common_ns=lambda t_ns: t_ns + MASTER_EPOCH_NS)
    array = DeviceArray(tuple(opened), line, trigger=TriggerKind.ACTION, action=KEYS)
    with LiveArray(array, SLOW) as live:
        take = live.record(session, Shot(slate="scheduled", kind="expression", frames=15))
        recording, written = finished(take)
    assert untruths(recording, written, dict(zip(NAMES, own, strict=True))) == []
    assert recording.basis == "ptp"
    exposed = [{deed.t_ns for deed in one.deeds()} for one in own]
    together = exposed[0] & exposed[1] & exposed[2]
    assert len(together) >= 12  # to the nanosecond; a command that came late exposes at once
