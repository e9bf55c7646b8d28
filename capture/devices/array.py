"""`DeviceArray`: the devices that are recorded together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from capture.devices.protocol import (
    ActionKeys,
    Device,
    TriggerKind,
    TriggerLine,
    TriggerSpec,
)
from capture.errors import DeviceError, TakeError, raise_all
from capture.names import is_plain_name, named


@dataclass(frozen=True, eq=False)
class DeviceArray:
    """The devices that are recorded together, and the line that triggers them.

    Attributes:
        devices: in a fixed order, with unique names.
        line: triggers them all.
        trigger: what starts an exposure.
        source: the input of hardware triggers; empty for each device's own choice.
        action: which devices act, for action commands.
    """

    devices: tuple[Device, ...]
    line: TriggerLine
    trigger: TriggerKind = TriggerKind.HARDWARE
    source: str = ""
    action: ActionKeys = field(default_factory=ActionKeys)

    def __post_init__(self) -> None:
        names = self.names
        problems = [
            f"{name!r} is not safe as a file name" for name in names if not is_plain_name(name)
        ]
        problems += [
            f"{name!r} is there twice" for name in sorted(set(names)) if names.count(name) > 1
        ]
        if not names:
            problems.append("there must be at least one device")
        raise_all("device array", problems, TakeError)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the devices, in order."""
        return tuple(device.info.name for device in self.devices)

    def prepare(self, period_ns: int, exposure_us: float) -> None:
        """Set every device up for its trigger; all are tried.

        Raises:
            DeviceError: listing every device that could not, and why.
        """
        spec = TriggerSpec(
            kind=self.trigger, period_ns=period_ns, exposure_us=exposure_us, source=self.source,
            action=self.action,
        )  # fmt: skip
        self.each("not ready", lambda device: device.trigger.prepare(spec))

    def each(self, failed: str, work: Callable[[Device], object]) -> None:
        """Do something with every device; all are tried.

        Args:
            failed: what a device is when it could not, for the message.
            work: raises `DeviceError` when it cannot.

        Raises:
            DeviceError: listing every device that could not, and why.
        """
        problems = []
        for device in self.devices:
            try:
                work(device)
            except DeviceError as error:
                problems.append(f"  - {named(device.info.name, error)}")
        if problems:
            raise DeviceError(
                "\n".join([f"{len(problems)} of {len(self.devices)} devices {failed}:", *problems])
            )

    def close(self) -> None:
        """Give every device back."""
        for device in self.devices:
            device.close()
