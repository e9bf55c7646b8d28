"""A small stand for whole sessions: simulated devices in real time, and somebody at the keys."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from capture.devices.array import DeviceArray
from capture.devices.faults import Fault, FaultKind
from capture.devices.simulated import StreamingDevice, streaming_array
from capture.errors import LikenessError
from capture.frame_header import ImageLayout
from capture.live import LiveArray
from capture.preflight.finding import Finding
from capture.progress import Progress
from capture.recorder import RecordSettings
from capture.rom.conductor import Conductor, Stand
from capture.rom.events import Key
from capture.rom.shot_list import Prompt, PromptList
from capture.rom.state import Stage
from capture.rom.view import View
from capture.session import Session

LAYOUT = ImageLayout(24, 16, 1, "uint8")
SETTINGS = RecordSettings(rate_hz=100, exposure_us=1000, pre_roll=2, post_roll=2)
SLATES = ("neutral", "smile", "frown")
FRAMES = 16  # of a shot


def short_list(*slates: str, total_s: float = 0.16) -> PromptList:
    """Prompts of 0.16 s, held for half of it, after a countdown of 0.05 s."""
    return PromptList(
        name="short",
        title="Short",
        prompts=tuple(
            Prompt(
                slate=slate,
                title=slate.capitalize(),
                sentence="As you like.",
                kind="expression",
                hold_s=total_s / 2,
                total_s=total_s,
                countdown_s=0.05,
            )
            for slate in slates or SLATES
        ),
    )


@dataclass
class Rehearsal:
    """One session on a stand of simulated devices; each `conductor()` is one run of the program."""

    folder: Path
    prompts: PromptList = field(default_factory=short_list)
    devices: int = 2
    findings: Sequence[Finding] = ()
    fails: str = ""  # why the check itself fails
    keep_green: bool = True
    reserve_bytes: int = 0

    def __post_init__(self) -> None:
        self.array: DeviceArray = streaming_array(self.devices, LAYOUT, seed=3)
        self.live = LiveArray(self.array, SETTINGS)

    def conductor(self) -> Conductor:
        """A conductor that takes up the session."""
        return Conductor(self.stand())

    def stand(self) -> Stand:
        """What it stands on."""
        return Stand(
            session=Session.create(self.folder),
            prompts=self.prompts,
            array=self.live,
            settings=SETTINGS,
            frame_set_bytes=self.devices * LAYOUT.nbytes,
            preflight=self._preflight,
            keep_green=self.keep_green,
            reserve_bytes=self.reserve_bytes,
        )

    def spoil(self, kind: FaultKind, device: int = 0, triggers: int = 1) -> None:
        """Let something go wrong at a device, at the next trigger."""
        found = self.array.devices[device]
        assert isinstance(found, StreamingDevice)
        found.inject(Fault(kind, triggers=triggers))

    def _preflight(self, heard: Progress) -> Sequence[Finding]:
        heard(0, 1, "preflight: rehearsal")
        if self.fails:
            raise LikenessError(self.fails)
        assert len(self.live.latest()) == self.devices, "the array streams before it is checked"
        return self.findings


def until(conductor: Conductor, what: Callable[[View], bool], timeout_s: float = 10.0) -> View:
    """Tick until the view is as it should be."""
    deadline = time.monotonic() + timeout_s
    while True:
        conductor.tick()
        view = conductor.view()
        if what(view):
            return view
        assert time.monotonic() < deadline, view
        time.sleep(0.005)


def arm(conductor: Conductor) -> View:
    """Arm and wait for it."""
    assert conductor.key(Key.ARM) == ""
    return until(conductor, lambda view: view.stage == Stage.ARMED)


def begin(conductor: Conductor, *, seen: Callable[[View], None] = lambda view: None) -> View:
    """Record the present prompt; tried again where a busy machine made devices silent meanwhile.

    Args:
        conductor: of the session.
        seen: told of each view of the countdown.
    """

    def begun(view: View) -> bool:
        if view.stage == Stage.ARMED:
            conductor.key(Key.GO)
            view = conductor.view()
        if view.stage == Stage.COUNTDOWN:
            seen(view)
        return view.stage == Stage.RECORD

    return until(conductor, begun)


def take(conductor: Conductor) -> View:
    """Record the present prompt and wait until it is written."""
    begin(conductor)
    return until(conductor, lambda view: view.stage == Stage.ARMED)


def quiet(view: View) -> bool:
    """Whether nothing is being recorded, written or read back."""
    return all(take.phase in ("done", "failed") for take in view.takes)
