"""Random faults put into devices while they stream in real time: the take's ledger is exact."""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from capture.devices.faults import Fault, FaultKind
from capture.devices.simulated import Stamp, StreamingDevice, pattern, streaming_array
from capture.errors import SettingsError
from capture.frame_header import ImageLayout
from capture.ledger import Oddity
from capture.live import LiveArray
from capture.recorder import RecordSettings
from capture.session import Session, Shot
from capture.take import Take
from tests.capture.recording import verdicts

LAYOUT = ImageLayout(64, 24, 1, "uint8")
SETTINGS = RecordSettings(rate_hz=150.0, exposure_us=1000.0, ring_s=2.0, retention_ms=1000.0)
AHEAD = 40  # triggers between putting a fault in and its trigger: the machine may be busy

VERDICTS = {
    FaultKind.LOSE_FRAME: "lost",
    FaultKind.FREEZE: "lost",
    FaultKind.MISS_TRIGGER: "missed_trigger",
    FaultKind.INCOMPLETE: "incomplete",
}
ODDITIES = {
    FaultKind.DUPLICATE: Oddity.DUPLICATE,
    FaultKind.STALE: Oddity.STALE,
    FaultKind.CLOCK_STEP: Oddity.CLOCK_STEP,
    FaultKind.ID_RESET: Oddity.ID_RESET,
    FaultKind.ID_JUMP: Oddity.ID_RESET,
}


def planned(rng: np.random.Generator, first: int, last: int, spacing: int) -> list[Fault]:
    """Faults of all kinds at triggers of a range, `spacing` apart or more; numbers jump once."""
    kinds = [kind for kind in FaultKind if kind != FaultKind.DEATH]
    once = {FaultKind.ID_RESET, FaultKind.ID_JUMP}
    faults: list[Fault] = []
    edge = first
    while (edge := edge + spacing + int(rng.integers(0, 6))) < last:
        kind = kinds[int(rng.integers(len(kinds)))]
        if kind in once and any(fault.kind in once for fault in faults):
            continue
        many = int(rng.integers(2, 6)) if kind == FaultKind.FREEZE else 1
        faults.append(
            Fault(
                kind,
                edge,
                amount_ns=int(rng.integers(-(10**10), 10**10)),
                drift_ppm=float(rng.uniform(-300.0, 300.0)),
                triggers=many,
            )
        )
        edge += many
    return faults


def record_with_faults(
    folder: Path, seed: int, count: int, frames: int, spacing: int
) -> tuple[Take, LiveArray, dict[str, list[Fault]]]:
    """Record a take, and put faults into every device while it streams."""
    rng = np.random.default_rng(seed)
    array = streaming_array(count, LAYOUT, seed=seed)
    with LiveArray(array, SETTINGS) as live:
        while not (images := live.latest()):
            time.sleep(0.01)
        now = Stamp.read(next(iter(images.values())))
        session = Session.create(folder)
        take = live.record(session, Shot(slate="faults", kind="neutral", frames=frames))
        first, last = now.place + AHEAD + 10, now.place + frames - 12
        plan = {name: planned(rng, first, last, spacing) for name in array.names}
        waiting = [(fault.edge, name, fault) for name, faults in plan.items() for fault in faults]
        for edge, name, fault in sorted(waiting, key=lambda item: (item[0], item[1])):
            assert edge is not None
            array.line.wait(now.t_ns + (edge - AHEAD - now.place) * SETTINGS.period_ns)
            device = array.devices[array.names.index(name)]
            assert isinstance(device, StreamingDevice)
            try:
                device.inject(fault)
            except SettingsError:  # this thread slept past it, so it did not happen
                plan[name].remove(fault)
        assert take.wait(60.0)
        assert take.error == ""
    return Take.open(take.folder), live, plan


def check(take: Take, plan: dict[str, list[Fault]], told_apart: bool) -> None:
    """Every frame under the trigger that exposed it, every verdict that of the plan."""
    ledger, start = take.ledger(), take.manifest.start_ns
    assert start is not None
    assert sum(ledger.counts().values()) == take.manifest.frame_count * len(take.device_names)
    reader = take.reader(take.device_names[0])
    opening = Stamp.read(reader.read(0)).place - reader.headers[0].trigger_index
    for name, faults in plan.items():
        expected = {
            fault.edge - opening + more: VERDICTS[fault.kind]  # type: ignore[operator]
            for fault in faults
            if fault.kind in VERDICTS
            for more in range(fault.triggers)
        }
        found = verdicts(ledger, name)
        assert set(found) == set(expected), name
        if told_apart:
            assert found == expected, name
            odd = Counter(ODDITIES[fault.kind] for fault in faults if fault.kind in ODDITIES)
            assert Counter(r.oddity for r in ledger.remarks if r.device == name) == odd, name
        reader = take.reader(name)
        there = [header.trigger_index for header in reader.headers if header.status == 0]
        assert there == [k for k in range(take.manifest.frame_count) if k not in found]
        for place, header in enumerate(reader.headers):
            image = reader.read(place)
            stamp = Stamp.read(image)
            assert stamp.place == opening + header.trigger_index
            assert stamp.t_ns == start + header.trigger_index * SETTINGS.period_ns
            assert stamp.number == header.frame_id
            assert np.array_equal(image, pattern(LAYOUT, stamp))


def test_the_ledger_of_a_take_that_was_spoilt_while_it_streamed_is_exact(tmp_path: Path) -> None:
    take, _, plan = record_with_faults(tmp_path / "session", 0, count=6, frames=150, spacing=4)
    assert sum(len(faults) for faults in plan.values()) > 40
    check(take, plan, told_apart=True)


def test_a_device_dies_and_comes_back_within_a_take_and_the_others_go_on(tmp_path: Path) -> None:
    array = streaming_array(3, LAYOUT, seed=8)
    victim = array.devices[1]
    assert isinstance(victim, StreamingDevice)
    with LiveArray(array, SETTINGS) as live:
        take = live.record(
            Session.create(tmp_path / "session"),
            Shot(slate="death", kind="neutral", frames=100),
        )
        time.sleep(0.2)
        victim.inject(Fault(FaultKind.DEATH))
        time.sleep(0.15)
        live.reconnect("cam01")
        assert take.wait(60.0)
        assert take.error == ""
    recorded = Take.open(take.folder)
    ledger, start = recorded.ledger(), recorded.manifest.start_ns
    assert start is not None
    gone = sorted(verdicts(ledger, "cam01"))
    assert len(gone) > 10
    assert gone == list(range(gone[0], gone[-1] + 1))  # one gap and nothing else
    assert verdicts(ledger, "cam00") == verdicts(ledger, "cam02") == {}
    for name in recorded.device_names:
        reader = recorded.reader(name)
        for place, header in enumerate(reader.headers):
            t_ns = start + header.trigger_index * SETTINGS.period_ns
            assert Stamp.read(reader.read(place)).t_ns == t_ns


@pytest.mark.slow
@pytest.mark.parametrize("spacing", [1, 4])
@pytest.mark.parametrize("seed", range(1, 13))
def test_ledgers_of_many_spoilt_takes_are_exact(seed: int, spacing: int, tmp_path: Path) -> None:
    take, _, plan = record_with_faults(tmp_path / "session", seed, 8, frames=300, spacing=spacing)
    check(take, plan, told_apart=spacing > 1)
