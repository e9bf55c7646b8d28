"""The event log: appended, synced, torn by a crash at any byte, and read back."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from capture.errors import TakeError, WorkError
from capture.event_log import EventLog, LoggedEvent, read_events


def test_what_was_written_is_read_back_with_both_times(tmp_path: Path) -> None:
    path = tmp_path / "session" / "events.jsonl"
    wall, mono = iter([1000, 900]), iter([10, 20])  # the clock on the wall may go back
    with EventLog(path, wall_ns=lambda: next(wall), mono_ns=lambda: next(mono)) as log:
        log.add("key", key="go", slate="smile")
        log.add("told", text="Größe - 3 lost\nhere")
    history = read_events(path)
    assert history.problems == ()
    assert history.events == (
        LoggedEvent("key", 1000, 10, {"key": "go", "slate": "smile"}),
        LoggedEvent("told", 900, 20, {"text": "Größe - 3 lost\nhere"}),
    )


def test_a_log_torn_at_any_byte_loses_only_its_last_line_and_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    with EventLog(path, wall_ns=lambda: 1, mono_ns=lambda: 2) as log:
        for number in range(2):
            log.add("n", number=number)
    whole = path.read_bytes()
    ends = [place + 1 for place, byte in enumerate(whole) if byte == 10]
    for cut in range(len(whole) + 1):
        path.write_bytes(whole[:cut])
        complete = sum(end <= cut for end in ends)
        torn = cut not in (0, *ends)
        history = read_events(path)
        assert [event.fields["number"] for event in history.events] == list(range(complete))
        assert len(history.problems) == torn
        if torn:
            assert f"{path}:{complete + 1}: the last line is torn, skipped" in history.problems[0]
        with EventLog(path) as log:
            log.add("n", number=9)
        after = read_events(path)
        # A line of which only its end was missing is whole again: nothing of it had been lost.
        healed = cut + 1 in ends
        assert [event.fields["number"] for event in after.events] == [
            *range(complete + healed),
            9,
        ]
        assert len(after.problems) == (torn and not healed)


def test_a_killed_writer_loses_nothing_it_was_told_is_written(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    code = (
        "import sys; from pathlib import Path; from capture.event_log import EventLog\n"
        "log = EventLog(Path(sys.argv[1]))\n"
        "for number in range(10**6):\n"
        "    log.add('n', number=number)\n"
        "    print(number, flush=True)\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    for line in process.stdout:
        if int(line) >= 40:
            os.kill(process.pid, signal.SIGKILL)
            break
    told = 40 + len(process.stdout.read().split())
    process.stdout.close()
    process.wait()
    history = read_events(path)
    assert len(history.events) >= told + 1
    assert [event.fields["number"] for event in history.events] == list(range(len(history.events)))


def test_lines_that_are_none_are_skipped_and_told(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    good = b'{"kind": "key", "t_wall_ns": 1, "t_mono_ns": 2}\n'
    path.write_bytes(good + b"\xff\xfe\n[1]\n" + b"[" * 100_000 + b'\n{"kind": 3}\n\n' + good)
    history = read_events(path)
    assert len(history.events) == 2
    assert [problem.split(":")[1] for problem in history.problems] == ["2", "3", "4", "5"]


def test_a_full_disk_takes_no_half_line(tmp_path: Path) -> None:
    with pytest.raises(WorkError, match=r"/dev/full: not written: No space left on device"):
        EventLog(Path("/dev/full")).add("key")
    with pytest.raises(WorkError, match="cannot be written"):
        EventLog(tmp_path)
    with pytest.raises(TakeError, match="not readable"):
        read_events(tmp_path / "none.jsonl")
