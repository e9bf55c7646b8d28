"""`preflight`: every check, one after the other; none stops another."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from capture.calibration_link.link import calibration_standing, linked_cameras, linked_reference
from capture.calibration_link.reference import DeviceReference, read_reference
from capture.devices.capabilities import PtpClocked
from capture.devices.preset import Preset
from capture.devices.protocol import TriggerKind
from capture.devices.roster import Finding as RosterFinding
from capture.disk import DiskForecast
from capture.documents import read_json, write_json
from capture.errors import LikenessError, TakeError
from capture.judgement import Colour
from capture.live import LiveArray
from capture.preflight.array_checks import (
    burst_findings,
    cautions,
    disk_findings,
    odd_settings,
    preset_findings,
    roster_findings,
)
from capture.preflight.budget import (
    SharedLink,
    host_links,
    link_findings,
    memory_findings,
    network_findings,
    ring_bytes,
    timing_findings,
)
from capture.preflight.finding import Finding, ordered, worst
from capture.preflight.look import (
    Sight,
    exposure_findings,
    flicker_findings,
    focus_findings,
    look,
    scene_findings,
)
from capture.preflight.ptp import PtpGate, ptp_findings
from capture.progress import Progress, silent
from capture.settings import check_ranges

START_FILE = "start_levels.json"


@dataclass(frozen=True, kw_only=True)
class PreflightSettings:
    """How the array is checked.

    Attributes:
        burst: triggers of the sync burst; 10 to 10000.
        looks: how often images are looked at for exposure and flicker; 2 to 1000.
        ptp_hold_s: for how long clocks must be locked; 0 to 600.
        ptp_deadline_s: how long to wait for that; 0 to 3600.
        calibration_days: an older calibration is amber; 0 and more.
    """

    burst: int = 100
    looks: int = 20
    ptp_hold_s: float = 10.0
    ptp_deadline_s: float = 60.0
    calibration_days: float = 7.0

    def __post_init__(self) -> None:
        check_ranges(
            "preflight", self, burst=(10, 10_000), looks=(2, 1000), ptp_hold_s=(0, 600),
            ptp_deadline_s=(0, 3600), calibration_days=(0, float("inf")),
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Subject:
    """What is checked.

    Attributes:
        live: the array, streaming.
        session: the session's folder, for its calibration; None: not looked at.
        roster: devices expected against found; empty: not looked at.
        presets: by device name.
        shared: links that several devices share, besides those that this machine tells of.
        disk: forecasts the disk; None: not looked at.
        start: by device name, the mean of its face region at session start; empty: as the first
            preflight of the session found it.
    """

    live: LiveArray
    session: Path | None = None
    roster: Sequence[RosterFinding] = ()
    presets: Mapping[str, Preset] = field(default_factory=dict)
    shared: Sequence[SharedLink] = ()
    disk: Callable[[], DiskForecast] | None = None
    start: Mapping[str, float] = field(default_factory=dict)


def preflight(
    subject: Subject, settings: PreflightSettings | None = None, *, progress: Progress = silent
) -> tuple[Finding, ...]:
    """Check everything that can spoil a session, and tell all of it.

    Args:
        subject: what is checked; its array must be streaming.
        settings: how.
        progress: told before each check and at the end; what it raises ends the preflight.

    Returns:
        Findings, red first; every check that could be made says something.
    """
    settings = settings if settings is not None else PreflightSettings()
    sights: dict[str, Sight] = {}
    checks = _checks(subject, settings, sights, progress)
    found: list[Finding] = []
    for done, (name, check) in enumerate(checks):
        progress(done, len(checks), f"preflight: {name}")
        try:
            found += check()
        except (LikenessError, OSError) as error:
            words = f"The check of {name} could not be made: {error}"
            remedy = "See to that, then run the preflight again."
            found.append(Finding(name, "", Colour.RED, words, remedy))
    progress(len(checks), len(checks), "preflight")
    return ordered(found)


def _checks(
    subject: Subject,
    settings: PreflightSettings,
    sights: dict[str, Sight],
    progress: Progress,
) -> list[tuple[str, Callable[[], list[Finding]]]]:
    """Every check by name, the quick ones first; `sights` is filled by the first that looks."""
    devices, record = subject.live.array.devices, subject.live.settings
    rate = record.rate_hz
    infos = [device.info for device in devices]
    clocks = {d.info.name: d for d in devices if isinstance(d, PtpClocked)}
    scheduled = subject.live.array.trigger == TriggerKind.ACTION
    gate = PtpGate(hold_s=settings.ptp_hold_s, deadline_s=settings.ptp_deadline_s)

    def seen() -> dict[str, Sight]:
        if not sights:
            sights.update(look(subject.live.latest, settings.looks))
        return sights

    def links() -> list[Finding]:
        return link_findings(infos, rate, [*subject.shared, *host_links(infos)])

    def memory() -> list[Finding]:
        reserved = {state.name: state.reserved for state in subject.live.states()}
        return memory_findings(ring_bytes(infos, reserved))

    def presets() -> list[Finding]:
        return preset_findings(devices, subject.presets) + odd_settings(devices)

    def locked() -> list[Finding]:
        return ptp_findings(clocks, gate, needed=scheduled, progress=progress)

    def exposure() -> list[Finding]:
        return session_exposure(subject, seen()) + flicker_findings(seen())

    def unseen() -> list[Finding]:
        remedy = "See its line in the device list; connect it again."
        return [
            Finding("exposure", name, Colour.RED, f"{name} gave no image.", remedy)
            for name in subject.live.array.names
            if name not in seen()
        ]

    return [
        ("roster", lambda: roster_findings(subject.roster)),
        ("link", links),
        ("link", lambda: timing_findings(devices, rate, record.exposure_us)),
        ("memory", memory),
        ("disk", lambda: [] if subject.disk is None else disk_findings(subject.disk())),
        ("device", lambda: cautions(devices)),
        ("network", lambda: network_findings(devices, rate)),
        ("preset", presets),
        ("calibration", lambda: _calibration(subject, settings)),
        ("ptp", locked),
        ("sync", lambda: burst_findings(subject.live.burst(settings.burst))),
        ("exposure", unseen),
        ("exposure", exposure),
        ("focus", lambda: _against_reference(subject, lambda then: focus_findings(seen(), then))),
        ("scene", lambda: _against_reference(subject, lambda then: scene_findings(seen(), then))),
    ]


def session_exposure(subject: Subject, sights: Mapping[str, Sight]) -> list[Finding]:
    """Exposure against session start, which the first preflight that is not red keeps.

    Raises:
        TakeError: when what was kept is damaged.
    """
    path = None if subject.session is None else subject.session / START_FILE
    if subject.start or path is None:
        return exposure_findings(sights, subject.start)
    if path.is_file():
        return exposure_findings(sights, _levels(path))
    found = exposure_findings(sights)
    if sights and worst(found) != Colour.RED:
        levels = {name: round(sight.mean, 5) for name, sight in sights.items()}
        write_json(path, levels)
    return found


def _levels(path: Path) -> dict[str, float]:
    document = read_json(path, TakeError)
    good = isinstance(document, dict) and all(
        isinstance(value, int | float) and 0 < value <= 1 for value in document.values()
    )
    if not good:
        raise TakeError(f"{path}: expected levels of 0 to 1 by device; remove it to begin anew")
    return {str(name): float(value) for name, value in document.items()}


def _calibration(subject: Subject, settings: PreflightSettings) -> list[Finding]:
    if subject.session is None:
        return []
    standing = calibration_standing(
        subject.session, subject.live.array.names, old_days=settings.calibration_days
    )
    found = [Finding("calibration", "", standing.colour, standing.sentence, standing.remedy)]
    named = linked_cameras(subject.session).is_file()
    if named and not linked_reference(subject.session).is_file():
        words = "No pictures of calibration day are kept: focus and motion are not compared."
        remedy = (
            "Record somebody who sits still and run: likeness reference TAKE --cameras CAMERAS.json"
        )
        found.append(Finding("scene", "", Colour.AMBER, words, remedy))
    return found


def _against_reference(
    subject: Subject, compare: Callable[[dict[str, DeviceReference]], list[Finding]]
) -> list[Finding]:
    """Compare with calibration day; that there is no reference is told with the calibration."""
    path = None if subject.session is None else linked_reference(subject.session)
    return compare(read_reference(path)) if path is not None and path.is_file() else []
