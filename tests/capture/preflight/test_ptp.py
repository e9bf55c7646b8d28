"""The PTP gate opens for locked clocks only, never touches a device, and says who is not locked."""

from __future__ import annotations

from collections.abc import Callable

from capture.devices.capabilities import PtpReading
from capture.devices.simulated import StreamingDevice, streaming_array
from capture.frame_header import ImageLayout
from capture.judgement import Colour
from capture.preflight.ptp import (
    PtpGate,
    Watch,
    lock_problems,
    ptp_changes,
    ptp_findings,
    read_ptp,
    wait_for_lock,
)

GATE = PtpGate(hold_s=10, deadline_s=60)


class Hours(Watch):
    """Time that passes by sleeping; something may happen at a given second."""

    def __init__(self, at_s: float = 1e9, happens: Callable[[], None] = lambda: None) -> None:
        self.t_s, self._at_s, self._happens = 0.0, at_s, happens
        super().__init__(self._now, self._sleep)

    def _now(self) -> float:
        return self.t_s

    def _sleep(self, seconds: float) -> None:
        before, self.t_s = self.t_s, self.t_s + seconds
        if before < self._at_s <= self.t_s:
            self._happens()


def clocks(count: int = 3, on: bool = True) -> dict[str, StreamingDevice]:
    devices = streaming_array(count, ImageLayout(32, 32, 1, "uint8")).devices
    for device in devices:
        device.enable_ptp(on)  # type: ignore[attr-defined]
    return {device.info.name: device for device in devices}  # type: ignore[misc]


def test_locked_clocks_pass_after_the_time_they_must_hold() -> None:
    watch, told = Hours(), []
    (finding,) = wait_for_lock(
        clocks(), GATE, progress=lambda done, total, what: told.append((done, total)), watch=watch
    )
    assert finding.colour == Colour.GREEN
    assert finding.sentence.startswith("3 clocks have been locked for 10 s, at most ")
    assert watch.t_s == 10
    assert told[0] == (0, 100)
    assert told[-1] == (100, 100)


def test_a_step_begins_the_hold_anew() -> None:
    devices = clocks()
    good = devices["cam01"].ptp()

    def step() -> None:
        devices["cam01"].set_ptp(PtpReading("slave", 4000, good.grandmaster))
        watch.__init__(watch.t_s, lambda: devices["cam01"].set_ptp(good))  # type: ignore[misc]

    watch = Hours(8.0, step)
    (finding,) = wait_for_lock(devices, GATE, watch=watch)
    assert finding.colour == Colour.GREEN
    assert watch.t_s >= 10


def test_a_listening_clock_is_waited_for_and_left_alone() -> None:
    devices = clocks()
    good = devices["cam02"].ptp()
    devices["cam02"].set_ptp(PtpReading("listening"))
    watch = Hours(30.0, lambda: devices["cam02"].set_ptp(good))
    (finding,) = wait_for_lock(devices, GATE, watch=watch)
    assert (finding.colour, watch.t_s) == (Colour.GREEN, 40.0)
    devices["cam02"].set_ptp(PtpReading("listening"))
    watch = Hours()
    (finding,) = wait_for_lock(devices, GATE, watch=watch)
    assert watch.t_s == 60
    assert (finding.colour, finding.device) == (Colour.RED, "cam02")
    assert finding.sentence == "The clock of cam02 is not locked: listening."
    assert finding.remedy.startswith("Leave it alone")
    assert devices["cam02"].read_feature("PtpEnable") is True


def test_a_clock_that_locks_too_late_is_told_so() -> None:
    devices = clocks()
    good = devices["cam00"].ptp()
    devices["cam00"].set_ptp(PtpReading("uncalibrated"))
    (finding,) = wait_for_lock(
        devices, GATE, watch=Hours(55.0, lambda: devices["cam00"].set_ptp(good))
    )
    assert finding.colour == Colour.AMBER
    assert "locked for 5 s only, 10 s are wanted, after 60 s" in finding.sentence


def test_problems_name_state_offset_and_grandmaster() -> None:
    readings = {
        "a": PtpReading("slave", 200, "G1"),
        "b": PtpReading("slave", -2500, "G1"),
        "c": PtpReading("master", None, "G2"),
        "d": PtpReading("disabled"),
    }
    found = lock_problems(readings)
    assert [(finding.device, finding.colour) for finding in found] == [
        ("b", Colour.RED), ("d", Colour.RED), ("c", Colour.RED)
    ]  # fmt: skip
    assert "b is -2.5 us from its master; less than 1 us is wanted" in found[0].sentence
    assert "c follows grandmaster G2, the others G1" in found[2].sentence
    assert lock_problems({"a": readings["a"]}) == []


def test_a_device_that_does_not_answer_is_not_locked() -> None:
    devices = clocks()
    devices["cam01"].close()
    states = {name: reading.state for name, reading in read_ptp(devices).items()}
    assert states == {"cam00": "slave", "cam01": "no answer", "cam02": "slave"}
    (finding,) = wait_for_lock(devices, GATE, watch=Hours())
    assert finding.sentence == "The clock of cam01 is not locked: no answer."


def test_arrays_without_ptp_need_none_unless_triggers_go_by_it() -> None:
    off = clocks(on=False)
    (finding,) = ptp_findings(off, GATE, watch=Hours())
    assert finding.colour == Colour.GREEN
    assert "PTP is switched off" in finding.sentence
    found = ptp_findings(off, GATE, needed=True, watch=Hours())
    assert [finding.colour for finding in found] == [Colour.RED] * 3
    assert ptp_findings({}, GATE) == []


def test_changes_during_a_take_are_told() -> None:
    def readings(offset: int, master: str = "G", state: str = "slave") -> dict[str, PtpReading]:
        return {"a": PtpReading("slave", 100, "G"), "b": PtpReading(state, offset, master)}

    assert ptp_changes([readings(0), readings(9000), readings(2000)]) == []
    (step,) = ptp_changes([readings(0), readings(12_000), readings(0)])
    assert step.sentence == "The clock of b stepped by +12 us during the take."
    (master,) = ptp_changes([readings(0), readings(0, "H")])
    assert master.sentence == "b changed its grandmaster during the take: G to H."
    (lost,) = ptp_changes([readings(0), readings(0, state="listening")])
    assert (lost.colour, lost.device) == (Colour.AMBER, "b")
    assert "not locked during the take: listening" in lost.sentence
