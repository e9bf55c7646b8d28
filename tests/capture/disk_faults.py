"""A real process that records takes, to be killed; and what is true of the frames it writes.

Run as a program it serves one case a line on stdin: it forks a process that records, kills it, and
answers. Forking costs milliseconds where starting Python would cost a third of a second.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from capture.frame_header import FrameHeader, ImageLayout
from capture.ledger import Ledger, LedgerEntry, Verdict
from capture.manifest import TakeManifest
from capture.recover import recover_take
from capture.take import Take
from capture.take_writer import TakeWriter, partial_folder
from capture.verify import settle, verify_take

LAYOUTS = {
    "cam00": ImageLayout(40, 24, 1, "uint8"),
    "cam01": ImageLayout(24, 20, 1, "uint16"),
    "cam02": ImageLayout(17, 13, 3, "uint8"),
}
NAMES = tuple(LAYOUTS)


def picture(device: str, k: int) -> np.ndarray:
    """What a device shows at a trigger: another picture for each."""
    layout = LAYOUTS[device]
    count = int(np.prod(layout.shape))
    flat = np.arange(count, dtype=np.int64) * 7 + 31 * NAMES.index(device) + 101 * k
    top = int(np.iinfo(layout.dtype).max)
    return (flat % (top - 4)).astype(layout.dtype).reshape(layout.shape)


@dataclass(frozen=True, kw_only=True)
class Case:
    """One recording, and how it ends.

    Attributes:
        folder: the final place of the take.
        frames: triggers.
        acks: a file to which every frame is told once `write` has returned.
        kill_after_s: SIGKILL comes so long after the first frame; None: it is not killed.
        torn_call: the `writev` at which half a record is written, and the process dies; None: none.
        torn_share: how much of that record is written.
        short: whether `writev` takes only a part of what it is given, slowly.
        close: whether the take is finished and settled after its last frame.
        recover: not a recording: the process runs `recover_take` on what is there.
    """

    folder: str
    frames: int = 12
    acks: str = ""
    kill_after_s: float | None = None
    torn_call: int | None = None
    torn_share: float = 0.5
    short: bool = False
    close: bool = True
    recover: bool = False


def open_writer(final: Path, frames: int) -> TakeWriter:
    """The writer of a take as a recording opens it."""
    shot = {"slate": final.name[:-4], "kind": "expression", "frames": frames}
    return TakeWriter(
        partial_folder(final),
        LAYOUTS,
        opening={
            "shot": shot,
            "take_number": int(final.name[-3:]),
            "train": {"start_ns": 1000, "period_ns": 10},
        },
        expected_frames=frames,
    )


def write_frame(writer: TakeWriter, device: str, k: int) -> None:
    """Write the frame of one device at one trigger."""
    header = FrameHeader(k, 0, 500 + k, 10**9 + k, 10**10 + 10 * k, 3000.0)
    writer.write(device, header, picture(device, k))


def finish(writer: TakeWriter, final: Path, frames: int) -> Take:
    """Close a take, read it back and settle it."""
    close_files(writer, final, frames)
    take = Take.open(writer.folder)
    return settle(take, verify_take(take))


def close_files(writer: TakeWriter, final: Path, frames: int) -> None:
    """Close a take's files, and write ledger and manifest."""
    entries = tuple(
        LedgerEntry(k, name, Verdict.OK, 500 + k, 10**9 + k, 10**10 + 10 * k, 1000 + 10 * k)
        for k in range(frames)
        for name in NAMES
    )
    remarks = {
        "shot": {"slate": final.name[:-4], "kind": "expression"},
        "take_number": int(final.name[-3:]),
        "judgement": {"colour": "green", "sentence": "", "spread_ns": 0},
    }
    writer.finish(
        lambda devices: TakeManifest(
            name=final.name, kind="capture", devices=devices, frame_count=frames, remarks=remarks
        ),
        ledger=Ledger(NAMES, frames, entries),
        hashed=False,
    )


def acknowledged(path: Path) -> dict[str, set[int]]:
    """By device, the triggers whose frames had been written when the process died."""
    out: dict[str, set[int]] = {name: set() for name in NAMES}
    if path.is_file():
        for line in path.read_text().splitlines():
            device, k = line.split()
            out[device].add(int(k))
    return out


class Recorder:
    """The process that serves cases; used in a `with` block."""

    def __enter__(self) -> Recorder:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.capture.disk_faults"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=Path(__file__).resolve().parents[2],
        )
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._process.communicate()  # it ends with its input

    def run(self, case: Case) -> bool:
        """Run a case to its end; whether the process died by a signal."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(asdict(case)) + "\n")
        self._process.stdin.flush()
        status = json.loads(self._process.stdout.readline())["status"]
        assert status in (0, -signal.SIGKILL), f"the recording failed with status {status}"
        return bool(status)


def _serve() -> None:
    for line in sys.stdin:
        case = Case(**json.loads(line))
        ready_read, ready_write = os.pipe()
        child = os.fork()
        if child == 0:
            status = 1
            try:
                os.close(ready_read)
                _record(case, ready_write)
                status = 0
            finally:
                os._exit(status)
        os.close(ready_write)
        os.read(ready_read, 1)  # or its end, when the process has ended
        os.close(ready_read)
        if case.kill_after_s is not None:
            time.sleep(case.kill_after_s)
            os.kill(child, signal.SIGKILL)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        print(json.dumps({"status": status}), flush=True)


def _record(case: Case, ready: int) -> None:
    final = Path(case.folder)
    if case.recover:
        os.write(ready, b"r")
        recover_take(partial_folder(final))
        return
    acks = os.open(case.acks, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    with open_writer(final, case.frames) as writer:
        _spoil_writev(case)
        os.write(ready, b"r")
        for k in range(case.frames):
            for device in NAMES:
                write_frame(writer, device, k)
                os.write(acks, f"{device} {k}\n".encode())
        if case.close:
            finish(writer, final, case.frames)


def _spoil_writev(case: Case) -> None:
    """Let the system write less than it was asked for, as it may, or die in the middle of it."""
    calls, write_all = 0, os.writev

    def spoilt(handle: int, parts: Any) -> int:
        nonlocal calls
        calls += 1
        joined = b"".join(parts)
        if calls - 1 == case.torn_call:
            os.write(handle, joined[: int(case.torn_share * len(joined))])
            os.kill(os.getpid(), signal.SIGKILL)
        if case.short and len(joined) > 1:
            time.sleep(2e-4)
            return os.write(handle, joined[: 1 + len(joined) // 3])
        return write_all(handle, parts)

    os.writev = spoilt


if __name__ == "__main__":
    _serve()
