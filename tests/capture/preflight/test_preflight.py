"""The whole preflight of simulated arrays that stream: all checks speak, none stops another."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from capture.calibration_link import link_calibration, make_reference
from capture.camera_file import write_cameras
from capture.devices.capabilities import PtpReading
from capture.devices.faults import Fault, FaultKind
from capture.devices.preset import Preset
from capture.devices.roster import ExpectedDevice, Sighting, compare
from capture.devices.simulated import StreamingDevice, streaming_array
from capture.disk import DiskForecast
from capture.errors import DeviceError, SettingsError, TakeError
from capture.frame_header import ImageLayout
from capture.judgement import Colour
from capture.live import LiveArray
from capture.preflight import Finding, PreflightSettings, Subject, preflight, worst
from capture.preflight.array_checks import (
    burst_findings,
    cautions,
    odd_settings,
    preset_findings,
    roster_findings,
)
from capture.preflight.look import Sight
from capture.preflight.run import session_exposure
from capture.recorder import RecordSettings
from tests.capture.recording import array_of, cameras, record

LAYOUT = ImageLayout(160, 120, 1, "uint8")
RECORD = RecordSettings(rate_hz=200, exposure_us=1000)
QUICK = PreflightSettings(burst=20, looks=8, ptp_hold_s=0.1, ptp_deadline_s=0.2)


def by_check(found: tuple[Finding, ...]) -> dict[str, list[Finding]]:
    out: dict[str, list[Finding]] = {}
    for finding in found:
        out.setdefault(finding.check, []).append(finding)
    return out


def forecast(colour: str) -> DiskForecast:
    return DiskForecast(
        free_bytes=1, take_bytes=1, takes_left=0, prompts_left=0, prompts_coming=0, colour=colour,
        sentence="Told by the disk.",
    )  # fmt: skip


def test_everything_speaks_and_nothing_stops_anything(tmp_path: Path) -> None:
    array = streaming_array(3, LAYOUT)
    path = tmp_path / "cameras.json"
    write_cameras(path, cameras(3))
    session = tmp_path / "session"
    session.mkdir()
    wrong = Preset("stage", (("ExposureTime", 1000.0), ("Gain", 6.0)))
    told: list[tuple[int, str]] = []
    with LiveArray(array, RECORD) as live:
        make_reference(
            {name: [image] for name, image in live.latest().items()},
            path.with_name("reference.npz"),
        )
        link_calibration(session, path)
        found = preflight(
            Subject(
                live=live, session=session, presets={"cam01": wrong},
                roster=compare([ExpectedDevice(name="x", backend="sim", serial="9")], Sighting(())),
                disk=lambda: forecast("red"),
            ),
            QUICK,
            progress=lambda done, total, what: told.append((done, what)),
        )  # fmt: skip
    checks = by_check(found)
    assert set(checks) == {
        "roster", "link", "memory", "disk", "preset", "calibration", "ptp", "sync", "exposure",
        "focus", "scene",
    }  # fmt: skip
    assert [finding.colour for finding in found] == sorted(
        (finding.colour for finding in found), key=("red", "amber", "green").index
    )
    assert checks["disk"][0].sentence == "Told by the disk."
    assert checks["preset"][0].sentence.startswith(
        "cam01 is not set as preset stage says: Gain: asked for 6.0, reads 0.0"
    )
    assert checks["roster"][0].colour == Colour.RED
    assert worst(checks["ptp"]) == worst(checks["calibration"]) == worst(checks["link"]) == "green"
    assert len(checks["scene"]) == 3
    assert told[-1] == (15, "preflight")
    assert (session / "start_levels.json").is_file()


def test_the_first_good_preflight_of_a_session_says_how_bright_it_began(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    bright, dim = (rng.integers(low, low + 60, (120, 160)).astype(np.uint8) for low in (90, 40))
    subject = Subject(live=LiveArray(streaming_array(1, LAYOUT), RECORD), session=tmp_path)
    black = {"cam00": Sight((np.zeros((120, 160), np.uint8),), ())}
    assert worst(session_exposure(subject, black)) == Colour.RED
    assert not (tmp_path / "start_levels.json").exists()
    assert worst(session_exposure(subject, {"cam00": Sight((bright,), ())})) == Colour.GREEN
    (finding,) = session_exposure(subject, {"cam00": Sight((dim,), ())})
    assert "cam00 is 42% darker than at session start" in finding.sentence
    (tmp_path / "start_levels.json").write_text('{"cam00": "x"}', encoding="utf-8")
    with pytest.raises(TakeError, match="expected levels of 0 to 1 by device; remove it"):
        session_exposure(subject, {"cam00": Sight((dim,), ())})


def test_a_check_that_fails_is_a_finding_and_the_rest_goes_on() -> None:
    live = LiveArray(streaming_array(2, LAYOUT), RECORD)  # never started: no burst, no images

    def broken() -> DiskForecast:
        raise DeviceError("the disk is gone")

    checks = by_check(preflight(Subject(live=live, disk=broken), QUICK))
    assert checks["disk"][0].sentence == ("The check of disk could not be made: the disk is gone")
    assert checks["sync"][0].sentence.startswith("The check of sync could not be made: the array")
    assert [finding.sentence for finding in checks["exposure"][:2]] == [
        "cam00 gave no image.", "cam01 gave no image."
    ]  # fmt: skip
    assert worst(checks["link"]) == Colour.GREEN


def test_clocks_that_are_not_locked_stop_the_recording() -> None:
    array = streaming_array(2, LAYOUT)
    for device in array.devices:
        assert isinstance(device, StreamingDevice)
        device.enable_ptp(True)
        if device.info.name == "cam01":
            device.set_ptp(PtpReading("listening"))
    with LiveArray(array, RECORD) as live:
        checks = by_check(preflight(Subject(live=live), QUICK))
    assert [finding.device for finding in checks["ptp"]] == ["cam01"]
    assert checks["ptp"][0].colour == Colour.RED


def test_the_burst_names_who_failed_and_why() -> None:
    pre = RecordSettings().edge_triggers
    lose = [Fault(FaultKind.LOSE_FRAME, pre + edge) for edge in (5, 9, 13)]
    miss = [Fault(FaultKind.MISS_TRIGGER, pre + 7)]
    recording, _ = record(array_of(4, faults={"cam01": lose, "cam02": miss}))
    found = burst_findings(recording)
    assert [(finding.device, finding.colour) for finding in found] == [
        ("cam01", Colour.RED), ("cam02", Colour.AMBER)
    ]  # fmt: skip
    assert found[0].sentence == "cam01 failed 3 of 20 triggers of the burst: 3 lost."
    assert found[0].remedy.startswith("1. See MTU")
    assert "1 missed trigger." in found[1].sentence
    good, _ = record(array_of(4))
    (finding,) = burst_findings(good)
    assert finding.colour == Colour.GREEN
    assert "All 20 frame sets of 4 devices are complete." in finding.sentence


def test_odd_settings_are_named() -> None:
    devices = streaming_array(4, LAYOUT).devices
    assert odd_settings(devices) == []
    devices[2].write_feature("Gain", 3.0)  # type: ignore[attr-defined]
    (finding,) = odd_settings(devices)
    assert finding.sentence == "cam02 has Gain = 3.0, the others of its model have 0.0."
    devices[1].write_feature("Gain", 5.0)  # type: ignore[attr-defined]
    devices[0].write_feature("Gain", 5.0)  # type: ignore[attr-defined]
    assert odd_settings(devices) == [], "no value is usual"
    for device, gain in zip(devices, (20.0, 20.1, 20.2, 3.0), strict=True):
        device.write_feature("Gain", gain)  # type: ignore[attr-defined]
    (finding,) = odd_settings(devices)
    assert finding.device == "cam03", "what is rounded to other steps is not odd"


class Worried(StreamingDevice):
    """A device that knows of something."""

    problems = ("triggers come too fast; lower the rate", "its fan stands still")


def test_what_a_device_says_of_itself_is_told_with_its_remedy() -> None:
    devices = streaming_array(2, LAYOUT).devices
    assert cautions(devices) == []
    devices[1].__class__ = Worried
    assert [(one.device, one.colour, one.sentence, one.remedy) for one in cautions(devices)] == [
        ("cam01", Colour.AMBER, "cam01 says: triggers come too fast.", "lower the rate"),
        ("cam01", Colour.AMBER, "cam01 says: its fan stands still.", ""),
    ]


def test_a_preset_that_does_not_hold_names_its_device_once() -> None:
    devices = streaming_array(1, LAYOUT).devices
    (finding,) = preset_findings(devices, {"cam00": Preset("day", (("Gian", 3.0),))})
    assert finding.sentence == (
        "cam00 is not set as preset day says: Gian: asked for 3.0, reads nothing "
        "(no feature 'Gian'; did you mean 'Gain'?)."
    )


def test_a_roster_that_is_whole_is_green() -> None:
    assert roster_findings(()) == []


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(SettingsError, match=r"preflight\.burst = 1: must be at least 10"):
        PreflightSettings(burst=1)
