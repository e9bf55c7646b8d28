"""The conductor: drives the state machine with a real array, and says what a front end draws.

A front end calls `tick` about twenty times a second, `key` for what the operator asks for, `note`
and `rate` for what the operator writes, and draws `view()`. All from one thread; nothing waits.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from types import TracebackType

from capture.device_watch import DeviceState
from capture.errors import LikenessError, WorkError
from capture.judgement import Colour
from capture.live_take import TakePhase
from capture.preflight.finding import Finding
from capture.progress import Progress
from capture.recorder import RecordSettings
from capture.rom.contract import StreamingArray
from capture.rom.disk_watch import DiskWatch
from capture.rom.events import (
    DevicesLost,
    DiskLeft,
    Event,
    Key,
    KeyPressed,
    PreflightDone,
    TakeNotStarted,
    TakeStarted,
    Tick,
)
from capture.rom.keeper import Keeper
from capture.rom.machine import Machine
from capture.rom.news import TakeWatch
from capture.rom.preparation import Preparation
from capture.rom.shot_list import PromptList
from capture.rom.show import Sight, draw
from capture.rom.state import RomState, Stage, Task
from capture.rom.view import Message, View
from capture.session import Session

_MESSAGES = 200
_DISK_S = 1.0
_HEALTH_S = 1.0
_LATE_S = 3.0  # how long after its planned end a take may stay open
_STREAMING = (Stage.ARMED, Stage.COUNTDOWN, Stage.RECORD, Stage.DRAIN)


@dataclass(frozen=True, kw_only=True)
class Stand:
    """All that a session is recorded with.

    Attributes:
        session: where the takes go.
        prompts: what is recorded.
        array: streams the devices; started and stopped by the conductor, not entered or left.
        settings: of the recording.
        frame_set_bytes: of the frames of all devices at one trigger.
        preflight: checks the streaming array; called in a thread of its own, with whom to tell how
            far it is.
        keep_green: whether a green take that was read back whole is kept without a key.
        reserve_bytes: of the disk, what must stay free.
    """

    session: Session
    prompts: PromptList
    array: StreamingArray
    settings: RecordSettings
    frame_set_bytes: int
    preflight: Callable[[Progress], Sequence[Finding]] = lambda _: ()
    keep_green: bool = True
    reserve_bytes: int = 1 << 30


class Conductor:
    """Drives one session. Used in a `with` block, from one thread.

    On entry it takes up the session where it stood: at the same prompt, with all its takes. On exit
    it waits for takes that are being written and stops the array.
    """

    def __init__(self, stand: Stand, *, now_s: Callable[[], float] = time.monotonic) -> None:
        """Hold a stand; nothing is read, written or started yet.

        Args:
            stand: what to record with.
            now_s: a clock that never goes back, for keys; ticks may bring their own time.
        """
        self._stand, self._now_s = stand, now_s
        settings = stand.settings
        after_s = settings.post_roll / settings.rate_hz + settings.retention_ms / 1000
        self._machine = Machine(
            prompts=stand.prompts, keep_green=stand.keep_green, late_s=_LATE_S + after_s
        )
        self._state = RomState()
        self._messages: deque[Message] = deque(maxlen=_MESSAGES)
        self._keeper = Keeper(stand.session, stand.prompts)
        self._preparation = Preparation(stand.array, stand.preflight)
        self._takes = TakeWatch()
        self._disk = DiskWatch(stand.session, stand.settings, stand.frame_set_bytes)
        self._disk_due_s = self._health_due_s = float("-inf")
        self._devices: tuple[DeviceState, ...] = ()
        self._array_trouble = ""
        self._at_s = float("-inf")

    def __enter__(self) -> Conductor:
        """Take up the session.

        Raises:
            TakeError: when what it left on disk is damaged; the message names the file.
            WorkError: when its folder cannot be written.
        """
        self._state, told = self._keeper.open()
        self._disk.take_up()
        stand = self._stand
        self._keeper.log(
            "opened", session=stand.session.name, shot_list=stand.prompts.name,
            prompt=self._prompt_slate, takes=len(self._state.takes),
        )  # fmt: skip
        for sentence in told:
            self._say(Colour.AMBER, sentence)
        self.tick()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the take that is being recorded, wait for all, stop the array."""
        try:
            self._takes.stop(self._state.current)
            self._state = replace(self._state, closing=True)
            problem = self._preparation.close()
            if problem:
                self._say(Colour.RED, problem)
            self._takes.wait()
            for event in self._takes.news(self._now()):
                self._apply(event)
            self._keeper.log("closed", prompt=self._prompt_slate, takes=len(self._state.takes))
            self._keeper.keep(self._state)
        finally:
            self._keeper.close()

    def tick(self, now_s: float | None = None) -> None:
        """Look at devices, takes and disk, and let time pass; about twenty times a second.

        Args:
            now_s: the time; by the conductor's clock when not given.
        """
        at_s = self._now(now_s)
        for problem in self._preparation.problems():
            self._say(Colour.RED, problem)
        for device, problem in self._preparation.searched():
            self._keeper.log("reconnected", device=device, problem=problem)
            self._say(Colour.RED if problem else Colour.GREEN, problem or f"{device} is connected.")
        done = self._preparation.finished()
        if done is not None:
            self._keeper.log("preflight", findings=[asdict(f) for f in done.findings])
            self._apply(
                PreflightDone(
                    at_s=at_s, colour=done.colour, sentence=done.sentence, streaming=done.streaming
                )
            )
        for event in self._takes.news(at_s):
            self._apply(event)
        for finished in self._takes.finished():
            self._disk.observe(finished)
        self._look_at_devices(at_s)
        if at_s >= self._disk_due_s:
            self._look_at_disk(at_s)
        self._apply(Tick(at_s=at_s))
        self._keeper.keep(self._state)
        for problem in self._keeper.problems():
            self._trouble(problem)

    def key(self, key: Key, *, slate: str = "", take: str = "", reason: str = "") -> str:
        """Do what the operator asks for.

        Args:
            key: what for.
            slate: of the prompt, for JUMP.
            take: by name, for KEEP, FLAG, RETAKE, OVERRULE; empty: the latest.
            reason: for OVERRULE.

        Returns:
            Why it was refused, or "".
        """
        at_s = self._now()
        if key in (Key.ARM, Key.GO):
            self._look_at_disk(at_s)
        pressed = KeyPressed(at_s=at_s, key=key, slate=slate, take=take, reason=reason)
        refusal = self._apply(pressed)
        self._keeper.log(
            "key", key=str(key), slate=slate, take=take, reason=reason, refusal=refusal
        )
        self._keeper.keep(self._state)
        return refusal

    def reconnect(self, device: str) -> str:
        """Look for a lost device again, beside all else; a message says what came of it.

        Args:
            device: by name.

        Returns:
            Why it is not looked for, or "".
        """
        self._preparation.reconnect(device)
        self._say(Colour.GREEN, f"Looking for {device} ...")
        return ""

    def note(self, take: str, text: str) -> str:
        """Set the text of a take's note; called at every keystroke, saved at every call.

        Returns:
            Why it was not saved, or "".
        """
        if self._state.take(take) is None:
            return f"There is no take {take!r}."
        return self._keeper.change_note(take, text=text)

    def rate(self, take: str, stars: int) -> str:
        """Set the rating of a take, 0 to 5; returns why it was not saved, or ""."""
        if self._state.take(take) is None:
            return f"There is no take {take!r}."
        problem = self._keeper.change_note(take, rating=stars)
        self._keeper.log("rating", take=take, stars=stars, refusal=problem)
        return problem

    def view(self) -> View:
        """What there is to draw now."""
        return draw(
            Sight(
                at_s=self._at_s,
                session=self._stand.session.name,
                machine=self._machine,
                state=self._state,
                note=self._keeper.note,
                fractions=self._takes.fractions(),
                devices=self._devices,
                disk=self._disk.forecast,
                checking=self._preparation.at,
                findings=self._preparation.findings,
                messages=tuple(self._messages),
            )
        )

    @property
    def _prompt_slate(self) -> str:
        return self._machine.prompt(self._state).slate

    def _now(self, now_s: float | None = None) -> float:
        """The time, which never goes back."""
        self._at_s = max(self._at_s, self._now_s() if now_s is None else now_s)
        return self._at_s

    def _apply(self, event: Event) -> str:
        """Take a step, write down what it changed, and do what it asks for."""
        before = self._state
        step = self._machine.step(before, event)
        self._state = step.state
        self._log_changes(before)
        for colour, text in step.told:
            self._say(colour, text)
        for task in step.tasks:
            self._do(task, event.at_s)
        if step.refusal and not isinstance(event, KeyPressed):
            self._keeper.log("ignored", event=type(event).__name__, why=step.refusal)
        return step.refusal

    def _do(self, task: Task, at_s: float) -> None:
        match task:
            case Task.START:
                self._preparation.start()
            case Task.STOP:
                self._preparation.stop()
            case Task.CLOSE:
                self._takes.stop(self._state.current)
            case Task.RECORD:
                self._record(at_s)

    def _record(self, at_s: float) -> None:
        stand, prompt = self._stand, self._machine.prompt(self._state)
        try:
            take = stand.array.record(stand.session, prompt.shot(stand.settings))
        except LikenessError as error:
            self._apply(TakeNotStarted(at_s=at_s, error=str(error)))
            return
        self._takes.add(take)
        self._apply(TakeStarted(at_s=at_s, take=take.folder.name, number=take.number))

    def _look_at_devices(self, at_s: float) -> None:
        """Devices that have become silent, or are back."""
        if self._state.stage not in _STREAMING:
            self._devices = self._stand.array.states() if self._preparation.streaming else ()
            if self._state.lost:
                self._apply(DevicesLost(at_s=at_s, devices=()))
            return
        colours = {device.name: device.colour for device in self._devices}
        self._devices = self._stand.array.states()
        for device in self._devices:
            if device.colour != colours.get(device.name, Colour.GREEN):
                self._keeper.log(
                    "device", device=device.name, colour=str(device.colour),
                    sentence=device.sentence, received=device.received, not_ok=device.not_ok,
                )  # fmt: skip
        trouble = self._stand.array.trouble
        if trouble and trouble != self._array_trouble:
            self._say(Colour.RED, f"The array has stopped: {trouble} Disarm, and arm it again.")
        self._array_trouble = trouble
        lost = tuple(
            device.name for device in self._devices if trouble or device.colour == Colour.RED
        )
        if lost != self._state.lost:
            self._apply(DevicesLost(at_s=at_s, devices=lost))
        if at_s >= self._health_due_s:
            self._health_due_s = at_s + _HEALTH_S
            self._log_health()

    def _log_health(self) -> None:
        """What the devices say of themselves: kept for later, never trusted for a verdict."""
        health = self._stand.array.health()
        self._keeper.log(
            "health",
            devices={
                device.name: {
                    "received": device.received,
                    "not_ok": device.not_ok,
                    "taken": device.taken,
                    "says": asdict(health[device.name]) if device.name in health else None,
                }
                for device in self._devices
            },
        )

    def _look_at_disk(self, at_s: float) -> None:
        self._disk_due_s = at_s + _DISK_S
        try:
            disk = self._disk.look(
                self._machine, self._state, reserve_bytes=self._stand.reserve_bytes
            )
        except WorkError as error:
            self._trouble(str(error))
            return
        if disk.takes_left != self._state.takes_left:
            self._keeper.log("disk", takes_left=disk.takes_left, free_bytes=disk.free_bytes)
            self._apply(DiskLeft(at_s=at_s, takes=disk.takes_left))

    def _log_changes(self, before: RomState) -> None:
        now = self._state
        if (now.stage, now.place) != (before.stage, before.place):
            self._keeper.log("stage", stage=str(now.stage), prompt=self._prompt_slate)
        if now.takes == before.takes:
            return
        for take in now.takes:
            old = before.take(take.name)
            if take == old:
                continue
            if old is None or take.phase != old.phase:
                self._keeper.log(
                    "take", take=take.name, phase=str(take.phase), colour=take.colour,
                    sentence=take.sentence, problems=take.problems,
                )  # fmt: skip
            if old is not None and take.phase == TakePhase.DRAINING != old.phase:
                self._keeper.log("sync", take=take.name, **self._takes.sync(take.name))
            if take.status != (old.status if old is not None else "undecided"):
                self._keeper.log(
                    "decision", take=take.name, status=str(take.status), by=take.decided_by,
                    reason=take.overruled.reason if take.overruled else "",
                )  # fmt: skip

    def _say(self, colour: Colour, text: str) -> None:
        self._messages.append(Message(at_s=self._at_s, colour=colour, text=text))
        self._keeper.log("told", colour=str(colour), text=text)

    def _trouble(self, problem: str) -> None:
        """The disk refuses: shown once, not logged, since the log may be what is refused."""
        if not any(message.text == problem for message in self._messages):
            self._messages.append(Message(at_s=self._at_s, colour=Colour.RED, text=problem))
