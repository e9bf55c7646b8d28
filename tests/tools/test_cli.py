from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from capture.archive import write_archive
from tests.synthetic import small_array, write_visit
from tools.cli import VERBS, main

ROOT = Path(__file__).resolve().parents[2]


def test_the_overview_names_every_verb(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    assert all(verb in text for verb in VERBS)


def test_an_unknown_verb_is_refused_with_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrat"]) == 2
    assert "did you mean 'calibrate'" in capsys.readouterr().err


@pytest.mark.parametrize("verb", sorted(VERBS))
def test_every_verb_has_help_with_an_example(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([verb, "--help"]) == 0
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert f"Example: likeness {verb}" in text


def test_bad_usage_exits_2_without_a_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["import", "--no-such-option"]) == 2
    assert "Traceback" not in capsys.readouterr().err


def test_json_is_one_object_on_stdout(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    visit = write_visit(tmp_path / "visit", small_array())
    assert main(["import", str(visit), "--out", str(tmp_path / "take"), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["devices"], report["frames"], report["cameras"]) == (3, 4, True)
    assert main(["verify", str(tmp_path / "take"), "--json"]) == 0


def test_bad_input_exits_2_and_leaves_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    visit = write_visit(tmp_path / "visit", small_array())
    (visit / "cam01" / "0002.png").unlink()
    assert main(["import", str(visit), "--out", str(tmp_path / "take")]) == 2
    message = capsys.readouterr().err
    assert "cam01" in message
    assert "Traceback" not in message
    assert sorted(p.name for p in tmp_path.iterdir()) == ["visit"]


def test_settings_come_from_the_file_and_options_win(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "session.toml"
    config.write_text("[recon]\nno_such_key = 1\n", encoding="utf-8")
    assert main(["recon", str(tmp_path), "--config", str(config)]) == 2
    assert "no_such_key" in capsys.readouterr().err


def test_a_rig_of_another_topology_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    grid = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0), [0.0]), -1).reshape(-1, 3) * 40
    quads = np.array([[i, i + 1, i + 6, i + 5] for i in range(19) if i % 5 < 4], np.int32)
    deltas = np.zeros((1, 25, 3))
    deltas[0, 12, 2] = 5.0
    write_archive(
        tmp_path / "template.npz",
        {
            "neutral": grid.astype(np.float32),
            "deltas": deltas.astype(np.float32),
            "names": np.array(["jawOpen"]),
            "polygons": quads,
        },
    )
    write_archive(
        tmp_path / "performance.npz",
        {
            "vertices": np.zeros((2, 30, 3), np.float32),
            "confidence": np.ones((2, 30), np.float32),
            "polygons": quads,
            "frames": np.arange(2),
            "head_from_neutral": np.tile(np.eye(4), (2, 1, 1)),
            "reference": -np.ones(2, np.int64),
        },
    )
    words = ["rig", "--template", str(tmp_path / "template.npz")]
    words += ["--performance", str(tmp_path / "performance.npz"), "--out", str(tmp_path / "rig")]
    assert main(words) == 2
    message = capsys.readouterr().err
    assert "25" in message
    assert "30" in message
    assert not (tmp_path / "rig").exists()


def test_an_interrupt_exits_130_and_leaves_nothing_half_written(tmp_path: Path) -> None:
    visit = write_visit(tmp_path / "visit", small_array(3, 640, 480), frames=30)
    process = subprocess.Popen(
        [sys.executable, "-m", "tools.cli", "import", str(visit), "--out", str(tmp_path / "take")],
        cwd=ROOT,
        stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a shell's & ignores it
    )
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and not any(
        p.name.startswith(".partial") for p in tmp_path.iterdir()
    ):
        time.sleep(0.002)
    process.send_signal(signal.SIGINT)
    _, message = process.communicate(timeout=60)
    assert process.returncode == 130, message
    assert b"Traceback" not in message
    assert sorted(p.name for p in tmp_path.iterdir()) == ["visit"]


def test_the_system_s_refusal_of_a_path_is_bad_input(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "visit").mkdir()
    visit = write_visit(tmp_path / "visit", small_array())
    (tmp_path / "file").write_text("mine")
    assert main(["import", str(visit), "--out", str(tmp_path / "file" / "take")]) == 2
    message = capsys.readouterr().err.splitlines()[-1]
    assert message.startswith(f"likeness import: {tmp_path / 'file'}")
    assert (tmp_path / "file").read_text() == "mine"


def test_a_config_is_read_by_every_verb(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", str(tmp_path), "--config", str(tmp_path / "none.toml")]) == 2
    assert "none.toml: no such settings file" in capsys.readouterr().err


def test_a_report_of_a_rig_that_is_not_there_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["report", str(tmp_path), "--rig", str(tmp_path / "norig"), "--out"]
    assert main([*words, str(tmp_path / "page.html")]) == 2
    assert "no rig.npz" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


PROGRAM = """
import os, sys
from tools import cli
from tools.verbs.options import Options as Arguments
{before}
def run(arguments, progress):
    {body}
cli.VERBS["shout"], cli._MODULES["shout"] = "a verb of the test", "__main__"
raise SystemExit(cli.main(["shout", "--json"]))
"""


def spoken(body: str, before: str = "") -> subprocess.CompletedProcess[str]:
    """A verb whose work is `body`, run by the program in a process of its own."""
    return subprocess.run(
        [sys.executable, "-c", PROGRAM.format(body=body, before=before)],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip


def test_only_the_report_reaches_stdout_and_it_is_json() -> None:
    body = 'print("python"); os.write(1, b"compiled"); return {"rms": float("nan"), "n": [1.5]}'
    done = spoken(body)
    assert done.returncode == 0
    assert json.loads(done.stdout, parse_constant=pytest.fail) == {"rms": None, "n": [1.5]}
    assert "python" in done.stderr
    assert "compiled" in done.stderr


def test_no_memory_and_no_package_are_told_in_a_line() -> None:
    full = spoken("raise MemoryError")
    assert (full.returncode, "Traceback" in full.stderr) == (1, False)
    assert "not enough memory" in full.stderr
    bare = spoken("import open3d.core", before='sys.modules["open3d"] = None')
    assert (bare.returncode, "Traceback" in bare.stderr) == (2, False)
    assert "open3d, which is not installed" in bare.stderr
