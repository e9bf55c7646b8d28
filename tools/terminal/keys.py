"""The keys of the console: one table for its key line, its help and its actions."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class KeyHint:
    """A key and what it does.

    Attributes:
        keys: as Textual calls them.
        shown: as the operator reads them.
        action: the console's action.
        word: in the key line.
        sentence: in the help.
    """

    keys: str
    shown: str
    action: str
    word: str
    sentence: str


KEYS = (
    KeyHint("a", "a", "arm", "arm", "Start the devices and check them; again: check again."),
    KeyHint("space", "space", "go", "go", "Record the prompt; again: stop, and keep it."),
    KeyHint("k", "k", "keep", "keep", "The take is good."),
    KeyHint("f", "f", "flag", "flag", "Keep it, and somebody must look at it."),
    KeyHint("r", "r", "retake", "retake", "Record it again; this one is kept beside it."),
    KeyHint("o", "o", "overrule", "overrule", "Keep a red take, or arm a red array; asks why."),
    KeyHint("n", "n", "next", "next", "To the next prompt."),
    KeyHint("p", "p", "previous", "prev", "To the prompt before."),
    KeyHint("s", "s", "skip", "skip", "Leave this prompt out; it can be recorded later."),
    KeyHint("g", "g", "jump", "go to", "Go to a prompt by its name."),
    KeyHint("0,1,2,3,4,5", "0-5", "rate", "rate", "Rate the take; 0 takes the rating away."),
    KeyHint("t", "t", "note", "note", "Write a note to the take; saved at every letter."),
    KeyHint("down,up", "↓", "choose", "older", "Mean an older take by k f r o t 0-5; up: a newer."),
    KeyHint("c", "c", "reconnect", "find", "Look for a lost device again."),
    KeyHint("i", "i", "findings", "check", "What the last check found, and what to do about it."),
    KeyHint("d", "d", "disarm", "disarm", "Stop the devices."),
    KeyHint("question_mark", "?", "help", "help", "This list."),
    KeyHint("q", "q", "leave", "quit", "Stop the devices and leave; asks while it records."),
)
