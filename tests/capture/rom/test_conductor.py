"""Whole sessions, with simulated devices in real time: what the operator sees, and what is kept."""

from __future__ import annotations

import json
import threading
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

from capture.devices.faults import FaultKind
from capture.event_log import read_events
from capture.judgement import Colour
from capture.live_take import TakePhase
from capture.preflight.finding import Finding
from capture.progress import Progress
from capture.rom.conductor import Conductor
from capture.rom.events import Key
from capture.rom.state import Stage
from capture.rom.view import Cue, View
from capture.session import Session
from capture.take import Take
from capture.take_notes import NoteBook, TakeStatus
from capture.verify import verify_take
from tests.capture.rom.stage import (
    FRAMES,
    SETTINGS,
    Rehearsal,
    arm,
    begin,
    quiet,
    short_list,
    take,
    until,
)


def texts(view: View) -> list[str]:
    return [message.text for message in view.messages]


def test_a_session_from_the_first_key_to_the_last_take(tmp_path: Path) -> None:
    stand = Rehearsal(tmp_path / "s")
    with stand.conductor() as conductor:
        view = conductor.view()
        assert (view.stage, view.devices) == (Stage.IDLE, ())
        assert Key.ARM in view.offers
        assert Key.GO not in view.offers
        assert view.headline == "The devices are stopped. Arm them to begin."
        assert conductor.key(Key.GO) == "The array is not armed; arm it first."
        view = arm(conductor)
        assert view.preflight is not None
        assert view.preflight.sentence == "All devices are ready."
        assert view.headline == "Ready. Go records Neutral."
        assert [device.name for device in view.devices] == ["cam00", "cam01"]
        seen = []
        for _ in range(3):
            seen.append(_watch_take(conductor))
        view = until(conductor, lambda view: view.finished and quiet(view))
        assert view.headline == "Every prompt has a good take or is left out. Disarm to end."
        assert "That was the last prompt." in texts(view)
        order = [Cue.NEUTRAL, Cue.HOLD, Cue.RELAX, Cue.NONE]
        for cues in seen:  # a busy machine may miss one: each lasts a few frames only
            assert cues == [cue for cue in order if cue in cues]
        assert [line.status for line in view.prompts] == ["keep"] * 3
        assert {note.note.decided_by for note in view.takes} == {"machine"}
        assert conductor.key(Key.DISARM) == ""
    _check_files(tmp_path / "s")


def _watch_take(conductor) -> list[Cue]:  # type: ignore[no-untyped-def]
    cues: list[Cue] = []
    fractions: list[float] = []

    def counting(view: View) -> None:
        assert (view.cue, view.countdown) == (Cue.READY, 1)

    def over(view: View) -> bool:
        if view.cue not in cues[-1:]:
            cues.append(view.cue)
        if view.stage == Stage.RECORD:
            fractions.append(view.fraction)
            assert 0 <= view.hold_fraction <= 1
        return view.stage == Stage.ARMED

    begin(conductor, seen=counting)
    until(conductor, over)
    assert fractions == sorted(fractions)
    return cues


def _check_files(folder: Path) -> None:
    session = Session.open(folder)
    assert [note.folder.name for note in session.takes()] == [
        "frown_001", "neutral_001", "smile_001",
    ]  # fmt: skip
    for note in session.takes():
        opened = Take.open(note.folder)
        assert opened.manifest.frame_count == FRAMES + SETTINGS.pre_roll + SETTINGS.post_roll
        assert opened.manifest.remarks["shot"]["hold"] == [4, 11]
        assert verify_take(opened).sound
    notes = NoteBook.of_session(folder).all()
    assert {name: note.status for name, note in notes.items()} == {
        "neutral_001": TakeStatus.KEEP, "smile_001": TakeStatus.KEEP, "frown_001": TakeStatus.KEEP,
    }  # fmt: skip
    history = read_events(folder / "events.jsonl")
    assert history.problems == ()
    times = [event.t_mono_ns for event in history.events]
    assert times == sorted(times)
    kinds = Counter(event.kind for event in history.events)
    assert (kinds["opened"], kinds["closed"], kinds["sync"], kinds["decision"]) == (1, 1, 3, 3)
    keys = [event.fields for event in history.events if event.kind == "key"]
    assert [fields["key"] for fields in keys[:3]] == ["go", "arm", "go"]
    assert keys[0]["refusal"] == "The array is not armed; arm it first."
    assert keys[-1]["key"] == "disarm"
    synced = next(event for event in history.events if event.kind == "sync").fields
    assert synced["verdicts"] == {"ok": 2 * 20}
    assert set(synced["clocks"]) == {"cam00", "cam01"}


