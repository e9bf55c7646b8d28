"""Simulated devices: hardware-trigger semantics, own clocks, faults, scenes by entry point."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from capture.arrays import Image
from capture.camera import Camera
from capture.devices.array import DeviceArray
from capture.devices.protocol import TriggerKind, TriggerSpec
from capture.devices.simulated import (
    Fault,
    FaultKind,
    SimulatedDevice,
    SimulatedLine,
    SimulatedSettings,
    load_scene,
)  # fmt: skip
from capture.errors import DeviceError, SettingsError, TakeError
from capture.frame import Clock, FrameEvent
from tests.capture.recording import StampScene, array_of, cameras, stamp

SPEC = TriggerSpec(kind=TriggerKind.HARDWARE, period_ns=10_000_000, exposure_us=2000.0)


def one(settings: SimulatedSettings) -> tuple[SimulatedLine, SimulatedDevice, StampScene]:
    line, scene = SimulatedLine(), StampScene()
    device = SimulatedDevice(cameras(1)[0], scene, line, settings)
    device.prepare(SPEC)
    device.start()
    return line, device, scene


def test_a_frame_arrives_after_exposure_and_latency_and_not_before() -> None:
    line, device, _ = one(SimulatedSettings(latency_ms=5.0, latency_jitter_ms=0.0))
    line.fire(1_000_000)
    line.wait(1_000_000 + 2_000_000 + 5_000_000 - 1)
    assert device.poll() == []
    line.wait(1_000_000 + 2_000_000 + 5_000_000)
    [event] = device.poll()
    assert (event.device, event.frame_id, event.t_dev_ns) == ("cam00", 1, 1_000_000)
    assert event.t_host_ns == 8_000_000
    assert device.poll() == []


def test_pixels_are_those_of_the_true_trigger_time_whatever_the_clock_says() -> None:
    clock = Clock(offset_ns=10**12, drift_ppm=500.0, jitter_ns=5000.0)
    line, device, scene = one(SimulatedSettings(clock=clock))
    for k in range(3):
        line.fire(10**9 + 10_000_000 * k)
    line.wait(2 * 10**9)
    events = device.poll()
    assert scene.rendered == []  # nothing is rendered before it is fetched
    for k, event in reversed(list(enumerate(events))):
        assert np.array_equal(device.pixels(event), stamp(device.camera, 10**9 + 10_000_000 * k))
        device.release(event)


def test_frames_of_one_device_arrive_in_order_whatever_the_jitter() -> None:
    line, device, _ = one(SimulatedSettings(latency_jitter_ms=50.0, seed=1))
    for k in range(50):
        line.fire(10_000_000 * k)
    line.wait(10**10)
    events = device.poll()
    assert [event.frame_id for event in events] == list(range(1, 51))
    arrivals = [event.t_host_ns for event in events]
    assert arrivals == sorted(arrivals)


def test_devices_of_an_array_deliver_out_of_order_among_each_other() -> None:
    array = array_of(6)
    array.prepare(SPEC.period_ns, SPEC.exposure_us)
    events: list[FrameEvent] = []
    for device in array.devices:
        device.acquire.start()
    for k in range(1, 9):
        array.line.fire(10_000_000 * k)
        for device in array.devices:
            events += device.frames.poll()
    order = [event.device for event in sorted(events, key=lambda event: event.t_host_ns)]
    assert order[:6] != sorted(order[:6])
    assert len({event.t_dev_ns // 10**9 for event in events}) > 3  # clocks seconds apart


@pytest.mark.parametrize(
    ("kind", "ids", "complete"),
    [
        (FaultKind.LOSE_FRAME, [1, 2, 4, 5], 4),
        (FaultKind.MISS_TRIGGER, [1, 2, 3, 4], 4),
        (FaultKind.DUPLICATE, [1, 2, 3, 3, 4, 5], 6),
        (FaultKind.STALE, [1, 2, 3, 1, 4, 5], 6),
        (FaultKind.INCOMPLETE, [1, 2, 3, 4, 5], 4),
        (FaultKind.ID_RESET, [1, 2, 1, 2, 3], 5),
        (FaultKind.ID_JUMP, [1, 2, 65532, 65533, 65534], 5),
        (FaultKind.CLOCK_DRIFT, [1, 2, 3, 4, 5], 5),
        (FaultKind.FREEZE, [1, 2, 4, 5], 4),
        (FaultKind.DEATH, [1, 2], 2),
    ],
)
def test_each_fault_does_what_it_says(kind: FaultKind, ids: list[int], complete: int) -> None:
    line, device, _ = one(SimulatedSettings(faults=(Fault(kind, 2),)))
    for k in range(5):
        line.fire(10_000_000 * k)
    line.wait(10**9)
    events = device.poll()
    assert [event.frame_id for event in events] == ids
    assert sum(event.complete for event in events) == complete


def test_a_clock_step_stays() -> None:
    line, device, _ = one(SimulatedSettings(faults=(Fault(FaultKind.CLOCK_STEP, 2, 777),)))
    for k in range(5):
        line.fire(10_000_000 * k)
    line.wait(10**9)
    assert [event.t_dev_ns - 10_000_000 * k for k, event in enumerate(device.poll())] == [
        0, 0, 777, 777, 777,
    ]  # fmt: skip


def test_a_fault_that_is_put_in_while_it_runs_hits_the_next_edge_once() -> None:
    line, device, _ = one(SimulatedSettings())
    line.fire(0)
    device.inject(Fault(FaultKind.LOSE_FRAME, triggers=2))
    for k in range(1, 5):
        line.fire(10_000_000 * k)
    line.wait(10**9)
    assert [event.frame_id for event in device.poll()] == [1, 4, 5]
    device.start()
    line.fire(10**9)
    line.wait(2 * 10**9)
    assert [event.frame_id for event in device.poll()] == [6]


def test_a_latch_brackets_the_clock() -> None:
    line, device, _ = one(SimulatedSettings(clock=Clock(offset_ns=10**9)))
    line.wait(5_000_000)
    sample = device.latch()
    assert sample.before_ns <= sample.t_dev_ns - 10**9 <= sample.after_ns


def test_a_stopped_device_answers_no_edge() -> None:
    line, device, _ = one(SimulatedSettings())
    device.stop()
    line.fire(0)
    line.wait(10**9)
    assert device.poll() == []


def test_what_a_device_cannot_do_is_said_for_every_device() -> None:
    array = array_of(2)
    with pytest.raises(
        DeviceError, match=r"2 of 2 devices not ready:\n.*cam00: asked for action .*\n"
    ):
        replace(array, trigger=TriggerKind.ACTION).prepare(10**7, 10)
    with pytest.raises(DeviceError, match="cam00: started before it was prepared"):
        SimulatedDevice(cameras(1)[0], StampScene(), SimulatedLine(), SimulatedSettings()).start()


def test_a_scene_of_another_size_is_refused() -> None:
    class Wide:
        def render(self, camera: Camera, t_ns: int) -> Image:
            return np.zeros((camera.height, camera.width + 1), np.uint8)

    line = SimulatedLine()
    device = SimulatedDevice(cameras(1)[0], Wide(), line, SimulatedSettings())
    device.prepare(SPEC)
    device.start()
    line.fire(0)
    line.wait(10**9)
    [event] = device.poll()
    with pytest.raises(DeviceError, match="the scene gave 33 x 8 mono uint8, expected 32 x 8"):
        device.pixels(event)


def test_settings_that_cannot_be_are_refused() -> None:
    with pytest.raises(SettingsError, match=r"id_bits must lie in 8\.\.64, found 4"):
        SimulatedSettings(id_bits=4)
    with pytest.raises(SettingsError, match="first_id must fit 16 bits, found 0"):
        SimulatedSettings(first_id=0)
    with pytest.raises(
        SettingsError, match="faults of unknown devices: cam9; there are cam00, cam01"
    ):
        array_of(2, faults={"cam9": [Fault(FaultKind.DUPLICATE, 1)]})
    with pytest.raises(SettingsError, match="between 0 and the period of 10000 us, found 20000"):
        TriggerSpec(kind=TriggerKind.HARDWARE, period_ns=10**7, exposure_us=20_000)
    one_device = array_of(1).devices
    with pytest.raises(TakeError, match="'cam00' is there twice"):
        DeviceArray(one_device + one_device, SimulatedLine())


def test_scenes_are_found_by_entry_point() -> None:
    with pytest.raises(SettingsError, match="no scene 'moon'; installed: "):
        load_scene("moon")
