"""`likeness VERB ...`: finds the verb, reads its options, shows progress, reports, exits.

Exit status: 0 done, 2 bad usage or bad input, 1 failure of the work itself, 130 interrupted.
"""

from __future__ import annotations

import importlib
import json
import os
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

from capture.documents import plain_json
from capture.errors import InputError, LikenessError
from capture.names import known_hint
from capture.product import code_version
from capture.settings import read_settings
from tools.progress_bar import ProgressBar

VERBS: dict[str, str] = {
    "demo": "run a simulated 16-camera session through every stage and report",
    "devices": "list the devices that are found, against an array's roster; their settings",
    "capture": "record a session: arm the array, prompt the talent, judge each take at once",
    "flash": "check by a flash of light that every device exposes at the same trigger",
    "reference": "keep what every device sees on calibration day, to be compared with later",
    "import": "make a take of a visiting folder of images",
    "board": "draw a calibration board to print, at true scale",
    "calibrate": "solve the cameras of an array from a board take",
    "cameras": "carry cameras between ours, COLMAP, OpenCV, Metashape and Kalibr",
    "photometric": "measure black level, gain and lens falloff of every device",
    "drift": "check from a few board poses whether an array still stands as calibrated",
    "recon": "reconstruct the surface of frames by stereo",
    "neutral": "register a template mesh to the actor at the first frame",
    "landmarks": "find lips, lids, brows and nose in every frame, by a predictor of this actor",
    "track": "track the neutral mesh through a take",
    "correct": "pin, draw, lock or leave out what tracking is to be told",
    "template": "carry an artist's shapes onto a mesh of other topology",
    "rig": "solve a personalised blendshape rig from performances",
    "health": "tell what a rig can be trusted with, and what to shoot next",
    "rename": "give shapes the names of another convention, split and merge halves",
    "export": "write a rig, a performance or weights in an exchange format",
    "report": "write the HTML report of a take",
    "verify": "read a take back and check every frame and the ledger",
    "recover": "bring back what a crash left of a recording",
}
"""Every verb and what it does, in the order of the pipeline."""

_MODULES = {"import": "tools.verbs.visit", "demo": "tools.verbs.demonstrate"}
_STAGES = {
    "capture": ("capture.preflight.run", "PreflightSettings"),
    "calibrate": ("recon.calibration.solver", "CalibrateSettings"),
    "photometric": ("recon.photometry.sources", "PhotometricSettings"),
    "drift": ("recon.calibration.drift", "DriftSettings"),
    "recon": ("recon.scan", "ReconSettings"),
    "neutral": ("track.neutral", "NeutralSettings"),
    "landmarks": ("track.landmark_stage", "LandmarkSettings"),
    "track": ("track.stage", "TrackSettings"),
    "template": ("rig.retopology", "RetopologySettings"),
    "rig": ("rig.stage", "RigSettings"),
}


