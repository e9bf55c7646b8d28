"""A take that is being recorded, from the key that begins it until it has been read back."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Any

from capture.arrays import Image
from capture.device_watch import DeviceWatch
from capture.devices.capabilities import FeatureDump
from capture.errors import DeviceError, LikenessError, WorkError
from capture.feature_files import write_features
from capture.judgement import Colour, Judgement
from capture.lanes import LaneJob, WriteLanes
from capture.ledger import Verdict, unwritten
from capture.recorder import Recording, RecordSettings
from capture.session import Shot, judge_take, manifest_of, sync_of
from capture.stream import Stream
from capture.sync_report import SyncReport, ptp_changes_told
from capture.take import Take
from capture.take_writer import TakeWriter, partial_folder
from capture.verify import VerifyReport, VerifySettings, settle, verify_take
from capture.window import HeldFrame, Window

_CHECK = VerifySettings(hashed=False, gently=True)  # hashes follow when the verdict is known
_LOOK_BACK_S = 2.0  # what clocks said shortly before a take belongs to it


class TakePhase(StrEnum):
    """How far a take has come."""

    RECORDING = "recording"  # its window is open
    DRAINING = "draining"  # its last frames are being written; the ledger is known
    CHECKING = "checking"  # it is read back, in the background
    DONE = "done"
    FAILED = "failed"  # what could be saved is saved; `error` says what went wrong


class LiveTake:
    """A take that is being recorded. All attributes may be read from any thread at any time.

    Attributes:
        shot: what is recorded.
        number: of the take, from 1.
        folder: where it will stand once it is done.
        phase: how far it has come.
        judgement: once the phase is past RECORDING: green, amber or red.
        recording: ledger, train and clocks; from the same moment.
        check: what reading it back found; once DONE.
        error: what went wrong; once FAILED.
    """

    def __init__(self, shot: Shot, number: int, folder: Path, opening: Mapping[str, Any]) -> None:
        """Describe a take; `LiveArray.record` makes one.

        Args:
            shot: what is recorded.
            number: of the take.
            folder: where it will stand.
            opening: what its folder says of it while it is recorded.
        """
        self.shot, self.number, self.folder = shot, number, folder
        self.phase = TakePhase.RECORDING
        self.judgement: Judgement | None = None
        self.recording: Recording | None = None
        self.check: VerifyReport | None = None
        self.error = ""
        self._opening = opening
        self._stream: Stream | None = None
        self._lanes: WriteLanes | None = None
        self._window: Window | None = None
        self._writer: TakeWriter | None = None
        self._places: dict[str, int] = {}
        self._first = 0
        self._settings = RecordSettings()
        self._change = threading.Condition()
        self._waiting: list[HeldFrame] = []  # for the files to be made
        self._given_up = False
        self._watch: DeviceWatch | None = None
        self._began_s = time.monotonic()
        self._delivered: set[tuple[int, str]] = set()
        self._written = 0
        self._checked = 0.0
        self._gone: dict[tuple[int, str], str] = {}  # frames that could not be written, and why
        self._noted: Mapping[str, FeatureDump] = {}
        self._unnoted = ""
        self._ended = threading.Event()

    @property
    def name(self) -> str:
        """Its name: slate and number."""
        return self.folder.name

    @property
    def fraction(self) -> float:
        """Of the present phase, 0 to 1."""
        if self.phase == TakePhase.RECORDING and self._stream is not None and self._window:
            sent = self._stream.next_index - self._window.first
            return min(max(sent / self._window.count, 0.0), 1.0)
        if self.phase == TakePhase.DRAINING:
            return self._written / max(len(self._delivered), 1)
        return {TakePhase.RECORDING: 0.0, TakePhase.CHECKING: self._checked}.get(self.phase, 1.0)

    def stop(self) -> None:
        """Close the window now, before its planned end; what was exposed is kept."""
        if self._stream is not None and self._window is not None:
            self._stream.shorten(self._window)

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until it is DONE or FAILED; False when that took too long."""
        return self._ended.wait(timeout_s)

    def begin(self, stream: Stream, lanes: WriteLanes, first: int, count: int) -> None:
        """Open the window; frames are kept until the files are made, which takes a while.

        Args:
            stream: where frames come from.
            lanes: carry them to disk.
            first: its first trigger, counted in the stream.
            count: how many.
        """
        self._stream, self._lanes, self._first = stream, lanes, first
        self._settings = stream.settings
        self._places = {name: place for place, name in enumerate(stream.array.names)}
        self._window = stream.open(first, count, self._deliver)

    def see_through(
        self,
        make: Callable[[], TakeWriter],
        watch: DeviceWatch,
        checking: AbstractContextManager[Any],
    ) -> None:
        """Make its files, wait for its end, close them, read them back, give the take its name.

        Args:
            make: makes the files.
            watch: knows how the devices fared and what they were set to.
            checking: held while it is read back.
        """
        try:
            self._watch = watch
            with make() as writer:
                self._note_features(writer, watch)  # before frames fill the disk
                self._write_to(writer)
                self._save(writer, watch, *self._drained())
                self.phase = TakePhase.CHECKING
                # Still locked, so that nobody recovers what is not lost.
                with checking:
                    take = Take.open(partial_folder(self.folder))
                    self.check = verify_take(take, _CHECK, progress=self._read_back)
                    settle(take, self.check)
            self.phase = TakePhase.DONE
        except (LikenessError, OSError) as error:
            self.error = str(error)
        finally:
            if self.phase != TakePhase.DONE:  # an error that nobody foresaw goes on from here
                self.error = self.error or f"the program is at fault: {sys.exception()!r}"
                self._give_up()
                self.phase = TakePhase.FAILED
            self._ended.set()

    def _deliver(self, frame: HeldFrame) -> None:
        with self._change:
            self._delivered.add((frame.trigger_index - self._first, frame.event.device))
            if self._writer is None and not self._given_up:
                self._waiting.append(frame)
                return
            writer = self._writer
        self._send(frame, writer)

    def _write_to(self, writer: TakeWriter) -> None:
        """The files are made: write what waited for them, and from now on all that comes."""
        with self._change:
            self._writer = writer
            for frame in self._waiting:
                self._send(frame, writer)
            self._waiting.clear()

    def _give_up(self) -> None:
        with self._change:
            self._given_up, self._writer = True, None
            for frame in self._waiting:
                frame.done()
            self._waiting.clear()

    def _send(self, frame: HeldFrame, writer: TakeWriter | None) -> None:
        if writer is None or self._lanes is None:
            frame.done()
            return

        def write(frame: HeldFrame, pixels: Image, crc: int) -> None:
            writer.write(frame.event.device, frame.header(self._first), pixels, crc)
            with self._change:
                self._written += 1
                self._change.notify_all()

        def failed(frame: HeldFrame, why: str) -> None:
            with self._change:
                self._gone[frame.trigger_index - self._first, frame.event.device] = why
                self._change.notify_all()

        self._lanes.put(self._places[frame.event.device], LaneJob(frame, write, failed))

    def _drained(self) -> tuple[Recording, SyncReport, Judgement]:
        """What the take was, once all its frames are written or known to be lost."""
        if self._window is None:
            raise DeviceError(f"{self.name}: never begun")
        self._window.closed.wait()
        try:
            collated = self._window.recording
            if collated is None:
                raise DeviceError(f"{self.name}: the array was stopped before its first frame")
            lost = len(self._gone)
            judged = self._judge(collated)
            self.phase = TakePhase.DRAINING
        finally:
            # Whatever happens: no lane may still write into files that are closed after this.
            with self._change:
                self._change.wait_for(
                    lambda: self._written + len(self._gone) >= len(self._delivered)
                )
        return judged if len(self._gone) == lost else self._judge(collated)

    def _judge(self, collated: Recording) -> tuple[Recording, SyncReport, Judgement]:
        reasons = {
            (entry.trigger_index, entry.device): "it was no longer in the ring"
            for entry in collated.ledger.entries
            if entry.verdict == Verdict.OK
            and (entry.trigger_index, entry.device) not in self._delivered
        }
        ledger = unwritten(collated.ledger, {**reasons, **self._gone})
        recording = replace(collated, ledger=ledger)
        history = (
            []
            if self._watch is None
            else self._watch.ptp_since(time.monotonic() - self._began_s + _LOOK_BACK_S)
        )
        told = tuple(ptp_changes_told(history).values())
        sync = sync_of(recording)
        judgement = judge_take(recording, sync, self.shot, self._settings, told)
        self.recording, self.judgement = recording, judgement
        return recording, sync, judgement

    def _save(
        self,
        writer: TakeWriter,
        watch: DeviceWatch,
        recording: Recording,
        sync: SyncReport,
        verdict: Judgement,
    ) -> None:
        health = watch.health()
        self._note_features(writer, watch)  # of devices that were found again, or answered late
        if self._unnoted:
            verdict = self.judgement = verdict.at_best(Colour.AMBER, f"{self._unnoted}.")
        writer.finish(
            lambda devices: manifest_of(
                self._opening, self.name, devices, recording, sync, verdict, health
            ),
            ledger=recording.ledger,
            hashed=False,
        )

    def _note_features(self, writer: TakeWriter, watch: DeviceWatch) -> None:
        """Write down what devices are set to; a take is not lost when a full disk has no room."""
        known, self._noted = self._noted, watch.features()
        fresh = {name: dump for name, dump in self._noted.items() if known.get(name) is not dump}
        try:
            write_features(writer.folder, fresh)
        except WorkError as error:
            self._unnoted = str(error)

    def _read_back(self, done: int, total: int, what: str) -> None:
        self._checked = done / max(total, 1)
