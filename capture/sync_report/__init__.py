"""How well the devices of a take exposed together: numbers, a verdict, findings with remedies.

`sync_report` makes it of a ledger. What its numbers can show depends on whose clocks dated the
frames: see `SyncBasis`.
"""

from capture.sync_report.findings import SyncFinding
from capture.sync_report.ptp_history import PTP_STEP_NS, ptp_changes_told
from capture.sync_report.report import DeviceSync, SyncReport, sync_report
from capture.sync_report.times import SetTimes, SyncBasis, set_times

__all__ = [
    "PTP_STEP_NS",
    "DeviceSync",
    "SetTimes",
    "SyncBasis",
    "SyncFinding",
    "SyncReport",
    "ptp_changes_told",
    "set_times",
    "sync_report",
]
