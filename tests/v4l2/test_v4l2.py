"""The V4L2 backend against the kernel's vivid driver, in a guest that is booted once.

The checks themselves are tests in `inside/check_*.py`, and the contract that every device keeps;
they run in the guest, and each is shown here as a test of its own.
"""

from __future__ import annotations

import ast
import json
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tests.v4l2.guest import ROOT, GuestRun, run_in_guest, why_not

pytestmark = pytest.mark.v4l2

_CHECKS = tuple(sorted((ROOT / "tests" / "v4l2" / "inside").glob("check_*.py")))
_CONTRACT = ROOT / "tests" / "capture" / "devices" / "test_contract.py"
_DEVICE = "v4l2:platform:vivid-000"
_TIMEOUT_S = 1800.0  # two to three minutes where little else runs
# One run: Python takes half a minute to start there.
_COMMAND = """\
export PYTEST_DISABLE_PLUGIN_AUTOLOAD=1
.venv/bin/python -m pytest -c pyproject.toml --rootdir=. -p no:cacheprovider --tb=short \\
    --color=no -vv --durations=12 -o 'python_files=check_*.py' --junitxml=/share/results.xml \\
    --device {device} --device-rate 25 tests/v4l2/inside {contract}
"""


@dataclass
class Results:
    """What became of the tests in the guest, by file and function."""

    run: GuestRun
    passed: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    failed: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))
    skipped: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))

    def read(self, path: Path) -> None:
        """Add the results in a file that pytest wrote."""
        if not path.is_file():
            return
        for case in ElementTree.parse(path).getroot().iter("testcase"):
            stem = str(case.get("classname")).rpartition(".")[2]
            name = str(case.get("name"))
            key = f"{stem}::{name.partition('[')[0]}"
            bad = [child for child in case if child.tag in ("failure", "error")]
            skip = case.find("skipped")
            if bad:
                self.failed[key].append(f"{name}\n{bad[0].text}")
            elif skip is not None:
                self.skipped[key].append(str(skip.get("message")))
            else:
                self.passed[key] += 1


def functions_of(path: Path) -> list[str]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    names = [n.name for n in tree.body if isinstance(n, ast.FunctionDef)]
    return [f"{path.stem}::{name}" for name in names if name.startswith("test_")]


@pytest.fixture(scope="session")
def results(tmp_path_factory: pytest.TempPathFactory) -> Results:
    """Boot the guest and run all checks in it."""
    reason = why_not()
    if reason:
        pytest.skip(f"no guest: {reason}")
    share = tmp_path_factory.mktemp("guest")
    command = _COMMAND.format(device=_DEVICE, contract=_CONTRACT.relative_to(ROOT))
    results = Results(run_in_guest(command, share, _TIMEOUT_S))
    results.read(share / "results.xml")
    figures = share / "figures.jsonl"
    for line in figures.read_text(encoding="utf-8").splitlines() if figures.exists() else ():
        print("measured:", json.loads(line))
    print(f"guest: booted in {results.run.booted_s} s of its time, ended at {results.run.ended_s}")
    return results


def test_the_guest_ran_to_its_end(results: Results) -> None:
    assert results.run.status is not None, results.run.console[-3000:]
    assert 0 < results.run.booted_s < results.run.ended_s


@pytest.mark.parametrize("check", [name for path in _CHECKS for name in functions_of(path)])
def test_in_the_guest(results: Results, check: str) -> None:
    show(results, check)


@pytest.mark.parametrize("check", functions_of(_CONTRACT))
def test_contract_in_the_guest(results: Results, check: str) -> None:
    show(results, check)


def show(results: Results, check: str) -> None:
    """Give a test here the outcome that it had in the guest, all its cases together."""
    if results.failed[check]:
        pytest.fail("\n".join(results.failed[check]), pytrace=False)
    if not results.passed[check] and results.skipped[check]:
        pytest.skip(results.skipped[check][0])
    assert results.passed[check], f"{check} did not run\n{results.run.console[-3000:]}"
