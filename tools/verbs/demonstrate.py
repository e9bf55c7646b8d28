"""Run a simulated 16-camera session through every stage, and write a report to look at.

Example: likeness demo --out demo
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from capture.progress import Progress
from tools.demo import run_demo
from tools.demo_session import DemoSettings
from tools.verbs.options import Options


@dataclass(frozen=True, kw_only=True)
class Arguments(Options):
    """Options of `likeness demo`."""

    out: Path = Path("demo")
    """The folder to fill."""
    settings: Annotated[DemoSettings, tyro.conf.arg(name="")] = field(default_factory=DemoSettings)


def run(arguments: Arguments, progress: Progress) -> dict[str, Any]:
    """Run the demo and report files, times and errors."""
    return run_demo(arguments.out, arguments.settings, progress=progress)
