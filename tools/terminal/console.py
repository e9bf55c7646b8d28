"""The operator's console: draws the conductor's view twenty times a second, and passes keys on."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import ClassVar

from textual.app import App, ComposeResult
from textual.binding import Binding
from textual.containers import Horizontal
from textual.content import Content
from textual.widgets import Digits, Input, Static

from capture.errors import LikenessError
from capture.judgement import Colour
from capture.live_take import TakePhase
from capture.rom.conductor import Conductor
from capture.rom.events import Key
from capture.rom.state import Stage
from capture.rom.view import TakeView, View
from tools.terminal import cards
from tools.terminal.dialogs import ChoiceQuestion, ConfirmQuestion, ReasonQuestion, Sheet, key_sheet
from tools.terminal.keys import KEYS

_TICK_S = 0.05
_TOLD_S = 15.0  # how long a line of the console's own stays
_WITH_KEY = ("rate", "choose")  # actions that are told which key it was
_COMMANDS = frozenset(hint.action for hint in KEYS)
_CSS = """
Screen { layout: vertical; }
#top { height: 1; background: $panel; }
#card { height: 6; padding: 0 1; }
#card.roomy { height: 9; padding: 1 2; }
#prompt { width: 1fr; }
#number { width: 14; text-align: right; color: $text-error; }
#bar { height: 1; padding: 0 1; }
#devices { height: auto; padding: 0 1; }
#bottom { height: 1fr; }
#takes { width: 3fr; height: 100%; padding: 0 1; }
#messages { width: 2fr; height: 100%; padding: 0 1; border-left: solid $panel; }
#bottom.checking #takes { display: none; }
#note-line { height: 1; padding: 0 1; background: $surface; }
#noted { width: auto; }
#note { width: 1fr; }
#keys { height: auto; background: $panel; padding: 0 1; }
ReasonQuestion, ChoiceQuestion, ConfirmQuestion, Sheet { align: center bottom; background: $background 0%; }
.question { height: auto; max-height: 90%; background: $surface; border: solid $primary; padding: 0 1; }
.question.tall { height: 16; }
.question.sheet { max-height: 100%; }
.question.sheet Static { height: auto; }
.question OptionList { height: 1fr; }
"""  # noqa: E501


class _Pane(Static):
    """Text that is drawn anew only when it has changed."""

    _last: tuple[object, ...] = ()

    def show(self, content: Content) -> None:
        """Show it."""
        now = (content.plain, tuple(content.spans))
        if now != self._last:
            self._last = now
            self.update(content)


def _bindings() -> Iterator[Binding]:
    for hint in KEYS:
        for key in hint.keys.split(","):
            call = f"{hint.action}('{key}')" if hint.action in _WITH_KEY else hint.action
            yield Binding(key, call, hint.word, priority=True)
    yield Binding("escape", "close_note", "back", priority=True)
    yield Binding("ctrl+q,ctrl+c", "leave_anyway", "quit", priority=True)


class Console(App[None]):
    """The console of one session; the state of the session is the conductor's."""

    CSS = _CSS
    BINDINGS: ClassVar = list(_bindings())
    ENABLE_COMMAND_PALETTE = False
    AUTO_FOCUS = None  # keys are commands until a field is opened

    def __init__(
        self,
        conductor: Conductor,
        devices: Sequence[str],
        *,
        remarks: Sequence[str] = (),
    ) -> None:
        """Hold a conductor that was entered already.

        Args:
            conductor: drives the session.
            devices: names of all devices of the array.
            remarks: what the operator should know; read again and again, it may grow.
        """
        super().__init__()
        self.animation_level = "none"
        self._conductor, self._devices = conductor, tuple(devices)
        self._view: View = conductor.view()
        self._chosen = ""  # the name of a take; empty: the latest
        self._noted = ""  # the take whose note is being written
        self._remarks, self._read = remarks, 0
        self._told: list[tuple[float, str]] = []
        self._panes = {
            name: _Pane(id=name)
            for name in ("top", "prompt", "bar", "devices", "takes", "messages", "noted", "keys")
        }
        self._number = Digits("", id="number")
        self._card = Horizontal(self._panes["prompt"], self._number, id="card")
        self._bottom = Horizontal(self._panes["takes"], self._panes["messages"], id="bottom")
        self._note = Input(id="note", compact=True, disabled=True)
        self._note_line = Horizontal(self._panes["noted"], self._note, id="note-line")
        self._note_line.display = False

    def compose(self) -> ComposeResult:
        """The panes, from the top."""
        yield self._panes["top"]
        yield self._card
        yield self._panes["bar"]
        yield self._panes["devices"]
        yield self._bottom
        yield self._note_line
        yield self._panes["keys"]

    def on_mount(self) -> None:
        """Begin to tick."""
        self.set_interval(_TICK_S, self._tick)
        self.call_after_refresh(self._tick)

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Keys are commands at once, in the order they come, unless a text is being written.

        That is why they are priority bindings: others take effect some messages later, and what
        is typed after `t` could be taken for commands.
        """
        asked = len(self.screen_stack) > 1
        if action == "close_note":
            return not asked
        return action not in _COMMANDS or not (asked or self._note_line.display)

    def action_arm(self) -> None:
        """Start the devices and check them."""
        self._key(Key.ARM)

    def action_disarm(self) -> None:
        """Stop the devices."""
        self._key(Key.DISARM)

    def action_go(self) -> None:
        """Count down and record; during the countdown end it, while recording close the take."""
        stage = self._view.stage
        if stage == Stage.COUNTDOWN:
            self._key(Key.ABORT)
        else:
            self._key(Key.STOP if stage == Stage.RECORD else Key.GO)

    def action_keep(self) -> None:
        """The chosen take is good."""
        self._key(Key.KEEP, take=self._marked())

    def action_flag(self) -> None:
        """The chosen take is kept for somebody to look at."""
        self._key(Key.FLAG, take=self._marked())

    def action_retake(self) -> None:
        """The chosen take is recorded again."""
        self._key(Key.RETAKE, take=self._marked())

    def action_overrule(self) -> None:
        """Ask why the verdict shall not count."""
        of_check = self._view.stage == Stage.PREFLIGHT and not self._chosen
        take = self._take()
        if not of_check and take is None:
            self._tell("nothing to overrule: no take yet")
            return
        name = "" if of_check or take is None else take.name
        if name and take is not None and take.colour == Colour.GREEN:
            self._key(Key.OVERRULE, take=name)  # is refused: nobody is asked for a reason in vain
            return

        def answered(reason: str | None) -> None:
            if reason is not None:
                self._key(Key.OVERRULE, take=name, reason=reason)

        what = f"Keep {name} against its verdict" if name else "Arm against the check"
        self.push_screen(ReasonQuestion(f"{what}: why?"), answered)

    def action_next(self) -> None:
        """To the next prompt."""
        self._key(Key.NEXT)

    def action_previous(self) -> None:
        """To the prompt before."""
        self._key(Key.PREVIOUS)

    def action_skip(self) -> None:
        """Leave the prompt out."""
        self._key(Key.SKIP)

    def action_jump(self) -> None:
        """Ask for a prompt."""
        choices = [
            (line.prompt.slate, f"{line.prompt.title}  {line.status}".rstrip())
            for line in self._view.prompts
        ]

        def answered(slate: str | None) -> None:
            if slate is not None:
                self._key(Key.JUMP, slate=slate)

        self.push_screen(ChoiceQuestion("Go to which prompt?", choices), answered)

    def action_rate(self, key: str) -> None:
        """Rate the chosen take."""
        take = self._take()
        if take is None:
            self._tell("nothing to rate: no take yet")
        else:
            self._do(lambda: self._conductor.rate(take.name, int(key)))

    def action_choose(self, key: str) -> None:
        """Choose an older or a newer take; below the newest, the latest is meant again."""
        names = [take.name for take in self._view.takes]
        if not names:
            return
        at = names.index(self._chosen) if self._chosen in names else len(names) - 1
        at += -1 if key == "down" else 1  # the newest stands on top
        at = min(max(at, 0), len(names) - 1)
        self._chosen = "" if at == len(names) - 1 else names[at]
        self._tick()

    def action_note(self) -> None:
        """Open the note of the chosen take."""
        take = self._take()
        if take is None:
            self._tell("nothing to write a note to: no take yet")
            return
        self._noted = take.name
        with self.prevent(Input.Changed):
            self._note.value = take.note.text
        self._note.cursor_position = len(take.note.text)
        label = f"note to {take.name} (saved as you type, escape: back) "
        self._panes["noted"].show(Content(label))
        self._note.disabled = False
        self._note_line.display = True
        self.screen.set_focus(self._note)  # at once; `focus` waits, and letters would be lost

    def on_input_changed(self, event: Input.Changed) -> None:
        """Save the note at every letter."""
        if event.input is self._note:
            self._do(lambda: self._conductor.note(self._noted, event.value))

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Close the note."""
        if event.input is self._note:
            self.action_close_note()

    def action_close_note(self) -> None:
        """Back to the keys; then back to the latest take."""
        if not self._note_line.display:
            self._chosen = ""
        self._note_line.display = False
        self._note.disabled = True
        self.screen.set_focus(None)

    def action_reconnect(self) -> None:
        """Ask which device to look for again."""
        told = {d.name: f"{d.colour} {d.sentence}".rstrip() for d in self._view.devices}
        names = sorted(self._devices, key=lambda name: told.get(name) == "green")
        choices = [(name, told.get(name, "stopped")) for name in names]

        def answered(name: str | None) -> None:
            if name is not None:
                self._do(lambda: self._conductor.reconnect(name))

        self.push_screen(ChoiceQuestion("Look for which device again?", choices), answered)

    def action_findings(self) -> None:
        """Show what the last check found."""
        self.push_screen(Sheet("The last check", cards.finding_lines(self._view)))

    def action_help(self) -> None:
        """Show every key."""
        self.push_screen(key_sheet())

    def action_leave(self) -> None:
        """Leave; while something is recorded or written, ask."""
        busy = self._view.stage in (Stage.COUNTDOWN, Stage.RECORD, Stage.DRAIN)
        writing = any(
            take.phase in (TakePhase.RECORDING, TakePhase.DRAINING) for take in self._view.takes
        )
        if not busy and not writing:
            self.exit()
            return
        if isinstance(self.screen, ConfirmQuestion):
            return
        self.push_screen(
            ConfirmQuestion("A take is being recorded. Stop it, keep what there is, and leave?"),
            lambda yes: self.exit() if yes else None,
        )

    def action_leave_anyway(self) -> None:
        """Leave, whatever is being written or asked."""
        self.action_leave()

    def _take(self) -> TakeView | None:
        """The chosen take; else the one being recorded, else the latest."""
        named = next((take for take in self._view.takes if take.name == self._chosen), None)
        return named if named is not None else self._view.current

    def _marked(self) -> str:
        """The name of that take; "" before the first."""
        take = self._take()
        return "" if take is None else take.name

    def _key(self, key: Key, *, slate: str = "", take: str = "", reason: str = "") -> None:
        self._do(lambda: self._conductor.key(key, slate=slate, take=take, reason=reason))

    def _do(self, work: Callable[[], str]) -> None:
        """Do something; a refusal or an error is shown, and ends nothing."""
        try:
            refusal = work()
        except (LikenessError, OSError) as error:
            refusal = str(error)
        if refusal:
            self._tell(refusal)
        self._tick()

    def _tell(self, sentence: str) -> None:
        self._told = [*self._told[-2:], (self._view.at_s, sentence)]

    def _tick(self) -> None:
        while self._read < len(self._remarks):
            self._tell(self._remarks[self._read])
            self._read += 1
        try:
            self._conductor.tick()
            self._view = self._conductor.view()
        except (LikenessError, OSError) as error:
            if not self._told or self._told[-1][1] != str(error):
                self._tell(str(error))
        self._draw(self._view)

    def _draw(self, view: View) -> None:
        width, height = self.size
        self._card.set_class(height >= 34, "roomy")
        self._bottom.set_class(view.stage == Stage.PREFLIGHT, "checking")
        panes = self._panes
        panes["top"].show(cards.top_line(view, width))
        panes["prompt"].show(cards.prompt_card(view))
        panes["bar"].show(cards.hold_bar(view, width - 2))
        panes["devices"].show(cards.device_tiles(view.devices, width - 2))
        panes["keys"].show(cards.key_hints(view, width - 2))
        takes, messages = panes["takes"].content_size, panes["messages"].content_size
        if takes.height:
            panes["takes"].show(cards.take_list(view, self._marked(), takes.width, takes.height))
        told = [text for at_s, text in self._told if view.at_s - at_s < _TOLD_S]
        lines = cards.message_lines(view, messages.width, max(messages.height, 1))
        own = [(f"! {text}\n", "$text-warning") for text in reversed(told)]
        panes["messages"].show(Content.assemble(*own, lines))
        number = cards.big_number(view)
        if self._number.value != number:
            self._number.update(number)
