"""The contract of devices with which things go wrong on request: the ledger says exactly what."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from capture.devices.array import DeviceArray
from capture.devices.capabilities import Monitored, Reconnecting
from capture.devices.faults import Fault, FaultKind, Faulty
from capture.devices.protocol import TriggerKind
from capture.errors import DeviceError, SettingsError
from capture.ledger import Oddity
from capture.recorder import Recording, RecordSettings
from capture.stream import Stream
from tests.capture.devices.bench import Bench
from tests.capture.recording import verdicts

SETTINGS = RecordSettings(rate_hz=250.0, exposure_us=1000.0, retention_ms=200.0)
EDGE = SETTINGS.edge_triggers
COUNT, AT = 18, 7


@pytest.fixture
def wired(opened_by: tuple[str, str, float]) -> Iterator[Bench]:
    """The device on a wire, so that it is known which trigger exposed what."""
    with Bench(*opened_by, TriggerKind.HARDWARE) as bench:
        if not isinstance(bench.device, Faulty):
            pytest.skip(f"{bench.device.info.model}: nothing goes wrong with it on request")
        if bench.unable:
            pytest.skip(f"{bench.device.info.model}: {bench.unable}")
        yield bench


def streamed(bench: Bench, plan: dict[int, Fault], back_at: int = -1) -> Recording:
    """Record `COUNT` triggers; faults go in while it streams, just before the trigger they name."""
    assert bench.line is not None
    assert isinstance(bench.device, Faulty)
    stream = Stream(DeviceArray((bench.device,), bench.line), SETTINGS)
    stream.start()
    window = stream.open(EDGE, COUNT, lambda frame: frame.done())
    for k in range(-EDGE, COUNT + EDGE):
        if k in plan:
            bench.device.inject(plan[k])
        if k == back_at:
            assert isinstance(bench.device, Reconnecting)
            bench.device.reconnect()
            stream.restart("cam00", [bench.device.latch() for _ in range(8)])
        stream.fire()
        stream.pump()
    while window.recording is None:
        bench.line.wait(bench.line.now_ns() + SETTINGS.period_ns)
        stream.pump()
    stream.stop()
    return window.recording


def oddities(recording: Recording) -> list[Oddity]:
    return [remark.oddity for remark in recording.ledger.remarks]


CASES: dict[str, tuple[Fault, dict[int, str], list[Oddity]]] = {
    "nothing": (Fault(FaultKind.LOSE_FRAME, 10_000), {}, []),
    "lost frame": (Fault(FaultKind.LOSE_FRAME), {AT: "lost"}, []),
    "lost frames": (
        Fault(FaultKind.LOSE_FRAME, triggers=3), dict.fromkeys(range(AT, AT + 3), "lost"), []),
    "missed trigger": (Fault(FaultKind.MISS_TRIGGER, -1), {AT: "missed_trigger"}, []),
    "missed triggers": (
        Fault(FaultKind.MISS_TRIGGER, triggers=2),
        dict.fromkeys(range(AT, AT + 2), "missed_trigger"), []),
    "lost packet": (Fault(FaultKind.INCOMPLETE), {AT: "incomplete"}, []),
    "duplicate": (Fault(FaultKind.DUPLICATE), {}, [Oddity.DUPLICATE]),
    "stale": (Fault(FaultKind.STALE), {}, [Oddity.STALE]),
    "numbers begin again": (Fault(FaultKind.ID_RESET), {}, [Oddity.ID_RESET]),
    "numbers jump to the wrap": (Fault(FaultKind.ID_JUMP), {}, [Oddity.ID_RESET]),
    "clock steps ahead": (
        Fault(FaultKind.CLOCK_STEP, amount_ns=3_141_592_653), {}, [Oddity.CLOCK_STEP]),
    "clock steps back": (
        Fault(FaultKind.CLOCK_STEP, amount_ns=-2_718_281_828), {}, [Oddity.CLOCK_STEP]),
    "clock drifts": (Fault(FaultKind.CLOCK_DRIFT, drift_ppm=300.0), {}, []),
    "freeze": (
        Fault(FaultKind.FREEZE, triggers=6), dict.fromkeys(range(AT, AT + 6), "lost"), []),
    "death": (Fault(FaultKind.DEATH), dict.fromkeys(range(AT, COUNT), "missing"), []),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_each_fault_shows_in_the_ledger_and_nothing_else_does(case: str, wired: Bench) -> None:
    fault, expected, odd = CASES[case]
    recording = streamed(wired, {AT: fault})
    assert verdicts(recording.ledger, "cam00") == expected
    assert oddities(recording) == odd
    assert sum(recording.ledger.counts().values()) == COUNT


def test_several_faults_in_a_row_are_told_apart(wired: Bench) -> None:
    recording = streamed(
        wired,
        {
            3: Fault(FaultKind.LOSE_FRAME),
            6: Fault(FaultKind.MISS_TRIGGER),
            9: Fault(FaultKind.DUPLICATE),
            12: Fault(FaultKind.INCOMPLETE),
            15: Fault(FaultKind.STALE),
        },
    )
    assert verdicts(recording.ledger, "cam00") == {
        3: "lost", 6: "missed_trigger", 12: "incomplete",
    }  # fmt: skip
    assert oddities(recording) == [Oddity.DUPLICATE, Oddity.STALE]


def test_a_device_that_died_comes_back_and_only_the_triggers_between_are_gone(
    wired: Bench,
) -> None:
    recording = streamed(wired, {AT: Fault(FaultKind.DEATH)}, back_at=AT + 5)
    assert set(verdicts(recording.ledger, "cam00")) == set(range(AT, AT + 5))


def test_a_dead_device_says_so_and_delivers_nothing(wired: Bench) -> None:
    assert isinstance(wired.device, Faulty)
    wired.ready()
    wired.device.inject(Fault(FaultKind.DEATH))
    assert wired.listen(periods=20) == []
    with pytest.raises(DeviceError, match="cam00: does not answer; reconnect it"):
        wired.device.trigger.prepare(wired.spec())
    if isinstance(wired.device, Monitored):
        assert not wired.device.health().connected


def test_a_fault_that_comes_too_late_is_refused(wired: Bench) -> None:
    assert isinstance(wired.device, Faulty)
    wired.ready()
    wired.release(wired.collect(3))
    with pytest.raises(SettingsError, match="trigger 0 has passed; the next one is "):
        wired.device.inject(Fault(FaultKind.LOSE_FRAME, 0))
