"""How takes are recorded, and what a recording was."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from capture.clock_model import ClockModel
from capture.collate import TriggerTrain
from capture.devices.protocol import ClockSample
from capture.errors import SettingsError
from capture.ledger import Ledger
from capture.settings import check_ranges


@dataclass(frozen=True, kw_only=True)
class RecordSettings:
    """How takes are recorded.

    Attributes:
        rate_hz: triggers a second; 1 to 1000.
        exposure_us: exposure time; below the period.
        pre_roll: frames of a take from before its key was pressed, out of the ring; 0 to 10000.
        post_roll: frames of a take after its planned end; 0 to 10000.
        edge_triggers: triggers before and after a take whose frames are not kept, so that its first
            and last frame have neighbours; 0 to 1000.
        retention_ms: how long to wait for frames after the last trigger; 1 to 10000.
        ring_s: memory of each device, in seconds of frames: pre-roll, and frames that the disk has
            not taken yet; 0.1 to 600.
        latches: readings of each device's clock before the first frame; 1 to 1000.
        keep_incomplete: whether images with missing parts are kept on disk, marked.
    """

    rate_hz: float = 75.0
    exposure_us: float = 3000.0
    pre_roll: int = 0
    post_roll: int = 0
    edge_triggers: int = 2
    retention_ms: float = 100.0
    ring_s: float = 4.0
    latches: int = 8
    keep_incomplete: bool = False

    def __post_init__(self) -> None:
        check_ranges(
            "record", self, rate_hz=(1, 1000), exposure_us=(1, 1e6), pre_roll=(0, 10_000),
            post_roll=(0, 10_000), edge_triggers=(0, 1000), retention_ms=(1, 10_000),
            ring_s=(0.1, 600), latches=(1, 1000),
        )  # fmt: skip
        if self.exposure_us >= 1e6 / self.rate_hz:
            raise SettingsError(
                f"record.exposure_us must be below the period of {1e6 / self.rate_hz:.0f} us, "
                f"found {self.exposure_us}"
            )

    @property
    def period_ns(self) -> int:
        """From trigger to trigger."""
        return round(1e9 / self.rate_hz)

    @property
    def ring_frames(self) -> int:
        """Frames of memory of each device; at least the pre-roll and 24 more."""
        return max(round(self.ring_s * self.rate_hz), self.pre_roll + 24)


@dataclass(frozen=True, eq=False)
class Recording:
    """What a recording was.

    Attributes:
        train: its triggers, counted from 0.
        ledger: the verdict of each trigger at each device.
        clocks: by device name, its clock over the take.
        basis: what dates the frames: "ptp" or "host" when all devices share a clock, "model" when
            each device's clock was fitted to the triggers, "free" when devices run free, each with
            a clock of its own.
        readings: by device name, readings of its clock before and during the take.
    """

    train: TriggerTrain
    ledger: Ledger
    clocks: dict[str, ClockModel]
    basis: str = "model"
    readings: Mapping[str, tuple[ClockSample, ...]] = field(default_factory=dict)