def test_a_red_take_is_taken_again_and_both_stay(tmp_path: Path) -> None:
    stand = Rehearsal(tmp_path / "s", prompts=short_list("smile", "frown"))
    with stand.conductor() as conductor:
        arm(conductor)
        stand.spoil(FaultKind.INCOMPLETE, triggers=60)
        view = take(conductor)
        assert view.place == 0
        view = until(conductor, quiet)
        assert view.current is not None
        assert view.current.colour == Colour.RED
        assert view.undecided == ("smile_001",)
        assert view.headline == (
            "smile_001 is red. Go takes it again; or overrule it with a reason."
        )
        assert conductor.key(Key.KEEP).startswith("smile_001 is red")
        time.sleep(0.7)  # until the fault is over
        take(conductor)
        view = until(conductor, lambda view: quiet(view) and not view.undecided)
        assert [each.note.status for each in view.takes] == [TakeStatus.RETAKE, TakeStatus.KEEP]
        assert [each.superseded for each in view.takes] == [True, False]
        assert (view.prompts[0].status, view.prompts[0].takes, view.place) == ("keep", 2, 1)
        assert view.disk is not None
        # The operator looks again, and prefers the first one.
        assert conductor.key(Key.OVERRULE, take="smile_001", reason="only the ear") == ""
        view = conductor.view()
        assert view.takes[0].note.overruled is not None
        assert view.takes[0].note.overruled.colour == Colour.RED
    assert len(Session.open(tmp_path / "s").takes()) == 2
    kept = NoteBook.of_session(tmp_path / "s").read("smile_001")
    assert (kept.status, kept.decided_by) == (TakeStatus.KEEP, "operator")
    assert kept.overruled is not None
    assert kept.overruled.reason == "only the ear"


def test_a_session_is_taken_up_where_it_stood(tmp_path: Path) -> None:
    first = Rehearsal(tmp_path / "s", keep_green=False)
    with first.conductor() as conductor:
        arm(conductor)
        take(conductor)
        assert conductor.key(Key.SKIP) == ""
        until(conductor, quiet)
        for end in range(1, 6):
            assert conductor.note("neutral_001", "lovely"[:end]) == ""
            saved = json.loads((tmp_path / "s/notes/neutral_001.json").read_text())
            assert saved["text"] == "lovely"[:end]
        assert conductor.rate("neutral_001", 4) == ""
        assert conductor.rate("neutral_001", 6) == "note: rating must be 0 to 5, found 6"
        assert conductor.note("grin_001", "x") == "There is no take 'grin_001'."
    with Rehearsal(tmp_path / "s").conductor() as conductor:
        view = conductor.view()
        assert (view.stage, view.place, view.prompt.slate) == (Stage.IDLE, 2, "frown")
        assert [line.status for line in view.prompts] == ["undecided", "skipped", "current"]
        [note] = [each.note for each in view.takes]
        assert (note.text, note.rating, note.status) == ("lovel", 4, TakeStatus.UNDECIDED)
        assert texts(view)[0] == "The session goes on at prompt 3, frown."


def test_a_take_that_was_stopped_is_kept_short_and_its_prompt_stays(tmp_path: Path) -> None:
    stand = Rehearsal(tmp_path / "s", prompts=short_list(total_s=20.0))
    with stand.conductor() as conductor:
        arm(conductor)
        begin(conductor)
        until(conductor, lambda view: view.fraction > 0.01)
        assert conductor.key(Key.STOP) == ""
        view = until(conductor, lambda view: view.stage == Stage.ARMED and quiet(view))
        assert view.place == 0
    opened = Take.open(tmp_path / "s/takes/neutral_001")
    assert opened.manifest.frame_count < 1000
    assert verify_take(opened).sound


