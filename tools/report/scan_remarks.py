"""What scans warn of: frame after frame says the same, so like warnings are gathered into one."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tools.report.page import Verdict, table
from tools.report.svg import element, escape

_ROWS = 12  # remarks in a report; the page of the scans has all


@dataclass(frozen=True, kw_only=True)
class Remark:
    """One warning of one or more frames.

    Attributes:
        words: as the first of the frames says it; the others may have other numbers in it.
        frames: that say so, in order.
    """

    words: str
    frames: tuple[int, ...]


def warnings_told(report: Mapping[str, Any]) -> list[str]:
    """The warnings in a scan's report; none when the scan is older than they are."""
    return [str(words) for words in report.get("warnings", [])]


def gathered(warnings: Mapping[int, Sequence[str]]) -> list[Remark]:
    """Warnings of all frames; those of one device alike but for their numbers are one remark.

    Args:
        warnings: by frame, in order.

    Returns:
        Those of the most frames first.
    """
    alike: dict[str, list[tuple[int, str]]] = {}
    for frame, sentences in warnings.items():
        for words in sentences:
            device, _, sentence = words.partition(": ")
            key = f"{device}: {re.sub(r'[0-9.]+', '#', sentence)}"
            alike.setdefault(key, []).append((frame, words))
    order = sorted(alike.values(), key=len, reverse=True)
    return [Remark(words=said[0][1], frames=tuple(frame for frame, _ in said)) for said in order]


def remarks_table(warnings: Mapping[int, Sequence[str]], page: str) -> str:
    """The remarks on the scans of a take, the frame with the most of them, and where to read on.

    Args:
        warnings: by frame, in order.
        page: address of the page of the scans; empty when there is none.

    Returns:
        HTML; empty when there are no warnings.
    """
    remarks = gathered(warnings)
    if not remarks:
        return ""
    rows = [(remark.words, len(remark.frames), remark.frames[0]) for remark in remarks[:_ROWS]]
    worst = _worst(warnings)
    words = f"Most in frame {worst}: {len(warnings[worst])}. "
    if len(remarks) > _ROWS:
        words += f"{len(remarks) - _ROWS} more kinds are not listed. "
    link = element("a", "every scan in pictures and numbers", href=page) if page else ""
    head = ("the scans warn", "frames", "first in frame")
    return f"{table(head, rows)}<p>{escape(words)}{link}</p>"


def remarks_verdict(take: str, warnings: Mapping[int, Sequence[str]]) -> list[Verdict]:
    """How many warnings of how many kinds, in one line; nothing when there are none."""
    remarks = gathered(warnings)
    if not remarks:
        return []
    told = sum(1 for sentences in warnings.values() if sentences)
    kinds = "one warning" if len(remarks) == 1 else f"{len(remarks)} kinds of warnings"
    words = (
        f"{kinds} in {told} of {len(warnings)} frames, most in frame {_worst(warnings)}; "
        f"first of all: {remarks[0].words}"
    )
    return [Verdict(level="warn", subject=f"Scans of {take}:", words=words)]


def _worst(warnings: Mapping[int, Sequence[str]]) -> int:
    return max(warnings, key=lambda frame: len(warnings[frame]))
