"""`SimulatedSettings`: how a simulated device behaves."""

from __future__ import annotations

from dataclasses import dataclass, field

from capture.devices.faults import Fault
from capture.errors import SettingsError
from capture.frame import Clock


@dataclass(frozen=True, kw_only=True)
class SimulatedSettings:
    """How a simulated device behaves.

    Attributes:
        clock: its own clock.
        latency_ms: from the end of an exposure to the arrival of the frame.
        latency_jitter_ms: standard deviation of that, one-sided.
        id_bits: width of its frame numbers, 8 to 64.
        first_id: the first frame's number.
        wraps_to: the number after the highest: 1 with GigE Vision, 0 with V4L2.
        faults: what goes wrong.
        channels: 1 mono, 3 RGB.
        dtype: "uint8" or "uint16".
        seed: of the latency.
    """

    clock: Clock = field(default_factory=Clock)
    latency_ms: float = 6.0
    latency_jitter_ms: float = 0.5
    id_bits: int = 16
    first_id: int = 1
    wraps_to: int = 1
    faults: tuple[Fault, ...] = ()
    channels: int = 1
    dtype: str = "uint8"
    seed: int = 0

    def __post_init__(self) -> None:
        if not 8 <= self.id_bits <= 64:
            raise SettingsError(f"id_bits must lie in 8..64, found {self.id_bits}")
        if not 1 <= self.first_id < 1 << self.id_bits:
            raise SettingsError(f"first_id must fit {self.id_bits} bits, found {self.first_id}")
        if self.wraps_to not in (0, 1):
            raise SettingsError(f"wraps_to must be 0 or 1, found {self.wraps_to}")
        if not (self.latency_ms >= 0 and self.latency_jitter_ms >= 0):
            raise SettingsError("latency_ms and latency_jitter_ms must be 0 or more")
