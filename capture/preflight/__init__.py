"""Checks before recording: everything that can spoil a session, told at once, with remedies."""

from capture.preflight.budget import SharedLink
from capture.preflight.finding import Finding, worst
from capture.preflight.flash import flash_findings, flash_levels
from capture.preflight.ptp import PtpGate, ptp_changes, read_ptp, wait_for_lock
from capture.preflight.run import PreflightSettings, Subject, preflight

__all__ = [
    "Finding",
    "PreflightSettings",
    "PtpGate",
    "SharedLink",
    "Subject",
    "flash_findings",
    "flash_levels",
    "preflight",
    "ptp_changes",
    "read_ptp",
    "wait_for_lock",
    "worst",
]
