"""What every verb understands, and how text on the command line becomes values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from capture.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options that every verb has."""

    json: bool = False
    """Print the final report as one JSON object on stdout."""
    config: Path | None = None
    """A TOML file of settings, tables named after stages; options given here win over it."""


def parse_frames(text: str | None, frames: tuple[int, ...]) -> list[int]:
    """Choose frames of a take from text: `A:B` (B excluded), `A:B:STEP`, `A` or `A,B,C`.

    Args:
        text: as typed; None chooses every frame.
        frames: the frame numbers of the take.

    Raises:
        InputError: when the text is none of these, or names a frame that the take does not have.
    """
    if text is None:
        return list(frames)
    offer = f"the take has {frames[0]}..{frames[-1]}" if frames else "the take has no frames"
    try:
        if ":" in text:
            parts = [int(part) if part.strip() else None for part in text.split(":")]
            if len(parts) > 3:
                raise ValueError(text)
            first = frames[0] if parts[0] is None else parts[0]
            last = frames[-1] + 1 if parts[1] is None else parts[1]
            step = parts[2] if len(parts) == 3 and parts[2] is not None else 1
            wanted: Sequence[int] = range(first, last, step)
        else:
            wanted = [int(part) for part in text.split(",")]
    except (ValueError, IndexError) as error:
        raise InputError(
            f"--frames {text}: expected A:B (B excluded), A:B:STEP, A, or A,B,C; {offer}"
        ) from error
    there = set(frames)
    # Lazily: a range typed with too many digits has no list that fits in memory.
    missing = next((frame for frame in wanted if frame not in there), None)
    if missing is not None or not wanted:
        what = "it chooses no frame" if missing is None else f"no frame {missing}"
        raise InputError(f"--frames {text}: {what}; {offer}")
    return list(wanted)
