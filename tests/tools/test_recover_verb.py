"""`likeness verify` and `likeness recover` on takes and sessions: lines, JSON, exit status."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from capture.session import Session
from capture.take_writer import partial_folder
from tests.capture.disk_faults import NAMES, finish, open_writer, write_frame
from tools.cli import main


@pytest.fixture
def session(tmp_path: Path) -> Path:
    """A session of a finished take, smile_001, and one that a crash cut short, smile_002."""
    takes = Session.create(tmp_path / "monday").folder / "takes"
    for number in (1, 2):
        final = takes / f"smile_{number:03d}"
        with open_writer(final, 4) as writer:
            for k in range(4):
                for device in NAMES:
                    write_frame(writer, device, k)
            if number == 1:
                finish(writer, final, 4)
    path = partial_folder(takes / "smile_002") / "frames" / "cam00.mcap.partial"
    os.truncate(path, path.stat().st_size - 31 - 1)
    return tmp_path / "monday"


def test_a_session_is_verified_take_by_take(
    session: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["verify", str(session)]) == 1
    said = capsys.readouterr().err
    assert "smile_001: sound, 12 frames" in said
    assert "smile_002.partial: was never finished; run `likeness recover" in said
    assert main(["recover", str(session)]) == 0
    said = capsys.readouterr().err
    assert "smile_002: saved 11 frames of 3 devices, 4 triggers; cam00: torn while it was" in said
    assert main(["verify", str(session), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["sound"], report["takes"], report["frames"]) == (True, 2, 23)
    assert main(["recover", str(session)]) == 0
    assert "no take in it is unfinished" in capsys.readouterr().err


def test_one_take_is_verified_with_its_verdicts(
    session: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    take = session / "takes" / "smile_001"
    assert main(["verify", str(take), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["sound"], report["frames"], report["ok"]) == (True, 12, 12)
    (take / "ledger.csv").write_text("nothing")
    assert main(["verify", str(take)]) == 1
    assert "ledger.csv: expected a ledger with columns" in capsys.readouterr().err


def test_one_take_is_recovered_with_all_figures(
    session: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = session / "takes" / "smile_002.partial"
    assert main(["recover", str(folder), "--json"]) == 0
    [take] = json.loads(capsys.readouterr().out)["takes"]
    assert (take["outcome"], take["frame_count"], take["planned"]) == ("settled", 4, 4)
    assert take["devices"][0]["torn"] == 3
    assert take["verdicts"]["lost"] == 1


def test_what_cannot_be_recovered_is_a_failure_and_stays(
    session: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (session / "takes" / "smile_002").mkdir()
    assert main(["recover", str(session)]) == 1
    assert "smile_002: exists already; move it away" in capsys.readouterr().err
    assert (session / "takes" / "smile_002.partial").is_dir()
    assert main(["recover", str(session / "nowhere")]) == 2


def test_a_take_that_lost_its_manifest_is_no_sound_session(
    session: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["recover", str(session)])
    (session / "takes" / "notes of the day").mkdir()  # no take at all
    assert main(["verify", str(session)]) == 0
    (session / "takes" / "smile_001" / "take.json").unlink()
    (session / "takes" / "smile_002" / "frames" / "cam01.mcap").unlink()
    assert main(["verify", str(session)]) == 1
    said = capsys.readouterr().err
    assert "smile_001: 1 problems" not in said
    assert "takes/smile_001: expected a take, found no take.json" in said
    assert "frames/cam01.mcap is missing" in said
