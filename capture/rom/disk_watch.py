"""How long the disk lasts for this session: what takes have cost so far, and what is to come."""

from __future__ import annotations

from capture.disk import DiskForecast, DiskUse, folder_bytes, forecast, free_bytes
from capture.recorder import RecordSettings
from capture.rom.contract import RunningTake
from capture.rom.machine import Machine
from capture.rom.shot_list import Prompt
from capture.rom.state import RomState
from capture.session import Session
from capture.take import Take


class DiskWatch:
    """Keeps what was observed, and makes forecasts of it."""

    def __init__(self, session: Session, settings: RecordSettings, frame_set_bytes: int) -> None:
        """Hold a session.

        Args:
            session: whose disk it is.
            settings: rate, pre-roll and post-roll.
            frame_set_bytes: of the frames of all devices at one trigger.
        """
        self._session, self._settings = session, settings
        self._frame_set_bytes = frame_set_bytes
        self._observed: dict[str, tuple[int, int]] = {}
        self._retakes = 0
        self.forecast: DiskForecast | None = None

    def take_up(self) -> None:
        """Observe the takes that stand on the disk already."""
        for note in self._session.takes(damaged=[]):  # what is wrong with one is told elsewhere
            triggers = Take.open(note.folder).manifest.frame_count
            self._observed[note.folder.name] = (triggers, folder_bytes(note.folder))
            self._retakes += note.take_number > 1

    def observe(self, take: RunningTake) -> None:
        """Observe a take that has been written."""
        if take.recording is not None and take.folder.name not in self._observed:
            size = (take.recording.ledger.triggers, folder_bytes(take.folder))
            self._observed[take.folder.name] = size
            self._retakes += take.number > 1

    def look(self, machine: Machine, state: RomState, *, reserve_bytes: int) -> DiskForecast:
        """Look at the disk.

        Args:
            machine: knows the prompts.
            state: of the session.
            reserve_bytes: what must stay free.

        Raises:
            WorkError: when the free space cannot be told.
        """
        coming = [
            prompt
            for prompt in machine.prompts.prompts
            if prompt.slate not in state.done | state.skipped
        ]
        self.forecast = forecast(
            DiskUse(
                free_bytes=free_bytes(self._session.folder),
                frame_set_bytes=self._frame_set_bytes,
                next_triggers=self._triggers(machine.prompt(state)),
                coming_triggers=[self._triggers(prompt) for prompt in coming],
                observed=list(self._observed.values()),
                retakes=self._retakes,
                pending_bytes=self._pending_bytes(machine, state),
                reserve_bytes=reserve_bytes,
            )
        )
        return self.forecast

    def _triggers(self, prompt: Prompt) -> int:
        settings = self._settings
        return prompt.shot(settings).frames + settings.pre_roll + settings.post_roll

    def _pending_bytes(self, machine: Machine, state: RomState) -> int:
        """What the take that is being recorded may still need: all of it, to be safe."""
        if not state.current:
            return 0
        return self._triggers(machine.prompt(state)) * self._frame_set_bytes
