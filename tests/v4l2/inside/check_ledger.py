"""Takes of four vivid devices with faults that their drivers inject: the ledger against pictures.

Every picture shows the number that the driver gave it. Numbers count what was exposed, so that in a
row of triggers without a reset the trigger index and the number in the picture keep one distance.
"""

from __future__ import annotations

import itertools
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from capture.devices.array import DeviceArray
from capture.devices.lines import HostLine
from capture.devices.protocol import TriggerKind
from capture.devices.v4l2 import backend
from capture.devices.v4l2.device import V4l2Device
from capture.judgement import Colour
from capture.ledger import Ledger, LedgerEntry, Oddity, Verdict
from capture.live import LiveArray
from capture.recorder import RecordSettings
from capture.session import Session, Shot
from capture.take import Take
from tests.v4l2.inside.conftest import Say, set_up, started
from tests.v4l2.inside.osd import Digits, learn_digits, number_in

_RATE_HZ = 10.0
_TAKE_FRAMES = 180  # vivid's clock wraps 16 s after the start, its numbers after 128 frames
_FLAGS = 9
_NAMES = ("cam0", "cam1", "cam2", "cam3")


@dataclass(frozen=True)
class Recorded:
    """A take, and the number that each of its pictures shows."""

    ledger: Ledger
    numbers: dict[str, dict[int, int]]
    start_ns: int
    flagged: int = 0

    def entries(self, device: str) -> list[LedgerEntry]:
        return [entry for entry in self.ledger.entries if entry.device == device]

    def verdicts(self, device: str) -> Counter[Verdict]:
        return Counter(entry.verdict for entry in self.entries(device))

    def oddities(self, device: str) -> Counter[Oddity]:
        return Counter(each.oddity for each in self.ledger.remarks if each.device == device)


@pytest.fixture(scope="module")
def digits() -> Digits:
    device = backend.open("/dev/video0", "cam0")
    assert isinstance(device, V4l2Device)
    set_up(device)
    learned = learn_digits(started(device))
    device.close()
    return learned


def array_of_four() -> tuple[DeviceArray, list[V4l2Device]]:
    devices = []
    for number, name in enumerate(_NAMES):
        device = backend.open(f"platform:vivid-00{number}", name)
        assert isinstance(device, V4l2Device)
        set_up(device)
        devices.append(device)
    return DeviceArray(tuple(devices), HostLine(), trigger=TriggerKind.FREE_RUN), devices


def record(
    folder: Path,
    frames: int,
    digits: Digits,
    array: DeviceArray,
    during: Callable[[LiveArray], int],
) -> Recorded:
    """One take, while something is done to its devices."""
    session = Session.create(folder / "session")
    settings = RecordSettings(rate_hz=_RATE_HZ, exposure_us=3000.0, ring_s=4.0)
    with LiveArray(array, settings) as live:
        time.sleep(0.5)
        take = live.record(session, Shot(slate="faults", kind="expression", frames=frames))
        done = during(live)
        assert take.wait(60.0)
    assert take.error == ""
    assert take.check is not None
    assert take.check.sound, take.check
    assert take.recording is not None
    read = Take.open(take.folder)
    numbers = {
        name: {
            k: number_in(read.image(name, k), digits) for k in read.frames if read.present(name, k)
        }
        for name in read.device_names
    }
    return Recorded(read.ledger(), numbers, take.recording.train.start_ns, done)


