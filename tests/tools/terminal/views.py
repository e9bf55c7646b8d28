"""Views to draw, made of plain values."""

from __future__ import annotations

from dataclasses import replace

from capture.device_watch import DeviceState
from capture.disk import DiskForecast
from capture.judgement import Colour
from capture.live_take import TakePhase
from capture.preflight.finding import Finding
from capture.rom.events import Key
from capture.rom.shot_list import Prompt
from capture.rom.state import PreflightState, Stage
from capture.rom.view import Cue, Message, PromptView, TakeView, View
from capture.take_notes import OperatorNote, TakeStatus

SMILE = Prompt(
    slate="smile", title="Smile", sentence="Smile as wide as you can, teeth apart.",
    kind="expression",
)  # fmt: skip
JAW = replace(SMILE, slate="jaw_open", title="Jaw open", sentence="Drop the jaw.")


def device(
    name: str, colour: Colour = Colour.GREEN, sentence: str = "", age_s: float | None = 0.013
) -> DeviceState:
    return DeviceState(name, colour, sentence, age_s, 1500, 0 if not sentence else 7, 3, 100)


def take(number: int, colour: Colour | None, note: OperatorNote, **changes: object) -> TakeView:
    one = TakeView(
        name=f"smile_{number:03d}", slate="smile", number=number, phase=TakePhase.DONE,
        fraction=1.0, colour=colour, sentence="All 150 frame sets are complete.", note=note,
        superseded=False,
    )  # fmt: skip
    return replace(one, **changes)  # type: ignore[arg-type]


def armed() -> View:
    """Sixteen devices, one red and one amber; two takes of a smile."""
    devices = [device(f"cam{n:02d}") for n in range(1, 17)]
    devices[2] = device("cam03", Colour.RED, "silent for 2.1 s", 2.1)
    devices[9] = device("cam10", Colour.AMBER, "60 of 100 frames of memory in use")
    takes = (
        take(1, Colour.RED, OperatorNote(status=TakeStatus.RETAKE), superseded=True,
             sentence="cam03 sent nothing for frames 7 to 90."),
        take(2, Colour.GREEN, OperatorNote(rating=4, text="good [teeth]"),
             phase=TakePhase.CHECKING, fraction=0.45),
    )  # fmt: skip
    prompts = (
        PromptView(prompt=SMILE, takes=2, status="current", colour=Colour.GREEN),
        PromptView(prompt=JAW, takes=0, status="", colour=None),
    )
    disk = DiskForecast(
        free_bytes=10**12, take_bytes=10**10, takes_left=94, prompts_left=80, prompts_coming=1,
        colour="green", sentence="",
    )  # fmt: skip
    return View(
        at_s=100.0, session="anna_day1", list_title="Range of motion", stage=Stage.ARMED,
        headline="Armed. Space records smile.", place=0, prompts=prompts, prompt=SMILE,
        next_prompt=JAW, countdown=None, cue=Cue.NONE, fraction=0.0, hold_fraction=0.0,
        takes=takes, current=takes[1], undecided=("smile_002",), devices=tuple(devices),
        disk=disk,
        preflight=PreflightState(colour=Colour.AMBER, sentence="1 device drops", streaming=True),
        findings=(
            Finding("link", "cam07", Colour.RED, "cam07: link carries 1 Gbit/s", "use 10GigE"),
        ),
        messages=(
            Message(at_s=90.0, colour=Colour.GREEN, text="The array is armed."),
            Message(at_s=99.0, colour=Colour.RED, text="Lost: cam03."),
        ),
        offers=frozenset({Key.GO, Key.NEXT}), finished=False,
    )  # fmt: skip
