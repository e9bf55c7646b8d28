"""Checks of the array as a whole: roster, presets, odd settings, the sync burst."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from capture.devices.capabilities import Cautioned, Featured, FeatureValue
from capture.devices.preset import Preset, alike, compare_preset
from capture.devices.protocol import Device
from capture.devices.roster import Finding as RosterFinding
from capture.devices.roster import FindingKind
from capture.disk import DiskForecast
from capture.errors import DeviceError
from capture.judgement import Colour, judge
from capture.names import unnamed
from capture.preflight.finding import Finding, steps
from capture.recorder import Recording
from capture.sync_report import sync_report

_ALIKE = (
    "PixelFormat", "ExposureTime", "Gain", "BlackLevel", "Gamma", "TriggerSource", "TriggerDelay",
    "TriggerActivation", "ExposureAuto", "GainAuto",
)  # fmt: skip
_SHOWN = 3
_ROUNDED = 0.01  # devices of one model may round a setting differently


def roster_findings(roster: Sequence[RosterFinding]) -> list[Finding]:
    """What the roster says, as findings: missing and troubled devices stop the recording.

    Args:
        roster: of `capture.devices.roster.compare`.
    """
    colours = {
        FindingKind.MISSING: Colour.RED,
        FindingKind.TROUBLED: Colour.RED,
        FindingKind.MOVED: Colour.AMBER,
    }
    found = [
        Finding("roster", one.name, colours[one.kind], f"{one.name}: {one.sentence}.", one.remedy)
        for one in roster
        if one.kind in colours
    ]
    if not found and roster:
        there = sum(one.kind == FindingKind.PRESENT for one in roster)
        found.append(Finding("roster", "", Colour.GREEN, f"All {there} devices are there."))
    return found


def preset_findings(devices: Sequence[Device], presets: Mapping[str, Preset]) -> list[Finding]:
    """Whether each device still has the settings of its preset; nothing is written.

    Args:
        devices: of the array.
        presets: by device name.
    """
    found = []
    compared = 0
    for device in devices:
        name = device.info.name
        if name not in presets or not isinstance(device, Featured):
            continue
        compared += 1
        differences = compare_preset(device, presets[name])
        if differences:
            shown = "; ".join(str(one) for one in differences[:_SHOWN])
            more = f"; and {len(differences) - _SHOWN} more" if len(differences) > _SHOWN else ""
            said = unnamed(name, f"{shown}{more}")
            slight = all(one.slight for one in differences)
            does = "rounds preset {}" if slight else "is not set as preset {} says"
            words = f"{name} {does.format(presets[name].name)}: {said}."
            remedy = steps(
                ("Stop the array and open it again: presets are then written anew.",
                 "If a value is refused, put what the device offers into the preset.")
            )  # fmt: skip
            if slight:
                remedy = "Put what it reads into the preset, so that the file says what is there."
            colour = Colour.AMBER if slight else Colour.RED
            found.append(Finding("preset", name, colour, words, remedy))
    if compared and not found:
        words = f"{compared} devices are set as their presets say."
        found.append(Finding("preset", "", Colour.GREEN, words))
    return found


def odd_settings(devices: Sequence[Device]) -> list[Finding]:
    """Devices of one model whose settings differ from those of the others in a way that shows."""
    values: dict[tuple[str, str], dict[str, FeatureValue]] = {}
    for device in devices:
        if not isinstance(device, Featured):
            continue
        for feature in _ALIKE:
            try:
                value = device.read_feature(feature)
            except DeviceError:
                continue
            values.setdefault((device.info.model, feature), {})[device.info.name] = value
    found = []
    for (_, feature), by_name in values.items():
        usual, votes = _usual(list(by_name.values()))
        if 2 * votes <= len(by_name):
            continue
        for name, value in by_name.items():
            if not alike(usual, value, _ROUNDED):
                words = f"{name} has {feature} = {value!r}, the others of its model have {usual!r}."
                remedy = "Write the feature into the preset of every device, and apply it."
                found.append(Finding("preset", name, Colour.AMBER, words, remedy))
    return found


def cautions(devices: Sequence[Device]) -> list[Finding]:
    """What devices say of themselves that may lose frames."""
    told = [
        (device.info.name, problem.partition("; "))
        for device in devices
        if isinstance(device, Cautioned)
        for problem in device.problems
    ]
    return [
        Finding("device", name, Colour.AMBER, f"{name} says: {what}.", remedy)
        for name, (what, _, remedy) in told
    ]


def _usual(values: Sequence[FeatureValue]) -> tuple[FeatureValue, int]:
    """The value that most have, up to rounding, and how many."""
    votes = {one: sum(alike(one, other, _ROUNDED) for other in values) for one in set(values)}
    usual = max(values, key=votes.__getitem__)
    return usual, votes[usual]


def burst_findings(burst: Recording) -> list[Finding]:
    """The verdict on a burst of triggers: frames that did not come, and how well devices agree.

    Args:
        burst: as `LiveArray.burst` gave it.
    """
    ledger = burst.ledger
    found = []
    broken = ledger.incomplete()
    lost = Counter(entry.device for entries in broken.values() for entry in entries)
    for name, count in lost.items():
        words = f"{name} failed {count} of {ledger.triggers} triggers of the burst"
        causes = Counter(
            str(entry.verdict).replace("_", " ")
            for entries in broken.values()
            for entry in entries
            if entry.device == name
        )
        told = ", ".join(f"{number} {cause}" for cause, number in causes.items())
        colour = Colour.RED if count > 1 else Colour.AMBER
        found.append(Finding("sync", name, colour, f"{words}: {told}.", _lost_remedy(causes)))
    basis = "host" if burst.basis == "free" else burst.basis
    report = sync_report(ledger, burst.clocks, burst.train.period_ns, basis, burst.readings)
    silent = set(lost)
    for finding in report.findings:
        if finding.kind == "silent" and set(finding.devices) <= silent:
            continue
        device = finding.devices[0] if len(finding.devices) == 1 else ""
        remedy = steps(finding.remedies)
        found.append(Finding("sync", device, finding.colour, finding.sentence, remedy))
    if not report.findings and report.colour != Colour.GREEN and not lost:
        remedy = "See the trigger cables and, with PTP, the offsets; then run the preflight again."
        found.append(Finding("sync", "", report.colour, report.sentence, remedy))
    if not found:
        words = f"{judge(ledger).sentence} {report.sentence}"
        found.append(Finding("sync", "", Colour.GREEN, words))
    return found


def disk_findings(disk: DiskForecast) -> list[Finding]:
    """The forecast of the disk as a finding."""
    colour = Colour(disk.colour)
    remedy = "" if colour == Colour.GREEN else steps(
        ("Archive earlier sessions and verify the copies, then free this disk.",
         "Or record this session onto another disk.")
    )  # fmt: skip
    return [Finding("disk", "", colour, disk.sentence, remedy)]


def _lost_remedy(causes: Counter[str]) -> str:
    cause = causes.most_common(1)[0][0]
    if cause == "missed trigger":
        return steps(
            ("See that exposure and readout fit the period.",
             "See the trigger cable: a pulse too short or too weak is not seen.")
        )  # fmt: skip
    if cause in ("lost", "incomplete"):
        return steps(
            ("See MTU and packet size, and the receive buffer of this machine.",
             "Try another cable and port.", "Put fewer devices behind one uplink.")
        )  # fmt: skip
    return steps(("See that it is powered, linked and armed.", "Connect it again."))