@pytest.fixture(scope="module")
def faulty(digits: Digits, tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """cam0 drops a fifth, cam1's numbers wrap, cam2's clock wraps, cam3 flags errors."""
    array, (drops, numbers, clock, flags) = array_of_four()
    numbers.write_feature("wrap_sequence_number", True)
    clock.write_feature("wrap_timestamp", "64 Bit")

    def during(live: LiveArray) -> int:
        drops.write_feature("percentage_of_dropped_buffers", 20)
        for _ in range(_FLAGS):
            time.sleep(1.0)
            flags.write_feature("inject_v4l2_buf_flag_error", True)
        time.sleep(1.0)
        return flags.health().counters["error_flags"]

    try:
        return record(tmp_path_factory.mktemp("faulty"), _TAKE_FRAMES, digits, array, during)
    finally:
        for device in array.devices:
            set_up(device)  # type: ignore[arg-type]
        array.close()


@pytest.mark.parametrize("device", _NAMES)
def test_the_ledger_is_what_the_pictures_prove(faulty: Recorded, device: str) -> None:
    entries = faulty.entries(device)
    good = {entry.trigger_index: entry.frame_id for entry in entries if entry.verdict == Verdict.OK}
    assert good == faulty.numbers[device]
    assert len(entries) == _TAKE_FRAMES
    distances = {(number - k) % (1 << 32) for k, number in good.items()}
    assert len(distances) == 1, told(faulty, device)
    for entry in entries:
        if entry.frame_id >= 0:  # incomplete ones have no picture on disk, but a number
            assert (entry.frame_id - entry.trigger_index) % (1 << 32) in distances


def test_dropped_frames_are_lost_and_counted(faulty: Recorded, say: Say) -> None:
    verdicts = faulty.verdicts("cam0")
    lost = verdicts[Verdict.LOST] + verdicts[Verdict.MISSING]
    assert set(verdicts) <= {Verdict.OK, Verdict.LOST, Verdict.MISSING}
    assert verdicts[Verdict.MISSING] <= 5  # behind the last frame that came
    assert 15 <= lost <= 57  # 20 % of 180 are 36; four standard deviations are 21
    say(
        asked_percent=20,
        found_percent=round(100 * lost / _TAKE_FRAMES, 1),
        others_lost=[faulty.verdicts(name)[Verdict.LOST] for name in _NAMES[1:]],
    )


def test_numbers_that_wrap_at_32_bits_lose_nothing(faulty: Recorded, say: Say) -> None:
    ids = [entry.frame_id for entry in faulty.entries("cam1") if entry.frame_id >= 0]
    assert max(ids) > (1 << 32) - 129
    assert min(ids) < _TAKE_FRAMES
    assert ids.index(min(ids)) > 0
    assert faulty.oddities("cam1")[Oddity.ID_RESET] == 0
    assert set(faulty.verdicts("cam1")) <= {Verdict.OK, Verdict.LOST}
    say(before=ids[0], last_before_wrap=max(ids), after=ids[-1])


def test_a_clock_that_wraps_is_told_and_loses_nothing(faulty: Recorded, say: Say) -> None:
    times = [entry.t_dev_ns for entry in faulty.entries("cam2") if entry.verdict == Verdict.OK]
    assert times[0] > (1 << 63) - 20 * 10**9
    assert times[-1] < -(1 << 62)
    assert faulty.oddities("cam2")[Oddity.CLOCK_STEP] >= 1
    assert set(faulty.verdicts("cam2")) <= {Verdict.OK, Verdict.LOST}
    say(first_ns=times[0], last_ns=times[-1], oddities=dict(faulty.oddities("cam2")))


def test_flagged_frames_are_incomplete_and_not_on_disk(faulty: Recorded, say: Say) -> None:
    entries = [e for e in faulty.entries("cam3") if e.verdict == Verdict.INCOMPLETE]
    assert faulty.flagged == _FLAGS
    assert len(entries) == _FLAGS
    for entry in entries:
        assert entry.note == "the driver flagged an error"
        assert entry.trigger_index not in faulty.numbers["cam3"]
    say(injected=_FLAGS, found=len(entries))


def told(recorded: Recorded, device: str) -> str:
    """Where a device's numbers and indices part, with times in periods."""
    period, lines = 1e9 / _RATE_HZ, []
    entries = [entry for entry in recorded.entries(device) if entry.frame_id >= 0]
    for last, now in itertools.pairwise(entries):
        steps = (now.trigger_index - last.trigger_index, now.frame_id - last.frame_id)
        if steps[0] != steps[1]:
            time_step = (now.t_dev_ns - last.t_dev_ns) / period
            late = (now.t_host_ns - now.t_dev_ns) / period
            lines.append(f"index, number {steps}, time {time_step:.2f}, arrived {late:.2f} later")
    return "; ".join(lines)


@pytest.fixture(scope="module")
def parted(digits: Digits, tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """cam2 is disconnected in the middle of a take, and found again two seconds later."""
    array, devices = array_of_four()

    def during(live: LiveArray) -> int:
        time.sleep(1.5)
        devices[2].write_feature("disconnect", True)
        time.sleep(2.0)
        states = {state.name: state for state in live.states()}
        assert states["cam2"].colour == Colour.RED, states["cam2"]
        assert not devices[2].health().connected
        live.reconnect("cam2")
        return round(time.monotonic_ns())

    try:
        return record(tmp_path_factory.mktemp("parted"), 80, digits, array, during)
    finally:
        array.close()


def test_a_device_that_is_lost_and_found_costs_the_others_nothing(
    parted: Recorded, say: Say
) -> None:
    for name in ("cam0", "cam1", "cam3"):
        good = {e.trigger_index: e.frame_id for e in parted.entries(name) if e.verdict == "ok"}
        assert good == parted.numbers[name]
        assert len({number - k for k, number in good.items()}) == 1, told(parted, name)
        assert set(parted.verdicts(name)) <= {Verdict.OK, Verdict.LOST}
        assert parted.verdicts(name)[Verdict.LOST] <= 10
    say(lost_of_others=[parted.verdicts(name)[Verdict.LOST] for name in ("cam0", "cam1", "cam3")])


def test_its_frames_stand_before_and_after_the_gap(parted: Recorded, say: Say) -> None:
    entries = parted.entries("cam2")
    good = {e.trigger_index: e.frame_id for e in entries if e.verdict == Verdict.OK}
    assert good == parted.numbers["cam2"]
    gap = max(range(len(entries)), key=lambda k: min(abs(k - g) for g in good))
    before = {number - k for k, number in good.items() if k < gap}
    after = {number - k for k, number in good.items() if k > gap}
    assert len(before) == 1
    assert len(after) == 1
    assert before != after  # its numbers began again
    missing = len(entries) - len(good)
    assert 1.8 * _RATE_HZ < missing < 4.5 * _RATE_HZ
    for entry in entries:
        if entry.verdict == Verdict.OK:
            late_s = (entry.t_host_ns - parted.start_ns) / 1e9 - entry.trigger_index / _RATE_HZ
            assert -0.1 < late_s < 0.2, entry
    say(frames=len(good), gap_frames=missing, verdicts=dict(parted.verdicts("cam2")))
