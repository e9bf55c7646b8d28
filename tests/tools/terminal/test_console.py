"""The console against simulated devices in real time, played by keys as an operator would."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path

import pytest
from textual import events
from textual.pilot import Pilot

from capture.devices.array import DeviceArray
from capture.devices.faults import Fault, FaultKind
from capture.devices.lines import RealTimeLine
from capture.devices.simulated import SimulatedBackend, StreamingDevice
from capture.judgement import Colour
from capture.live import LiveArray
from capture.preflight import Finding
from capture.recorder import RecordSettings
from capture.rom.conductor import Conductor, Stand
from capture.rom.shot_list import Prompt, PromptList
from capture.rom.state import Stage
from capture.session import Session
from capture.take_notes import NoteBook, TakeStatus
from tools.terminal.console import Console

LIMIT_S = 20.0
_CHARACTERS = {"space": " ", "enter": "\r"}
PROMPTS = PromptList(
    name="two",
    title="Two",
    prompts=tuple(
        Prompt(
            slate=slate,
            title=slate.title(),
            sentence=f"Do the {slate}.",
            kind="expression",
            hold_s=0.1,
            total_s=total_s,
            countdown_s=0.1,
        )
        for slate, total_s in (("smile", 0.2), ("jaw", 0.2), ("long", 30.0))
    ),
)


class Room:
    """A console and all that stands behind it."""

    def __init__(self, folder: Path) -> None:
        backend = SimulatedBackend(RealTimeLine())
        devices = [backend.open(f"64x48?seed={n}", f"cam{n:02d}") for n in range(1, 4)]
        self.devices: list[StreamingDevice] = devices
        settings = RecordSettings(rate_hz=50.0)
        self.array = DeviceArray(tuple(devices), backend.line())
        self.live = LiveArray(self.array, settings)
        self.remarks: list[str] = []
        self.findings: list[Finding] = []
        self.session = Session.create(folder / "session")
        self.conductor = Conductor(
            Stand(
                session=self.session, prompts=PROMPTS, array=self.live, settings=settings,
                frame_set_bytes=3 * 64 * 48, reserve_bytes=0,
                preflight=lambda _: self.findings,
            )
        )  # fmt: skip


def screen(console: Console) -> str:
    """What stands on the screen, as text."""
    strips = console.screen._compositor.render_strips()
    return "\n".join("".join(segment.text for segment in strip) for strip in strips)


async def until(pilot: Pilot[None], wanted: Callable[[], bool], what: str) -> None:
    for _ in range(round(LIMIT_S / 0.02)):
        if wanted():
            return
        await pilot.pause(0.02)
    pytest.fail(f"waited for {what}:\n{screen(pilot.app)}")  # type: ignore[arg-type]


async def press(pilot: Pilot[None], *keys: str) -> None:
    """Press keys. `Pilot.press` waits until the process is idle, which it never is: it streams."""
    for key in keys:
        character = key if len(key) == 1 else _CHARACTERS.get(key)
        pilot.app.post_message(events.Key("space" if key == " " else key, character))
    await pilot.pause(0.05)  # all of them at once, as from fast fingers


async def armed(pilot: Pilot[None], console: Console) -> None:
    await press(pilot, "a")
    await until(pilot, lambda: console._view.stage == Stage.ARMED, "armed")


async def recorded(pilot: Pilot[None], console: Console) -> None:
    """Record a take, to the moment it was read back."""
    before = len(console._view.takes)
    await press(pilot, "space")
    await until(
        pilot,
        lambda: (
            len(console._view.takes) > before
            and console._view.stage == Stage.ARMED
            and console._view.takes[-1].phase == "done"
        ),
        "a take",
    )


def play(room: Room, script: Callable[[Pilot[None], Console], Awaitable[None]]) -> None:
    """Enter the session, open the console at 80 x 24, play, leave."""

    async def run(conductor: Conductor) -> None:
        console = Console(conductor, room.array.names, remarks=room.remarks)
        async with console.run_test(size=(80, 24)) as pilot:
            await script(pilot, console)

    with room.conductor as conductor:
        asyncio.run(run(conductor))


@pytest.fixture
def room(tmp_path: Path) -> Iterator[Room]:
    made = Room(tmp_path)
    yield made
    made.array.close()


def test_an_operator_records_two_prompts_notes_one_and_takes_it_again(room: Room) -> None:
    async def script(pilot: Pilot[None], console: Console) -> None:
        await armed(pilot, console)
        assert "Do the smile." in screen(console)
        await recorded(pilot, console)
        if console._view.prompt.slate == "smile":  # a busy machine lost frames: it stays there
            await press(pilot, "n")
        await recorded(pilot, console)
        assert [take.name for take in console._view.takes] == ["smile_001", "jaw_001"]
        assert f">jaw_001 {console._view.takes[-1].colour}".lower() in screen(console).lower()
        await press(pilot, "t", *"lid 2 twitched", "4")
        # On disk at once, with no key that ends it.
        assert NoteBook.of_session(room.session.folder).read("jaw_001").text == "lid 2 twitched4"
        await press(pilot, "escape", "4", "r")
        await until(pilot, lambda: console._view.prompt.slate == "jaw", "the prompt of the retake")
        await recorded(pilot, console)
        await press(pilot, "down", "f", "q")

    play(room, script)
    notes = NoteBook.of_session(room.session.folder).all()
    assert (notes["jaw_001"].text, notes["jaw_001"].rating) == ("lid 2 twitched4", 4)
    assert notes["jaw_001"].status == TakeStatus.FLAG
    takes = {note.folder.name: note.superseded for note in room.session.takes()}
    assert takes == {"smile_001": False, "jaw_001": True, "jaw_002": False}


def test_a_dead_device_is_told_and_found_again_while_the_console_lives(room: Room) -> None:
    async def script(pilot: Pilot[None], console: Console) -> None:
        await armed(pilot, console)
        room.remarks.append("trigger 7: no answer from cam09")
        await until(pilot, lambda: "trigger 7: no answer" in screen(console), "a remark")
        room.devices[1].inject(Fault(FaultKind.DEATH))
        await until(pilot, lambda: "cam02 RED" in screen(console), "a red tile")
        assert "Lost: cam02." in screen(console)
        await press(pilot, "space")
        await pilot.pause(0.1)
        assert console._view.stage == Stage.ARMED
        assert "! cam02 is lost" in screen(console).replace("\n", " ")
        await press(pilot, "c")
        await until(pilot, lambda: "Look for which" in screen(console), "the list")
        await press(pilot, *"cam02", "enter")
        await until(pilot, lambda: "cam02 green" in screen(console), "the device again")
        await recorded(pilot, console)
        assert ">smile_001 " in screen(console)
        # The same while all are stopped: it would keep the array from being armed.
        await press(pilot, "d")
        await until(pilot, lambda: not room.live.running, "stopped devices")
        room.devices[1].inject(Fault(FaultKind.DEATH))
        await press(pilot, "c")
        await until(pilot, lambda: "Look for which" in screen(console), "the list")
        await press(pilot, *"cam02", "enter")
        await until(pilot, lambda: screen(console).count("cam02 is connected") == 2, "the device")
        await armed(pilot, console)
        await press(pilot, "q")

    play(room, script)


def test_a_red_check_is_shown_with_its_remedy_and_overruled_with_a_reason(room: Room) -> None:
    dark = Finding("exposure", "cam02", Colour.RED, "cam02 is dark.", "Take its cap off.")
    room.findings.append(dark)

    async def script(pilot: Pilot[None], console: Console) -> None:
        await press(pilot, "a")
        await until(pilot, lambda: "Take its cap off." in screen(console), "the finding")
        assert console._view.stage == Stage.PREFLIGHT
        await press(pilot, "space")
        assert "The preflight was red" in screen(console)
        await press(pilot, "o")
        await until(pilot, lambda: "Arm against the check" in screen(console), "the question")
        await press(pilot, "enter")  # without a reason nothing happens
        assert console._view.stage == Stage.PREFLIGHT
        await press(pilot, *"only a rehearsal", "enter")
        await until(pilot, lambda: console._view.stage == Stage.ARMED, "armed")
        assert console._view.preflight is not None
        assert console._view.preflight.reason == "only a rehearsal"
        await press(pilot, "q")

    play(room, script)


def test_leaving_while_a_take_is_recorded_asks_and_keeps_what_there_is(room: Room) -> None:
    async def script(pilot: Pilot[None], console: Console) -> None:
        await armed(pilot, console)
        await press(pilot, "g")
        await until(pilot, lambda: "Go to which" in screen(console), "the list")
        await press(pilot, *"long", "enter")
        await until(pilot, lambda: console._view.prompt.slate == "long", "the prompt")
        await press(pilot, "space")
        await until(pilot, lambda: console._view.fraction > 0.01, "a take that runs")
        await press(pilot, "q")
        await until(pilot, lambda: "y: yes" in screen(console), "the question")
        await press(pilot, "n")
        assert console._view.stage == Stage.RECORD
        await press(pilot, "q")
        await until(pilot, lambda: "y: yes" in screen(console), "the question again")
        await press(pilot, "y")

    play(room, script)
    (take,) = room.session.takes()
    assert take.folder.name == "long_001"
