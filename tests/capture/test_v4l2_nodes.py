"""Nodes that are not there or are something else; a number weighs more than a late time."""

from __future__ import annotations

from pathlib import Path

import pytest

from capture.clock_model import ClockModel
from capture.collate import Collator, DeviceClock, TriggerTrain
from capture.devices.backend import load_backend
from capture.devices.v4l2 import backend
from capture.errors import DeviceError
from capture.frame import FrameEvent
from capture.ledger import Verdict
from tests.capture.v4l2_driver import PERIOD_NS, PlayedDriver, device_of


def test_the_backend_is_found_by_its_name() -> None:
    assert load_backend("v4l2") is backend
    assert backend.name == "v4l2"


def test_discovery_works_without_any_device() -> None:
    assert all(each.backend == "v4l2" for each in backend.discover())


def test_no_such_node(tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match=r"/video9: there is no such node; `likeness devices`"):
        backend.open(str(tmp_path / "video9"), "cam")


def test_a_file_is_no_device(tmp_path: Path) -> None:
    (tmp_path / "video0").write_bytes(b"")
    with pytest.raises(DeviceError, match=r"video0: this is not a device"):
        backend.open(str(tmp_path / "video0"), "cam")


def test_another_device_is_not_a_video_device() -> None:
    with pytest.raises(DeviceError, match=r"/dev/null: not a video device"):
        backend.open("/dev/null", "cam")


def test_a_serial_that_is_not_there() -> None:
    with pytest.raises(DeviceError, match=r"no video device 'SN-none'; found: "):
        backend.open("SN-none", "cam")


def test_a_late_stamp_moves_no_frame_of_a_stalled_host() -> None:
    """A busy host dates a frame late and fetches it seconds later; its number is one higher."""
    info = device_of(PlayedDriver()).info
    train = TriggerTrain(0, PERIOD_NS)
    collator = Collator([info], train, {info.name: DeviceClock(ClockModel(0, 0), fitted=False)})
    late = {10: 0.4, 11: 0.1, 20: 0.3, 21: 0.45}
    for number in range(40):
        t_ns = round((number + late.get(number, 0.0)) * PERIOD_NS)
        stalled = 9 * PERIOD_NS if 10 <= number < 14 else 0
        event = FrameEvent(info.name, number, t_ns, t_ns + PERIOD_NS // 4 + stalled, number)
        assert collator.add(event) == number
    ledger = collator.ledger(0, 40)
    assert ledger.counts()[Verdict.OK] == 40
    assert ledger.remarks == ()  # the host's own clock does not step by parts of a period