_OWN = ("capture", "recon", "track", "rig", "tools")
_MISPLACED = (
    FileNotFoundError, FileExistsError, NotADirectoryError, IsADirectoryError, PermissionError
)  # fmt: skip
"""What the system says of a path that the user should have chosen otherwise: bad input."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb and return the exit status.

    Args:
        arguments: the words after `likeness`; those of the process when None.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help"):
        print(_overview())
        return 0 if words else 2
    if words[0] == "--version":
        print(f"likeness {code_version()}")
        return 0
    verb, rest = words[0], words[1:]
    if verb not in VERBS:
        print(f"likeness: no verb {verb!r}; {known_hint(verb, VERBS)}", file=sys.stderr)
        return 2
    return _run(verb, rest)


def _run(verb: str, rest: list[str]) -> int:
    bar = ProgressBar()
    try:
        module = importlib.import_module(_MODULES.get(verb, f"tools.verbs.{verb}"))
        options = _parse(verb, module, rest)
        with _stdout_for_the_report():
            report: dict[str, Any] = module.run(options, bar)
    except SystemExit as stop:  # tyro prints usage and leaves with 0 (help) or 2 (usage)
        return stop.code if isinstance(stop.code, int) else 2
    except KeyboardInterrupt:
        bar.close()
        print(f"likeness {verb}: interrupted; what was finished is kept", file=sys.stderr)
        return 130
    except LikenessError as error:
        bar.close()
        print(f"likeness {verb}: {error}", file=sys.stderr)
        return error.exit_status
    except ModuleNotFoundError as error:
        bar.close()
        if error.name is None or error.name.partition(".")[0] in _OWN:
            raise
        print(f"likeness {verb}: {_missing_package(error.name)}", file=sys.stderr)
        return 2
    except (OSError, MemoryError) as error:
        bar.close()
        print(f"likeness {verb}: {_told(error)}", file=sys.stderr)
        return 2 if isinstance(error, _MISPLACED) else 1
    bar.close()
    if options.json:
        print(json.dumps(plain_json(report), default=str, allow_nan=False))
    else:
        for key, value in report.items():
            print(f"{key}: {value}", file=sys.stderr)
    return 0


@contextmanager
def _stdout_for_the_report() -> Iterator[None]:
    """Send to stderr whatever libraries print, compiled ones too: stdout is for the report."""
    sys.stdout.flush()
    kept = os.dup(1)
    written, sys.stdout = sys.stdout, sys.stderr
    os.dup2(2, 1)
    try:
        yield
    finally:
        sys.stdout = written
        os.dup2(kept, 1)
        os.close(kept)


def _missing_package(name: str) -> str:
    package = name.partition(".")[0]
    return (
        f"this verb needs the Python package {package}, which is not installed; "
        "install what the project needs with `make setup`"
    )


def _told(error: OSError | MemoryError) -> str:
    """One line: the path that was meant, without the temporary name it was written under."""
    if isinstance(error, MemoryError):
        return f"not enough memory: {error}" if str(error) else "not enough memory"
    if error.filename is None:
        return str(error)
    path = re.sub(r"\.(partial|old)-\d+-", "", str(error.filename))
    return f"{path}: {error.strerror}"


def _parse(verb: str, module: ModuleType, rest: list[str]) -> Any:
    """Options of a verb; with --config, the settings file gives the defaults of the settings."""
    import tyro  # late, so that Ctrl-C is answered from the first moment on

    config = _config_path(rest)
    prog = f"likeness {verb}"
    told = (module.__doc__ or "").replace("\nExample:", "\n\nExample:")  # a paragraph of its own
    settings: dict[str, Any] = {}
    if config is not None:
        stages = {
            stage: getattr(importlib.import_module(home), name)
            for stage, (home, name) in _STAGES.items()
        }
        settings = read_settings(config, stages)
    if verb not in settings:
        return tyro.cli(module.Arguments, args=rest, prog=prog, description=told)
    return tyro.cli(
        module.Arguments,
        args=rest,
        prog=prog,
        description=told,
        default=module.Arguments(
            **dict.fromkeys(module.REQUIRED, tyro.MISSING), settings=settings[verb]
        ),
    )


def _config_path(rest: list[str]) -> Path | None:
    for index, word in enumerate(rest):
        if word == "--config":
            if index + 1 == len(rest):
                raise InputError("--config: expected the path of a TOML file after it")
            return Path(rest[index + 1])
        if word.startswith("--config="):
            return Path(word.partition("=")[2])
    return None


def _overview() -> str:
    width = max(len(verb) for verb in VERBS)
    lines = [f"  {verb:<{width}}  {text}" for verb, text in VERBS.items()]
    return (
        "likeness: from sixteen synchronized views to a personalised face rig\n\n"
        "usage: likeness VERB ...    (likeness VERB --help tells all of a verb)\n\n"
        + "\n".join(lines)
        + "\n\nexample: likeness import visiting-take --out take && likeness recon take --frames 0"
    )


if __name__ == "__main__":
    raise SystemExit(main())
