"""Recovery: what a crash left of a recording becomes a take; what is lost is told exactly."""

from __future__ import annotations

from capture.recover.report import DeviceRecovery, FileMend, Outcome, TakeRecovery
from capture.recover.takes import recover_session, recover_take

__all__ = [
    "DeviceRecovery",
    "FileMend",
    "Outcome",
    "TakeRecovery",
    "recover_session",
    "recover_take",
]
