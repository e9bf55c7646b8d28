"""The contract of a device: every promise of `protocol` and `capabilities`, kept by any backend.

What a device cannot do is skipped, saying so. Devices that are not played lose frames as they
please, so of them only what holds for any device is asked.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from capture.devices.capabilities import (
    Featured,
    FeatureValue,
    Latching,
    Monitored,
    PtpClocked,
    Reconnecting,
    SoftwareTriggered,
)
from capture.devices.protocol import ClockKind, TriggerKind
from capture.errors import DeviceError
from capture.frame_header import ImageLayout
from capture.names import is_plain_name
from tests.capture.devices.bench import Bench, refusal

# Settings that most devices have, and that do no harm when they are written.
USUAL = ("Gain", "ExposureTime", "ExposureTimeAbs", "BlackLevel", "brightness", "contrast", "gain")
PROMPT_S = 1.0  # a call that never waits may take so long on a machine that is busy


def lacks(bench: Bench, capability: type) -> None:
    if not isinstance(bench.device, capability):
        pytest.skip(f"{bench.device.info.model} is not {capability.__name__}")


def prompt(work: Callable[[], object]) -> object:
    began = time.monotonic()
    result = work()
    assert time.monotonic() - began < PROMPT_S
    return result


def test_a_device_says_what_it_is(plain: Bench) -> None:
    info = plain.device.info
    assert info.name == "cam00"
    assert is_plain_name(info.name)
    assert info.serial.strip()
    assert info.model.strip()
    assert 8 <= info.id_bits <= 64
    assert info.first_id in (0, 1)
    assert info.triggers
    assert len(set(info.triggers)) == len(info.triggers)
    assert is_plain_name(info.transport)
    assert info.link_mbps is None or info.link_mbps > 0
    assert isinstance(info.layout, ImageLayout)


def test_frames_come_in_order_of_arrival_dated_by_the_hosts_clock(bench: Bench) -> None:
    before = time.monotonic_ns()
    bench.ready()
    events = bench.collect(10)
    after = time.monotonic_ns()
    arrivals = [event.t_host_ns for event in events]
    assert arrivals == sorted(arrivals)
    assert before < arrivals[0]
    assert arrivals[-1] <= after
    assert {event.device for event in events} == {"cam00"}
    if bench.device.info.clock == ClockKind.HOST:
        assert all(before <= event.t_dev_ns <= event.t_host_ns for event in events)
    bench.release(events)


def test_frame_numbers_count_and_fit_their_bits(bench: Bench) -> None:
    info = bench.device.info
    bench.ready()
    ids = []
    for _ in range(4):
        events = bench.collect(6)
        ids += [event.frame_id for event in events]
        bench.release(events)
    assert all(info.first_id <= number < 1 << info.id_bits for number in ids)
    span = (1 << info.id_bits) - info.first_id
    steps = [(b - a) % span for a, b in pairwise(ids)]
    if bench.played:
        assert set(steps) == {1}
    else:  # it may lose some, not most
        assert steps.count(1) > len(steps) / 2


def test_device_times_go_forward_by_the_period(bench: Bench) -> None:
    if not bench.played:
        pytest.skip("only a played device keeps its period exactly")
    bench.ready()
    events = bench.collect(10)
    bench.release(events)
    steps = [b.t_dev_ns - a.t_dev_ns for a, b in pairwise(events)]
    if bench.kind == TriggerKind.FREE_RUN:
        assert max(abs(step - bench.period_ns) for step in steps) < 50_000
    assert min(steps) > 0


def test_images_have_the_layout_that_was_announced(bench: Bench) -> None:
    layout = bench.device.info.layout
    bench.ready()
    events = bench.collect(3)
    for event in events:
        image = bench.device.frames.pixels(event)
        assert (image.shape, image.dtype.name) == (layout.shape, layout.dtype)
    bench.release(events)


def test_a_view_stays_as_it_is_until_it_is_released(bench: Bench) -> None:
    bench.ready()
    held = bench.collect(2)[:2]
    views = [bench.device.frames.pixels(event) for event in held]
    copies = bench.copies(held)
    for _ in range(4):
        bench.release(bench.collect(4))
    for view, copy in zip(views, copies, strict=True):
        assert np.array_equal(view, copy)
    bench.release(held)


def test_when_all_memory_is_taken_frames_are_lost_and_none_is_overwritten(bench: Bench) -> None:
    bench.ready(frames=5)
    held = bench.collect(4 if bench.played else 2)  # a driver may keep some back
    held += bench.listen(periods=10)
    copies = bench.copies(held)
    assert bench.listen(periods=10) == []
    assert not bench.played or len(held) == 5
    assert all(np.array_equal(a, b) for a, b in zip(bench.copies(held), copies, strict=True))
    last = held[-1]
    bench.release(held)
    again = bench.collect(3)
    fresh = [event for event in again if event.frame_id != last.frame_id]
    assert fresh
    if bench.played:
        info = bench.device.info
        assert (fresh[0].frame_id - last.frame_id) % ((1 << info.id_bits) - info.first_id) > 5
    bench.release(again)


def test_memory_and_trigger_may_be_set_up_in_either_order(bench: Bench) -> None:
    bench.device.trigger.prepare(bench.spec())
    bench.device.frames.reserve(8)
    bench.device.acquire.start()
    bench.release(bench.collect(2))


def test_polling_never_waits(plain: Bench) -> None:
    device = plain.device
    device.frames.reserve(8)
    device.trigger.prepare(plain.spec())
    assert list(prompt(device.frames.poll)) == []  # type: ignore[call-overload]
    device.acquire.start()
    for _ in range(50):
        plain.release(list(prompt(device.frames.poll)))  # type: ignore[call-overload]
    device.acquire.stop()
    plain.release(list(prompt(device.frames.poll)))  # type: ignore[call-overload]
    device.close()
    assert list(prompt(device.frames.poll)) == []  # type: ignore[call-overload]


def test_images_can_be_fetched_and_released_in_another_thread(bench: Bench) -> None:
    bench.ready(frames=6)
    layout = bench.device.info.layout
    with ThreadPoolExecutor(1) as other:
        for _ in range(5):  # more frames than there is memory, so that it must come back
            events = bench.collect(3)
            shapes = other.submit(lambda: [image.shape for image in bench.copies(events)])  # noqa: B023
            assert shapes.result() == [layout.shape] * len(events)
            other.submit(bench.release, events).result()
            bench.release(bench.collect(1))


def test_a_stopped_device_falls_silent_and_starts_again(bench: Bench) -> None:
    bench.ready()
    bench.release(bench.collect(3))
    bench.device.acquire.stop()
    time.sleep(max(0.05, 5e-9 * bench.period_ns))
    bench.release(list(bench.device.frames.poll()))  # what was exposed may still come
    time.sleep(5e-9 * bench.period_ns)
    assert list(bench.device.frames.poll()) == []
    bench.device.acquire.start()
    events = bench.collect(3)
    assert [event.t_host_ns for event in events] == sorted(event.t_host_ns for event in events)
    bench.release(events)


def test_frames_held_over_a_stop_stay_and_can_be_released(bench: Bench) -> None:
    bench.ready()
    held = bench.collect(2)
    copies = bench.copies(held)
    bench.device.acquire.stop()
    assert all(np.array_equal(a, b) for a, b in zip(bench.copies(held), copies, strict=True))
    bench.release(held)
    bench.device.acquire.start()
    bench.release(bench.collect(2))


def test_a_device_can_be_closed_twice_and_while_it_runs(bench: Bench) -> None:
    bench.ready()
    bench.release(bench.collect(1))
    bench.device.close()
    bench.device.close()
    assert list(bench.device.frames.poll()) == []


def test_a_device_that_was_never_started_can_be_closed(plain: Bench) -> None:
    plain.device.close()


def test_a_trigger_that_is_not_offered_is_refused_naming_those_that_are(plain: Bench) -> None:
    offered = plain.device.info.triggers
    for kind in set(TriggerKind) - set(offered):
        text = refusal(lambda: plain.device.trigger.prepare(replace(plain.spec(), kind=kind)))  # noqa: B023
        assert str(kind) in text
        assert all(str(other) in text for other in offered)
    plain.ready()  # and nothing is broken by it
    plain.release(plain.collect(2))


def test_a_clock_is_read_between_two_readings_of_the_hosts(plain: Bench) -> None:
    lacks(plain, Latching)
    assert isinstance(plain.device, Latching)
    before = time.monotonic_ns()
    plain.ready()
    samples = []
    for _ in range(4):
        samples.append(plain.device.latch())
        time.sleep(0.03)
    assert before <= samples[0].before_ns
    assert samples[-1].after_ns <= time.monotonic_ns()
    for a, b in pairwise(samples):
        assert a.before_ns <= a.after_ns <= b.before_ns
        step, slack = b.t_dev_ns - a.t_dev_ns, 2_000_000
        assert b.before_ns - a.after_ns - slack <= step <= b.after_ns - a.before_ns + slack


def test_frames_are_dated_by_the_clock_that_is_read(bench: Bench) -> None:
    lacks(bench, Latching)
    assert isinstance(bench.device, Latching)
    bench.ready()
    before = bench.device.latch().t_dev_ns
    events = bench.collect(5)
    after = bench.device.latch().t_dev_ns
    slack = 2 * bench.period_ns
    assert all(before - slack <= event.t_dev_ns <= after + slack for event in events)
    bench.release(events)


def test_an_unknown_setting_is_refused_naming_the_nearest(plain: Bench) -> None:
    lacks(plain, Featured)
    assert isinstance(plain.device, Featured)
    name = max(plain.device.features().values, key=len)
    wrong = f"{name[:-2]}{name[-1]}"
    for text in (
        refusal(lambda: plain.device.read_feature(wrong)),  # type: ignore[attr-defined]
        refusal(lambda: plain.device.write_feature(wrong, 1)),  # type: ignore[attr-defined]
    ):
        assert wrong in text
        assert name in text


def test_settings_read_back_as_they_are_written_and_a_dump_has_them_all(plain: Bench) -> None:
    lacks(plain, Featured)
    assert isinstance(plain.device, Featured)
    dump = plain.device.features()
    assert dump.values
    assert not set(dump.values) & set(dump.unread)
    digest = hashlib.sha256(dump.description.encode()).hexdigest() if dump.description else ""
    assert dump.description_sha256 == digest
    for name, value in list(dump.values.items())[:20]:
        assert type(plain.device.read_feature(name)) is type(value)
    assert written_back(plain.device, dict(dump.values)) > 0


def written_back(device: Featured, values: dict[str, FeatureValue]) -> int:
    """Write numbers as they are; how many were taken. Those must read as before."""
    usual = [name for name in USUAL if name in values]
    taken = 0
    for name in usual or list(values)[:10]:
        value = values[name]
        if isinstance(value, bool | str):
            continue
        try:
            device.write_feature(name, value)
        except DeviceError:
            continue  # it cannot be set, or not now
        found = device.read_feature(name)
        assert not isinstance(found, bool | str)
        assert found == pytest.approx(value, rel=1e-3)
        taken += 1
    return taken


def test_a_value_out_of_range_is_refused_naming_the_setting(plain: Bench) -> None:
    lacks(plain, Featured)
    assert isinstance(plain.device, Featured)
    values = plain.device.features().values
    name = next((n for n in USUAL if n in values), "")
    if not name:
        pytest.skip(f"{plain.device.info.model} has no setting known to have a range")
    text = refusal(lambda: plain.device.write_feature(name, 1e15))  # type: ignore[attr-defined]
    assert name in text
    assert plain.device.read_feature(name) == values[name]


def test_health_is_told_and_never_raised(plain: Bench) -> None:
    lacks(plain, Monitored)
    assert isinstance(plain.device, Monitored)
    plain.ready()
    events = plain.collect(2)
    health = plain.device.health()
    assert health.connected
    assert health.free >= -1
    assert all(isinstance(count, int) for count in health.counters.values())
    plain.release(events)
    plain.device.close()
    assert not plain.device.health().connected


def test_ptp_is_switched_on_and_off(plain: Bench) -> None:
    lacks(plain, PtpClocked)
    assert isinstance(plain.device, PtpClocked)
    try:
        plain.device.enable_ptp(True)
    except DeviceError as error:
        pytest.skip(f"{plain.device.info.model}: {error}")
    assert plain.device.ptp().state == plain.device.ptp().state.lower()
    assert plain.device.ptp().state != "disabled"
    plain.device.enable_ptp(False)
    assert not plain.device.ptp().locked


def test_a_device_exposes_when_it_is_told_to(plain: Bench) -> None:
    lacks(plain, SoftwareTriggered)
    assert isinstance(plain.device, SoftwareTriggered)
    plain.device.frames.reserve(8)
    plain.device.trigger.prepare(replace(plain.spec(), kind=TriggerKind.SOFTWARE))
    plain.device.acquire.start()
    quiet = plain.kind
    plain.kind = TriggerKind.FREE_RUN  # so that the bench sends nothing
    assert plain.listen(periods=5) == []
    plain.device.fire()
    events = plain.collect(1)
    assert len(events) == 1
    assert plain.listen(periods=5) == []
    plain.release(events)
    plain.kind = quiet


def test_a_device_comes_back_after_it_was_closed(bench: Bench) -> None:
    lacks(bench, Reconnecting)
    assert isinstance(bench.device, Reconnecting)
    bench.ready()
    held = bench.collect(1)
    view, copy = bench.device.frames.pixels(held[0]), bench.copies(held)[0]
    bench.device.close()
    bench.device.reconnect()  # open, prepared as before, started
    assert np.array_equal(view, copy)
    bench.release(held)
    events = bench.collect(3)
    assert [event.t_host_ns for event in events] == sorted(event.t_host_ns for event in events)
    bench.release(events)
