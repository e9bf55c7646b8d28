from __future__ import annotations

import threading

import pytest

from capture.devices.watchdog import Watchdog
from capture.errors import DeviceError


def test_a_call_gives_its_result_and_its_error_to_who_asked() -> None:
    dog = Watchdog("cam01")
    assert dog.call(lambda: 6 * 7, 5.0) == 42
    with pytest.raises(ZeroDivisionError):
        dog.call(lambda: 1 // 0, 5.0)
    assert dog.call(lambda: "still there", 5.0) == "still there"
    assert dog.call(lambda: dog.call(lambda: "from within", 0.0), 5.0) == "from within"
    dog.close()


def test_calls_run_on_one_thread_in_their_order() -> None:
    dog = Watchdog("cam01")
    seen: list[int] = []
    names = [
        dog.call(lambda n=n: (seen.append(n), threading.current_thread().name)[1], 5.0)
        for n in range(20)
    ]
    assert seen == list(range(20))
    assert set(names) == {"control cam01"}
    dog.close()


def test_a_device_that_hangs_is_named_and_holds_up_nobody_else() -> None:
    hangs, other = Watchdog("cam07"), Watchdog("cam08")
    let_go, late = threading.Event(), threading.Event()
    with pytest.raises(DeviceError, match=r"^cam07: did not answer for 0\.1 s$"):
        hangs.call(lambda: (let_go.wait(), late.set()), 0.1)
    assert hangs.stuck
    with pytest.raises(DeviceError, match=r"^cam07: has not answered for \d+\.\d s$"):
        hangs.call(lambda: 1, 60.0)  # at once, not after a minute
    assert other.call(lambda: 2, 5.0) == 2
    parting = hangs.post(lambda: None)
    assert not parting.is_set()
    let_go.set()
    assert late.wait(5.0)
    assert parting.wait(5.0)
    assert not hangs.stuck
    assert hangs.call(lambda: 3, 5.0) == 3
    hangs.close()
    other.close()


def test_a_call_that_waits_behind_another_is_not_made_later() -> None:
    dog = Watchdog("cam01")
    begun, let_go, made = threading.Event(), threading.Event(), threading.Event()
    dog.post(lambda: (begun.set(), let_go.wait()))
    assert begun.wait(5.0)
    with pytest.raises(DeviceError, match=r"^cam01: was busy with other calls for 0\.1 s$"):
        dog.call(made.set, 0.1)
    assert not dog.stuck
    let_go.set()
    assert dog.call(lambda: 1, 5.0) == 1
    assert not made.is_set()
    dog.close()


def test_a_closed_one_finishes_and_refuses_more() -> None:
    dog = Watchdog("cam01")
    last = dog.post(lambda: None)
    dog.close()
    dog.close()
    assert last.wait(5.0)
    with pytest.raises(DeviceError, match="cam01: is closed"):
        dog.call(lambda: 1, 1.0)


def test_an_error_of_a_posted_work_ends_nothing() -> None:
    dog = Watchdog("cam01")
    assert dog.post(lambda: 1 // 0).wait(5.0)
    assert dog.call(lambda: 1, 5.0) == 1
    dog.close()
