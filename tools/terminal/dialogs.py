"""Questions of the console: small windows at the foot of the screen; the rest stays live."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from textual.app import ComposeResult
from textual.binding import Binding
from textual.containers import Vertical, VerticalScroll
from textual.content import Content
from textual.screen import ModalScreen
from textual.widgets import Input, OptionList, Static
from textual.widgets.option_list import Option

from tools.terminal.keys import KEYS


class _Question(ModalScreen[str | None]):
    """A window with a title; escape gives None."""

    AUTO_FOCUS = "Input"
    BINDINGS: ClassVar = [Binding("escape", "leave", "leave")]

    def __init__(self, title: str) -> None:
        super().__init__()
        self.title_text = title

    def action_leave(self) -> None:
        """Answer nothing."""
        self.dismiss(None)


class ReasonQuestion(_Question):
    """Asks for a line of text; enter gives it, unless it is empty."""

    def compose(self) -> ComposeResult:
        """The window."""
        with Vertical(classes="question"):
            yield Static(Content(f"{self.title_text}  (enter: yes, escape: no)"))
            yield Input(placeholder="why?", compact=True)

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Give the text."""
        if event.value.strip():
            self.dismiss(event.value.strip())


class ChoiceQuestion(_Question):
    """Asks for one of several; typing narrows them down, enter gives the chosen key."""

    BINDINGS: ClassVar = [Binding("up", "move(-1)", "up"), Binding("down", "move(1)", "down")]

    def __init__(self, title: str, choices: Sequence[tuple[str, str]]) -> None:
        """Hold the choices.

        Args:
            title: what is asked.
            choices: key and text of each.
        """
        super().__init__(title)
        self._choices = tuple(choices)

    def compose(self) -> ComposeResult:
        """The window."""
        with Vertical(classes="question tall"):
            yield Static(Content(f"{self.title_text}  (type to narrow, enter: go, escape: no)"))
            yield Input(placeholder="part of its name", compact=True)
            yield OptionList(compact=True)

    def on_mount(self) -> None:
        """Show all."""
        self._show("")

    def on_input_changed(self, event: Input.Changed) -> None:
        """Show those that match."""
        self._show(event.value)

    def on_input_submitted(self) -> None:
        """Give the chosen one."""
        self._give()

    def on_option_list_option_selected(self) -> None:
        """Give the one that was clicked."""
        self._give()

    def action_move(self, step: int) -> None:
        """Choose another."""
        options = self.query_one(OptionList)
        if step < 0:
            options.action_cursor_up()
        else:
            options.action_cursor_down()

    def _show(self, part: str) -> None:
        options = self.query_one(OptionList)
        options.clear_options()
        low = part.lower()
        options.add_options(
            [
                Option(Content(f"{key}  {text}"), id=key)
                for key, text in self._choices
                if low in key.lower() or low in text.lower()
            ]
        )
        if options.option_count:
            options.highlighted = 0

    def _give(self) -> None:
        option = self.query_one(OptionList).highlighted_option
        if option is not None:
            self.dismiss(option.id)


class ConfirmQuestion(ModalScreen[bool]):
    """Asks yes or no."""

    BINDINGS: ClassVar = [
        Binding("y", "answer(True)", "yes"),
        Binding("n,escape", "answer(False)", "no"),
    ]

    def __init__(self, title: str) -> None:
        """Hold the question."""
        super().__init__()
        self.title_text = title

    def compose(self) -> ComposeResult:
        """The window."""
        with Vertical(classes="question"):
            yield Static(Content(f"{self.title_text}  (y: yes, n: no)"))

    def action_answer(self, yes: bool) -> None:
        """Give the answer."""
        self.dismiss(yes)


class Sheet(ModalScreen[None]):
    """Text to read; up and down scroll it, most other keys close it."""

    AUTO_FOCUS = "VerticalScroll"
    BINDINGS: ClassVar = [Binding("escape,question_mark,i,q,enter,space", "leave", "leave")]

    def __init__(self, title: str, text: Content) -> None:
        """Hold the text.

        Args:
            title: its first line.
            text: the rest.
        """
        super().__init__()
        self._title, self._text = title, text

    def compose(self) -> ComposeResult:
        """The window."""
        with VerticalScroll(classes="question sheet"):
            yield Static(Content(f"{self._title}  (escape: back)"))
            yield Static(self._text)

    def action_leave(self) -> None:
        """Back to the console."""
        self.dismiss(None)


def key_sheet() -> Sheet:
    """Every key and what it does."""
    lines = [f"{hint.shown:<8} {hint.sentence}" for hint in KEYS]
    return Sheet("Keys", Content("\n".join(lines)))
