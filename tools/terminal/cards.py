"""What the console shows, made of a `View`: words first, colour beside them, never colour alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

from textual.content import Content

from capture.device_watch import DeviceState
from capture.judgement import Colour
from capture.live_take import TakePhase
from capture.rom.events import Key
from capture.rom.state import Stage
from capture.rom.view import Cue, TakeView, View
from capture.take_notes import TakeStatus
from tools.terminal.keys import KEYS

_STYLES = {Colour.GREEN: "$text-success", Colour.AMBER: "$text-warning", Colour.RED: "$text-error"}
_STAGES = {
    Stage.IDLE: "IDLE",
    Stage.PREFLIGHT: "CHECK",
    Stage.ARMED: "ARMED",
    Stage.COUNTDOWN: "READY",
    Stage.RECORD: "RECORDING",
    Stage.DRAIN: "WRITING",
}
_CUES = {
    Cue.NONE: "",
    Cue.READY: "get ready",
    Cue.NEUTRAL: "go into it",
    Cue.HOLD: "HOLD",
    Cue.RELAX: "back to neutral",
}
_OFFERS = {
    "arm": (Key.ARM,), "go": (Key.GO, Key.STOP, Key.ABORT), "keep": (Key.KEEP,),
    "flag": (Key.FLAG,), "retake": (Key.RETAKE,), "overrule": (Key.OVERRULE,), "next": (Key.NEXT,),
    "previous": (Key.PREVIOUS,), "skip": (Key.SKIP,), "jump": (Key.JUMP,),
    "disarm": (Key.DISARM,),
}  # fmt: skip
_TILE = 19  # letters of a device's tile besides its name
_LONGEST_NAME = 14
_MOST_COLUMNS = 8
_MOST_NAMED = 3  # devices in trouble that each get a line of their own

Part: TypeAlias = str | Content | tuple[str, str]


def top_line(view: View, width: int) -> Content:
    """Session, stage, how many prompts are done, and how long the disk lasts."""
    done = sum(line.status in ("keep", "flag", "skipped") for line in view.prompts)
    parts: list[Part] = [
        (f" {_STAGES[view.stage]} ", f"bold reverse {_stage_style(view.stage)}"),
        (f" {view.session}", "bold"),
        f"   {done}/{len(view.prompts)} prompts done",
    ]
    if view.disk is not None:
        style = _STYLES[Colour(view.disk.colour)]
        parts.append((f"   {view.disk.takes_left} takes left", style))
    if view.preflight is not None:
        parts.append((f"   check {view.preflight.colour}", _STYLES[view.preflight.colour]))
    return Content.assemble(*parts).truncate(width, ellipsis=True)


def prompt_card(view: View) -> Content:
    """What the talent is asked for, and what goes on."""
    prompt = view.prompt
    line = view.prompts[view.place]
    takes = f"{line.takes} take{'s' if line.takes != 1 else ''}" if line.takes else "no take yet"
    following = f"   next: {view.next_prompt.title}" if view.next_prompt is not None else ""
    return Content.assemble(
        f"{view.place + 1}/{len(view.prompts)}  {prompt.slate}  ({takes}){following}\n",
        (f"{prompt.title.upper()}\n", "bold"),
        (f"{prompt.sentence}\n", "bold $text-primary"),
        (view.headline, "dim" if view.stage == Stage.IDLE else ""),
    )


def big_number(view: View) -> str:
    """The countdown; seconds left of the take while it records; else nothing."""
    if view.countdown is not None:
        return str(view.countdown)
    if view.stage == Stage.RECORD:
        return f"{max(view.prompt.total_s * (1 - view.fraction), 0):.1f}"
    return ""


def hold_bar(view: View, width: int) -> Content:
    """The take from neutral through the hold to neutral, filled as far as it has come."""
    prompt = view.prompt
    cue = _CUES[view.cue]
    label = f"{cue:<16}"
    cells = max(width - len(label), 8)
    first = round(cells * prompt.before_s / prompt.total_s)
    last = round(cells * (prompt.before_s + prompt.hold_s) / prompt.total_s)
    filled = round(cells * view.fraction)
    bar = "".join(_cell(at, filled, first <= at < last) for at in range(cells))
    style = "$text-error" if view.cue == Cue.HOLD else "$text-primary"
    return Content.assemble((label, "bold"), (bar, style))


def device_tiles(devices: Sequence[DeviceState], width: int) -> Content:
    """A tile a device: name, colour in words, age, triggers without a good frame, memory in use."""
    if not devices:
        return Content.styled("the devices are stopped", "dim")
    longest = min(max(4, *(len(device.name) for device in devices)), _LONGEST_NAME)
    tile = longest + _TILE
    columns = max(1, min(_MOST_COLUMNS, (width + 2) // (tile + 2)))
    rows = -(-len(devices) // columns)
    columns = -(-len(devices) // rows)
    head = f"{'name':<{longest}} state  age bad mem"
    parts: list[Part] = [("  ".join([head] * columns), "dim")]
    for row in range(rows):
        parts.append("\n")
        for at in range(row, len(devices), rows):
            if at >= rows:
                parts.append("  ")
            parts += _tile(devices[at], longest)
    return Content.assemble(*parts)


def device_troubles(devices: Sequence[DeviceState]) -> list[str]:
    """A sentence for each device that is not green, red ones first; many alike share one."""
    told = []
    for colour in (Colour.RED, Colour.AMBER):
        wrong = [device for device in devices if device.colour == colour]
        if len(wrong) <= _MOST_NAMED:
            told += [f"{device.name} is {colour}: {device.sentence}" for device in wrong]
        else:
            names = ", ".join(device.name for device in wrong[:_MOST_NAMED])
            more = len(wrong) - _MOST_NAMED
            told.append(f"{names} and {more} more are {colour}: {wrong[0].sentence}")
    return told


def take_list(view: View, chosen: str, width: int, height: int) -> Content:
    """The newest takes first, around the chosen one, which says in full why it is not green."""
    takes = list(reversed(view.takes))
    if not takes:
        return Content.styled("no take yet", "dim")
    at = next((n for n, take in enumerate(takes) if take.name == chosen), 0)
    full = []
    if takes[at].name == chosen and takes[at].colour in (Colour.AMBER, Colour.RED):
        full = _take_line(takes[at], ">").wrap(max(width, 1))[:height]
    rows = height - max(len(full) - 1, 0)
    first = max(0, min(at - rows // 2, len(takes) - rows))
    lines: list[Content] = []
    for take in takes[first : first + rows]:
        if full and take.name == chosen:
            lines += full
            continue
        mark = ">" if take.name == chosen else " "
        lines.append(_take_line(take, mark).truncate(width, ellipsis=True))
    return Content("\n").join(lines)


def message_lines(view: View, width: int, height: int) -> Content:
    """Devices in trouble, what the check found, and the news, newest first."""
    parts: list[Part] = [(f"{line}\n", "$text-error") for line in device_troubles(view.devices)]
    if view.stage == Stage.PREFLIGHT:
        parts.append(finding_lines(view))
    for message in list(reversed(view.messages))[:height]:
        mark = {Colour.GREEN: "", Colour.AMBER: "! ", Colour.RED: "!! "}[message.colour]
        style = "" if message.colour == Colour.GREEN else _STYLES[message.colour]
        parts.append((f"{mark}{message.text}\n", style))
    return Content.assemble(*parts)


def finding_lines(view: View) -> Content:
    """What the last check found, the worst first, each with its remedy."""
    if not view.findings:
        return Content("")
    parts: list[Part] = []
    for finding in view.findings:
        parts.append((f"{finding.colour}: ", f"bold {_STYLES[finding.colour]}"))
        parts.append(finding.sentence)
        parts.append(f" -> {finding.remedy}\n" if finding.remedy else "\n")
    return Content.assemble(*parts)


def key_hints(view: View, width: int) -> Content:
    """The key line; what would be refused now is dim."""
    lines: list[list[Content]] = [[]]
    used = 0
    for hint in KEYS:
        keys = _OFFERS.get(hint.action)
        offered = keys is None or any(key in view.offers for key in keys)
        part = Content.assemble(
            (hint.shown, "bold" if offered else "dim"), (f" {hint.word}", "" if offered else "dim")
        )
        if used and used + len(part) > width:
            lines.append([])
            used = 0
        lines[-1].append(part)
        used += len(part) + 2
    return Content("\n").join([Content("  ").join(line) for line in lines])


def _cell(at: int, filled: int, hold: bool) -> str:
    if hold:
        return "█" if at < filled else "░"
    return "━" if at < filled else "─"


def _stage_style(stage: Stage) -> str:
    if stage in (Stage.RECORD, Stage.COUNTDOWN):
        return "$text-error"
    return "$text-success" if stage == Stage.ARMED else "$text-primary"


def _tile(device: DeviceState, longest: int) -> list[Part]:
    age = "-" if device.age_s is None else _age(device.age_s)
    use = f"{min(100 * max(device.taken, 0) // max(device.reserved, 1), 99)}%"
    bad = device.not_ok if device.not_ok < 1000 else f"{device.not_ok // 1000}k"
    word = str(device.colour) if device.colour != Colour.RED else "RED"
    return [
        f"{device.name[:longest]:<{longest}} ",
        (f"{word:<5}", f"bold {_STYLES[device.colour]}"),
        f"{age:>5}{bad:>4}{use:>4}",
    ]


def _age(age_s: float) -> str:
    """In tenths of a second: the age of a device that is well then reads 0.0 s and stays so."""
    return f"{age_s:.1f}s" if age_s < 9.95 else f"{min(age_s, 999):.0f}s"


def _take_line(take: TakeView, mark: str) -> Content:
    note = take.note
    if take.phase in (TakePhase.DONE, TakePhase.FAILED):
        progress = ""
    else:
        progress = f" {take.phase} {100 * take.fraction:.0f}%"
    colour = "" if take.colour is None else str(take.colour)
    word = colour.upper() if take.colour == Colour.RED else colour
    status = "" if note.status == TakeStatus.UNDECIDED else str(note.status)
    stars = "*" * note.rating
    old = " (old)" if take.superseded else ""
    text = f'  "{note.text}"' if note.text else ""
    style = _STYLES[take.colour] if take.colour is not None else ""
    return Content.assemble(
        f"{mark}{take.name} ", (f"{word} ", style), (f"{status} ", "bold"), f"{stars}{old}",
        progress, f" {take.sentence}", text,
    )  # fmt: skip
