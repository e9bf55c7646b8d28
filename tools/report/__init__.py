"""The report: one self-contained HTML page from whatever the stages have made."""

from tools.report.inputs import ReportInputs, TakeErrors, TakeInputs
from tools.report.report import (
    report_for_take,
    write_calibration_page,
    write_report,
    write_scan_page,
)
from tools.report.rig_page import write_rig_page

__all__ = [
    "ReportInputs",
    "TakeErrors",
    "TakeInputs",
    "report_for_take",
    "write_calibration_page",
    "write_report",
    "write_rig_page",
    "write_scan_page",
]
