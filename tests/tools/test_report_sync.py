"""The report shows how a take was synchronized and which calibration its session uses."""

from __future__ import annotations

import json
import os
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from capture.calibration_link import link_calibration
from capture.camera_file import write_cameras
from capture.recorder import RecordSettings
from capture.session import Session, Shot, record_take
from capture.sync_report import sync_report
from tests.capture.recording import array_of, cameras
from tests.capture.sync_cases import PERIOD_NS, ledger_of, quiet
from tools.report import report_for_take
from tools.report.sync import sync_facts, sync_part, sync_verdict

SMILE = Shot(slate="smile", kind="expression", frames=12, start_ns=5 * 10**9)
NOON = datetime(2026, 11, 20, 12, tzinfo=UTC)


def test_a_late_device_is_drawn_and_told() -> None:
    late = quiet(devices=4)
    late[:, 2] += 43.0
    ledger = ledger_of(late)
    remarks = {"sync": sync_report(ledger, {}, PERIOD_NS, "ptp").document()}
    verdict = sync_verdict("smile_001", remarks)
    assert verdict is not None
    assert (verdict.level, verdict.subject) == ("warn", "Sync of smile_001:")
    html = sync_part("smile_001", remarks, ledger)
    assert html.count("<circle") == 4
    assert "cam02 exposes 43 us after the others" in html
    assert html.count("<ol>") == 1
    assert "offset and jitter of smile_001" in html
    assert "spread of smile_001" in html
    assert "nan" not in html
    assert sync_facts(remarks)["spread max, us"] == pytest.approx(44, abs=1.5)


def test_a_fitted_clock_shows_no_offset() -> None:
    ledger = ledger_of(quiet(devices=4))
    remarks = {"sync": sync_report(ledger, {}, PERIOD_NS, "model").document()}
    html = sync_part("t", remarks, ledger)
    assert "<circle" not in html
    assert "a constant offset only as far as readings of the clock tell" in html


@pytest.mark.parametrize(
    "sync",
    [
        None, "red", {}, {"colour": "blue"}, {"colour": "red", "devices": 5, "findings": {}},
        {"colour": "red", "devices": [{}, 3, {"device": "<b>", "offset_us": "x"}],
         "findings": ["x", {"sentence": "<script>", "remedies": ["<i>"]}]},
    ],
)  # fmt: skip
def test_whatever_a_manifest_holds_is_safe(sync: object) -> None:
    ledger = ledger_of(np.zeros((1, 2)))
    html = sync_part("t", {"sync": sync}, ledger)
    assert "<script>" not in html
    assert "<b>" not in html.replace("<b>✗", "")
    assert "nan" not in html


def test_the_page_of_a_session_shows_both(tmp_path: Path) -> None:
    session = Session.create(tmp_path / "tuesday")
    record_take(session, SMILE, array_of(3, seed=1), RecordSettings())
    path = tmp_path / "cameras.json"
    write_cameras(path, cameras(3))
    made = (NOON - timedelta(days=9)).timestamp()
    os.utime(path, (made, made))
    link = link_calibration(session.folder, path, now=NOON)
    page = report_for_take(session.folder, tmp_path / "r.html").read_text(encoding="utf-8")
    assert "Sync of smile_001:" in page
    assert "spread 95 %, us" in page
    assert f"Calibration {link.id} is 9 days old" in page
    assert "older than 7 days" in page
    assert "likeness drift" in page
    assert str(tmp_path) not in page
    link_calibration(session.folder, path, now=NOON - timedelta(days=6))
    page = report_for_take(session.folder, tmp_path / "r.html").read_text(encoding="utf-8")
    assert "age when linked, days" in page
    assert "likeness drift" not in page
    document = session.folder / "takes" / "smile_001" / "take.json"
    assert json.loads(document.read_text(encoding="utf-8"))["remarks"]["sync"]["basis"] == "model"
