"""What a device of our own is when it is switched on."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass

MASTER_EPOCH_NS = 1_700_000_000_000_000_000  # the master clock shows this much more than the host's


@dataclass(frozen=True, kw_only=True)
class Setup:
    """What a device is; a reboot comes back to this.

    Attributes:
        address: of its only interface, within 127.0.0.0/8.
        serial: serial number, at most 15 letters.
        model: model name.
        width: of the sensor, pixels.
        height: of the sensor, pixels.
        first_id: number of the first frame after every start of acquisition.
        clock_start_ns: what its clock shows when it is switched on.
        drift_ppm: how much too fast its clock runs while it follows no master.
        ptp_settle_s: how long it listens before it follows the master.
        ptp_offset_ns: how far it is off while it follows.
        grandmaster: identity of the clock it follows, 64 bits.
        link_mbps: what it says of its link.
        path_mtu: larger test packets are lost on the way.
        readout_us: after an exposure, before the next trigger is answered.
        temperature_c: what it says of itself.
        packed: whether it offers no format but one that packs pixels.
    """

    address: str
    serial: str = "OWN-1"
    model: str = "OwnDevice"
    width: int = 128
    height: int = 96
    first_id: int = 1
    clock_start_ns: int = 5_000_000_000
    drift_ppm: float = 0.0
    ptp_settle_s: float = 0.2
    ptp_offset_ns: int = 0
    grandmaster: int = 0x001122FFFE334455
    link_mbps: int = 1000
    path_mtu: int = 9000
    readout_us: float = 0.0
    temperature_c: float = 41.5
    packed: bool = False

    def to_json(self) -> str:
        """As one line."""
        return json.dumps(dataclasses.asdict(self))

    @staticmethod
    def from_json(line: str) -> Setup:
        """From one line."""
        return Setup(**json.loads(line))
