"""The clock of a device: free, or following a master (IEEE 1588)."""

from __future__ import annotations

from tests.gige.camera.setup import MASTER_EPOCH_NS, Setup

DISABLED, LISTENING, MASTER, UNCALIBRATED, SLAVE = 3, 4, 6, 8, 9
PTP_STATES = {
    "Initializing": 1,
    "Faulty": 2,
    "Disabled": DISABLED,
    "Listening": LISTENING,
    "PreMaster": 5,
    "Master": MASTER,
    "Passive": 7,
    "Uncalibrated": UNCALIBRATED,
    "Slave": SLAVE,
}


class DeviceClock:
    """Shows device time for true time (the host's monotonic clock), both in nanoseconds."""

    def __init__(self, setup: Setup, now_ns: int) -> None:
        self._at, self._shown = now_ns, setup.clock_start_ns
        self.drift_ppm = setup.drift_ppm
        self.settle_ns = round(setup.ptp_settle_s * 1e9)
        self.offset_ns = setup.ptp_offset_ns
        self.grandmaster = setup.grandmaster
        self.enabled = False
        self.forced: int | None = None
        self._enabled_at = 0

    def enable(self, on: bool, now_ns: int) -> None:
        """Switch following on or off; it begins by listening, and anew at every switching on."""
        self._hold(now_ns)
        self.enabled, self._enabled_at = on, now_ns

    def force(self, state: int | None, now_ns: int) -> None:
        """Show a state whatever is true; None ends that."""
        self._hold(now_ns)
        self.forced = state

    def state(self, now_ns: int) -> int:
        """State of the following, as the standard numbers it."""
        if self.forced is not None:
            return self.forced
        if not self.enabled:
            return DISABLED
        return SLAVE if now_ns - self._enabled_at >= self.settle_ns else LISTENING

    def follows(self, now_ns: int) -> bool:
        """Whether it shows the master's time."""
        return self.state(now_ns) in (SLAVE, MASTER)

    def read(self, true_ns: int) -> int:
        """What it shows at a true time."""
        if self.follows(true_ns):
            return true_ns + MASTER_EPOCH_NS + self.offset_ns
        passed = true_ns - self._at
        return self._shown + passed + round(passed * self.drift_ppm * 1e-6)

    def when(self, shown_ns: int, now_ns: int) -> int:
        """The true time at which it will show a time."""
        if self.follows(now_ns):
            return shown_ns - MASTER_EPOCH_NS - self.offset_ns
        return self._at + round((shown_ns - self._shown) / (1 + self.drift_ppm * 1e-6))

    def step(self, by_ns: int, now_ns: int) -> None:
        """Jump."""
        if self.follows(now_ns):
            self.offset_ns += by_ns
        else:
            self._hold(now_ns)
            self._shown += by_ns

    def set_drift(self, ppm: float, now_ns: int) -> None:
        """Run faster or slower from now on."""
        self._hold(now_ns)
        self.drift_ppm = ppm

    def reset(self, now_ns: int) -> None:
        """Begin again at zero; a clock that follows a master does not."""
        if not self.follows(now_ns):
            self._at, self._shown = now_ns, 0

    def _hold(self, now_ns: int) -> None:
        self._at, self._shown = now_ns, self.read(now_ns)
