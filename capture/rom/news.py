"""Takes that are being recorded, written or read back, and what there is to tell of them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from capture.live_take import TakePhase
from capture.rom.contract import RunningTake
from capture.rom.events import Event, TakeChecked, TakeFailed, TakeJudged, TakeWritten

_ORDER = (TakePhase.RECORDING, TakePhase.DRAINING, TakePhase.CHECKING, TakePhase.DONE)


class TakeWatch:
    """Tells each step of each take once, in order, however many were made between two looks."""

    def __init__(self) -> None:
        self._takes: dict[str, RunningTake] = {}
        self._told: dict[str, TakePhase] = {}  # the phase that was told last
        self._finished: list[RunningTake] = []

    def add(self, take: RunningTake) -> None:
        """Watch a take that has just begun."""
        self._takes[take.folder.name] = take
        self._told[take.folder.name] = TakePhase.RECORDING

    def stop(self, name: str) -> None:
        """Close the window of a take; nothing happens when it is not watched."""
        if name in self._takes:
            self._takes[name].stop()

    def wait(self) -> None:
        """Wait until nothing is being recorded, written or read back."""
        for take in self._takes.values():
            take.wait()

    def news(self, at_s: float) -> Iterator[Event]:
        """What has happened since the last call.

        Args:
            at_s: the time that the events bear.
        """
        for name, take in list(self._takes.items()):
            yield from self._news_of(name, take, at_s)

    def finished(self) -> tuple[RunningTake, ...]:
        """Takes that are whole on disk, each told once."""
        done, self._finished = tuple(self._finished), []
        return done

    def fractions(self) -> dict[str, float]:
        """By name, how far each take is in its phase."""
        return {name: take.fraction for name, take in self._takes.items()}

    def sync(self, name: str) -> dict[str, Any]:
        """What is known of the clocks in a take, for the log."""
        take = self._takes.get(name)
        if take is None or take.recording is None or take.judgement is None:
            return {}
        return {
            "spread_ns": take.judgement.spread_ns,
            "verdicts": {str(v): n for v, n in take.recording.ledger.counts().items() if n},
            "clocks": {
                device: {
                    "drift_ppm": model.drift_ppm,
                    "jitter_ns": model.jitter_ns,
                }
                for device, model in take.recording.clocks.items()
            },
        }

    def _news_of(self, name: str, take: RunningTake, at_s: float) -> Iterator[Event]:
        phase, judgement = take.phase, take.judgement  # the phase first: it is set after the rest
        reached = phase if phase in _ORDER else self._told[name]
        told = _ORDER.index(self._told[name])
        for step in _ORDER[told + 1 : _ORDER.index(reached) + 1]:
            self._told[name] = step
            if step == TakePhase.DONE:
                problems = ("It was not read back.",) if take.check is None else take.check.problems
                yield TakeChecked(at_s=at_s, take=name, problems=problems)
                self._finished.append(take)
                del self._takes[name]
            elif judgement is not None:
                colour, sentence = judgement.colour, judgement.sentence
                kind = TakeJudged if step == TakePhase.DRAINING else TakeWritten
                yield kind(at_s=at_s, take=name, colour=colour, sentence=sentence)
        if phase == TakePhase.FAILED:
            yield TakeFailed(at_s=at_s, take=name, error=take.error)
            del self._takes[name]
