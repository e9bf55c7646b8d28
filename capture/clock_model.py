"""The common clock: a line from each device's clock to the host's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from capture.devices.protocol import ClockSample
from capture.errors import DeviceError


@dataclass(frozen=True)
class ClockModel:
    """t_host = host_ns + (t_dev - dev_ns) / rate.

    Attributes:
        dev_ns: a time of the device's clock.
        host_ns: the same time by the host's clock.
        rate: device nanoseconds in a host nanosecond.
        jitter_ns: root mean square of what the line does not explain; 0 when it was not fitted.
    """

    dev_ns: int
    host_ns: int
    rate: float = 1.0
    jitter_ns: float = 0.0

    def to_host(self, t_dev_ns: int) -> int:
        """The host's time of a device's time."""
        return self.host_ns + round((t_dev_ns - self.dev_ns) / self.rate)

    @property
    def drift_ppm(self) -> float:
        """How much too fast the device's clock runs, millionths."""
        return (self.rate - 1.0) * 1e6

    @property
    def offset_ns(self) -> int:
        """How far the device's clock is ahead of the host's, at the model's own time."""
        return self.dev_ns - self.host_ns


def model_of_samples(samples: Sequence[ClockSample]) -> ClockModel:
    """The model of the reading that was answered soonest, its answer taken from the middle.

    Args:
        samples: readings of one device's clock.

    Raises:
        DeviceError: when there is none.

    References:
        Cristian 1989, Probabilistic clock synchronization: the shortest round trip errs least.
    """
    if not samples:
        raise DeviceError("a clock model needs at least one reading of the device's clock")
    best = min(samples, key=lambda sample: sample.after_ns - sample.before_ns)
    return ClockModel(best.t_dev_ns, (best.before_ns + best.after_ns) // 2)


def fit_model(t_dev_ns: Sequence[int], t_host_ns: Sequence[int]) -> ClockModel:
    """The least-squares line through pairs of times; of one pair, the line of rate 1 through it.

    Args:
        t_dev_ns: times by the device's clock.
        t_host_ns: the same instants by the host's.

    Raises:
        DeviceError: when there is no pair, or the device's clock stands still.
    """
    if not t_dev_ns or len(t_dev_ns) != len(t_host_ns):
        raise DeviceError(
            f"a clock model needs pairs of times, found {len(t_dev_ns)} and {len(t_host_ns)}"
        )
    if len(t_dev_ns) == 1:
        return ClockModel(t_dev_ns[0], t_host_ns[0])
    # Whole nanoseconds since 1970 do not fit a float: take the first away before converting.
    dev = np.array([t - t_dev_ns[0] for t in t_dev_ns], dtype=np.float64)
    host = np.array([t - t_host_ns[0] for t in t_host_ns], dtype=np.float64)
    away = host - host.mean()
    rate = float(away @ (dev - dev.mean()) / max(float(away @ away), 1.0))
    if not rate > 0:
        raise DeviceError(f"the device's clock stands still or runs backwards: rate {rate:.3g}")
    rest = (dev - dev.mean()) - rate * away
    return ClockModel(
        t_dev_ns[0] + round(float(dev.mean())),
        t_host_ns[0] + round(float(host.mean())),
        rate,
        float(np.sqrt(np.mean(rest * rest))),
    )


def model_of_arrivals(t_dev_ns: Sequence[int], t_host_ns: Sequence[int]) -> ClockModel:
    """The line under which no frame arrived, through those that arrived soonest.

    For a device whose clock cannot be read: frames are delayed, never early, so that the lower edge
    of arrivals is the clock, later by the shortest delay there was.

    Args:
        t_dev_ns: times by the device's clock.
        t_host_ns: when each frame arrived, by the host's.

    Raises:
        DeviceError: when there is no pair.

    References:
        Moon, Skelly, Towsley 1999, Estimation and removal of clock skew from network delay
        measurements: the lower convex hull, its edge above the mean of the times.
    """
    if not t_dev_ns or len(t_dev_ns) != len(t_host_ns):
        raise DeviceError(
            f"a clock model needs pairs of times, found {len(t_dev_ns)} and {len(t_host_ns)}"
        )
    points = sorted({(d - t_dev_ns[0], h - d) for d, h in zip(t_dev_ns, t_host_ns, strict=True)})
    hull: list[tuple[int, int]] = []
    for point in points:
        while len(hull) > 1 and _turns_down(hull[-2], hull[-1], point):
            hull.pop()
        if hull and hull[-1][0] == point[0]:
            continue  # of two arrivals of one time, the sooner stands there already
        hull.append(point)
    middle = sum(x for x, _ in points) / len(points)
    right = next((n for n, (x, _) in enumerate(hull) if x >= middle and n > 0), len(hull) - 1)
    left = max(right - 1, 0)
    (x0, y0), (x1, y1) = hull[left], hull[right]
    slope = (y1 - y0) / (x1 - x0) if x1 > x0 else 0.0
    dev = t_dev_ns[0] + x0
    return ClockModel(dev, dev + y0, 1.0 / (1.0 + slope))


def _turns_down(a: tuple[int, int], b: tuple[int, int], c: tuple[int, int]) -> bool:
    """Whether b lies on or above the line from a to c."""
    return (b[1] - a[1]) * (c[0] - a[0]) >= (c[1] - a[1]) * (b[0] - a[0])