def test_a_device_that_dies_ends_no_take_and_stops_the_next(tmp_path: Path) -> None:
    stand = Rehearsal(tmp_path / "s", prompts=short_list(total_s=0.5))
    with stand.conductor() as conductor:
        arm(conductor)
        begin(conductor)
        stand.spoil(FaultKind.DEATH, device=1)
        view = until(conductor, lambda view: view.stage == Stage.ARMED and quiet(view))
        assert view.current is not None
        assert view.current.colour == Colour.RED
        until(conductor, lambda view: any(t.startswith("Lost") for t in texts(view)))
        until(conductor, lambda _: conductor.key(Key.GO).startswith("cam01 is lost: wait, or"))
        assert Key.GO not in conductor.view().offers
        stand.live.reconnect("cam01")
        until(conductor, lambda view: any(t.startswith("Back") for t in texts(view)))
        take(conductor)
        view = until(conductor, lambda view: quiet(view) and view.takes[-1].colour is not None)
        assert view.takes[-1].name == "neutral_002"
        assert view.takes[-1].colour == Colour.GREEN


def test_a_red_check_holds_the_array_until_it_is_overruled(tmp_path: Path) -> None:
    red = Finding("focus", "cam01", Colour.RED, "cam01 is out of focus.", "Turn its ring.")
    amber = Finding("exposure", "cam00", Colour.AMBER, "cam00 is a little dark.")
    stand = Rehearsal(tmp_path / "s", findings=[amber, red])
    with stand.conductor() as conductor:
        assert conductor.key(Key.ARM) == ""
        assert "started and checked" in conductor.view().headline
        view = until(conductor, lambda view: view.preflight is not None)
        assert (view.stage, view.findings) == (Stage.PREFLIGHT, (red, amber))
        assert conductor.key(Key.GO).startswith("The preflight was red")
        assert conductor.key(Key.OVERRULE, reason="not needed today") == ""
        assert conductor.view().stage == Stage.ARMED
        take(conductor)
        assert conductor.key(Key.DISARM) == ""
        stand.fails = "the flash did not fire"
        assert conductor.key(Key.ARM) == ""
        view = until(conductor, lambda view: view.preflight is not None)
        assert (view.findings[0].sentence, view.findings[0].colour) == (stand.fails, Colour.RED)


def test_devices_that_do_not_start_leave_the_session_idle(tmp_path: Path) -> None:
    stand = Rehearsal(tmp_path / "s")
    stand.array.close()  # another program has them
    with stand.conductor() as conductor:
        assert conductor.key(Key.ARM) == ""
        view = until(conductor, lambda view: view.preflight is not None)
        assert view.stage == Stage.IDLE
        assert view.preflight is not None
        assert not view.preflight.streaming
        assert view.findings[0].remedy == "Put that right and arm again."
        assert conductor.key(Key.GO) == "The array is not armed; arm it first."


def test_nothing_is_armed_without_room_for_one_take(tmp_path: Path) -> None:
    with Rehearsal(tmp_path / "s", reserve_bytes=1 << 60).conductor() as conductor:
        view = conductor.view()
        assert view.disk is not None
        assert (view.disk.takes_left, view.disk.colour) == (0, "red")
        assert conductor.key(Key.ARM).startswith("The disk has no room for one more take")
        assert Key.ARM not in conductor.view().offers


def test_leaving_while_a_take_is_recorded_keeps_it(tmp_path: Path) -> None:
    stand = Rehearsal(tmp_path / "s", prompts=short_list(total_s=20.0))
    with stand.conductor() as conductor:
        arm(conductor)
        begin(conductor)
        until(conductor, lambda view: view.fraction > 0.01)
    assert verify_take(Take.open(tmp_path / "s/takes/neutral_001")).sound
    with Rehearsal(tmp_path / "s").conductor() as conductor:
        [kept] = conductor.view().takes
        assert kept.phase == TakePhase.DONE


def test_leaving_while_the_array_is_checked_waits_for_no_check_to_end(tmp_path: Path) -> None:
    rehearsal = Rehearsal(tmp_path)
    begun = threading.Event()
    ended: list[str] = []

    def endless(heard: Progress) -> tuple[Finding, ...]:
        begun.set()
        try:
            while True:
                heard(3, 14, "preflight: ptp")
                time.sleep(0.005)
        finally:
            ended.append("by its progress")

    stand = replace(rehearsal.stand(), preflight=endless)
    with Conductor(stand) as conductor:
        assert conductor.key(Key.ARM) == ""
        assert begun.wait(10)
        until(conductor, lambda view: "ptp (3 of 14)" in view.headline)
        assert conductor.key(Key.DISARM) == ""
        assert conductor.key(Key.ARM) == ""  # a check of its own
        until(conductor, lambda view: "ptp (3 of 14)" in view.headline)
    assert ended == ["by its progress"] * 2
