"""The page: sections, verdicts, a table of contents, one file that needs nothing else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from capture.product import code_version, replacing
from tools.report.svg import element, escape, number

_LONG = 6  # a longer list of numbers is summed up
_SCRIPT = """
for (const wipe of document.querySelectorAll('.wipe')) {
  const slide = wipe.querySelector('input');
  const move = () => wipe.style.setProperty('--cut', slide.value + '%');
  slide.addEventListener('input', move); move();
}
"""


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """One judgement in words: `level` is "good", "warn", "bad" or "none"."""

    level: str
    subject: str
    words: str


@dataclass(frozen=True, kw_only=True)
class Section:
    """One part of the page.

    Attributes:
        anchor: its place in the address.
        title: heading and entry in the contents.
        body: HTML.
        verdicts: what it lets one conclude, repeated at the top of the page.
    """

    anchor: str
    title: str
    body: str
    verdicts: tuple[Verdict, ...] = ()


def write_page(
    title: str, lead: str, sections: Sequence[Section], out: Path, *, summary: str = ""
) -> None:
    """Write the sections as one self-contained HTML page, whole or not at all.

    Args:
        title: plain text.
        lead: HTML under the title, above the verdicts.
        sections: in order.
        out: the file.
        summary: HTML instead of the list of all verdicts; empty keeps the list.
    """
    css = resources.files("tools.report").joinpath("page.css").read_text(encoding="utf-8")
    verdicts = [verdict for section in sections for verdict in section.verdicts]
    contents = "".join(
        f'<a href="#{escape(section.anchor)}">{_dot(section)}{escape(section.title)}</a>'
        for section in sections
    )
    body = "".join(
        f'<section id="{escape(section.anchor)}"><h2>{escape(section.title)}</h2>'
        f"{''.join(verdict_line(v) for v in section.verdicts)}{section.body}</section>"
        for section in sections
    )
    page = (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{css}</style></head><body>"
        f"<nav><strong>{escape(title)}</strong>{contents}</nav><main>"
        f"<header><h1>{escape(title)}</h1>{lead}{summary or _summary(verdicts)}</header>{body}"
        f"<footer>likeness {escape(code_version())}</footer></main>"
        f"<script>{_SCRIPT}</script></body></html>\n"
    )
    with replacing(out) as partial:
        partial.write_text(page, encoding="utf-8")


def verdict_line(verdict: Verdict) -> str:
    """A verdict as a coloured line of words."""
    mark = {"good": "✓", "warn": "!", "bad": "✗"}.get(verdict.level, "·")
    return (
        f'<p class="verdict {escape(verdict.level)}"><b>{mark} {escape(verdict.subject)}</b> '
        f"{escape(verdict.words)}</p>"
    )


def figure(content: str, caption: str) -> str:
    """A picture or chart with a caption of plain text."""
    return f"<figure>{content}<figcaption>{escape(caption)}</figcaption></figure>"


def gallery(figures: Sequence[str], kind: str = "") -> str:
    """Figures side by side, as many as fit."""
    return f'<div class="gallery {kind}">{"".join(figures)}</div>' if figures else ""


def wipe(under: str, over: str, words: str) -> str:
    """Two pictures of one size on top of each other, with a slider that wipes between them."""
    slider = element("input", type="range", min=0, max=100, value=50, aria_label=f"wipe: {words}")
    return f'<div class="wipe">{under}<div class="over">{over}</div>{slider}</div>'


def table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A table; numbers are right-aligned and shortened."""
    top = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    body = "".join(f"<tr>{''.join(_cell(cell) for cell in row)}</tr>" for row in rows)
    return f'<div class="scroll"><table><tr>{top}</tr>{body}</table></div>'


def facts(values: Mapping[str, object]) -> str:
    """Names and values as a compact list."""
    items = "".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(_shown(value))}</dd></div>"
        for name, value in values.items()
    )
    return f'<dl class="facts">{items}</dl>'


def folded(title: str, content: str) -> str:
    """Content behind a line that opens it."""
    return f"<details><summary>{escape(title)}</summary>{content}</details>"


def flattened(document: Mapping[str, Any], prefix: str = "") -> dict[str, object]:
    """Every number and word of a nested report by its path; long lists of numbers summed up."""
    out: dict[str, object] = {}
    for key, value in document.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            out |= flattened(value, f"{name}.")
        elif isinstance(value, (list, tuple)):
            out[name] = _listed(value)
        else:
            out[name] = value
    return out


def _listed(values: Sequence[Any]) -> str:
    numbers = [v for v in values if isinstance(v, (int, float)) and not isinstance(v, bool)]
    if len(numbers) == len(values) and len(values) > _LONG:
        mean = sum(numbers) / len(numbers)
        return (
            f"{len(numbers)} values, {number(min(numbers))} to {number(max(numbers))}, "
            f"mean {number(mean)}"
        )
    if len(values) > _LONG or any(isinstance(v, (Mapping, list)) for v in values):
        return f"{len(values)} entries"
    return ", ".join(_shown(value) for value in values)


def _summary(verdicts: Sequence[Verdict]) -> str:
    if not verdicts:
        return ""
    worst = next(
        (k for k in ("bad", "warn", "good") if any(v.level == k for v in verdicts)), "none"
    )
    words = {
        "good": "Good: nothing here asks for a retake.",
        "warn": "Usable, with remarks: read the amber lines.",
        "bad": "Not good: read the red lines first.",
        "none": "Nothing to judge yet.",
    }[worst]
    lines = "".join(verdict_line(verdict) for verdict in verdicts)
    return f'<div class="summary {worst}"><p class="headline">{words}</p>{lines}</div>'


def _dot(section: Section) -> str:
    for level in ("bad", "warn", "good"):
        if any(verdict.level == level for verdict in section.verdicts):
            return f'<i class="dot {level}"></i>'
    return '<i class="dot none"></i>'


def _cell(value: object) -> str:
    plain = isinstance(value, (int, float)) and not isinstance(value, bool)
    return f"<td{' class=num' if plain else ''}>{escape(_shown(value))}</td>"


def _shown(value: object) -> str:
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "none"}[value]
    if isinstance(value, float):
        return number(value)
    return str(value)
