"""The settings of a device by name, over its registers."""

from __future__ import annotations

import struct
from collections.abc import Callable

from tests.gige.camera.bank import Bank, Register
from tests.gige.camera.features import CHUNK_SWITCHES, CHUNKS, Feature, Kind, feature_table
from tests.gige.camera.setup import Setup
from tests.gige.camera.wire import Refused, Status


class Settings:
    """Reads and writes settings as a device does, and holds the rules for applications."""

    def __init__(self, setup: Setup, bank: Bank, busy: Callable[[], bool]) -> None:
        """Give every setting its register.

        Args:
            setup: what the device is.
            bank: its registers.
            busy: whether frames are being sent, so that some settings are held.
        """
        self.table = feature_table(setup)
        self._bank, self._busy = bank, busy
        self._by_name = {feature.name: feature for feature in self.table}
        for feature in self.table:
            if feature.bits is None and feature.kind is not Kind.TEXT:
                bank.register(self._register(feature))
                if feature.kind is not Kind.COMMAND:
                    self.put(feature.name, float(feature.default))
            elif feature.kind is Kind.TEXT:
                bank.register(Register(feature.address, feature.size, feature.writable))
        for number in CHUNKS.values():
            bank.register(Register(CHUNK_SWITCHES + 4 * number, 4, True))
            bank.put(CHUNK_SWITCHES + 4 * number, 1)

    def get(self, name: str) -> int:
        """A number, a switch or the code of a choice."""
        feature = self._by_name[name]
        return self._bank.get(feature.address, feature.size)

    def real(self, name: str) -> float:
        """A real number."""
        feature = self._by_name[name]
        return float(struct.unpack(">d", self._bank.get_bytes(feature.address, 8))[0])

    def chosen(self, name: str) -> str:
        """The entry of a choice."""
        code = self.get(name)
        return next(entry for entry, value in self._by_name[name].entries.items() if value == code)

    def chunk_on(self, name: str) -> bool:
        """Whether a chunk is switched on."""
        return bool(self._bank.get(CHUNK_SWITCHES + 4 * CHUNKS[name]))

    def put(self, name: str, value: float) -> None:
        """Set one, as the device itself."""
        feature = self._by_name[name]
        if feature.kind is Kind.FLOAT:
            self._bank.put_bytes(feature.address, struct.pack(">d", value))
        else:
            self._bank.put(feature.address, int(value), feature.size)

    def on_write(self, name: str, act: Callable[[int], None]) -> None:
        """Do something whenever an application writes a setting."""
        feature = self._by_name[name]
        register = self._register(feature)
        register.wrote = act
        self._bank.register(register)

    def on_read(self, name: str, value: Callable[[], int]) -> None:
        """Make the value of a setting at every reading."""
        feature = self._by_name[name]
        register = self._register(feature)
        register.source = value
        self._bank.register(register)

    def _register(self, feature: Feature) -> Register:
        def check(data: bytes) -> None:
            if feature.held and self._busy():
                raise Refused(Status.BUSY)
            if not _fits(feature, data):
                raise Refused(Status.INVALID_PARAMETER)

        writable = feature.writable or feature.kind is Kind.COMMAND
        return Register(feature.address, feature.size, writable, check=check)


def _fits(feature: Feature, data: bytes) -> bool:
    if feature.kind is Kind.COMMAND:
        return True
    if feature.kind is Kind.FLOAT:
        if len(data) != 8:
            return False
        return bool(feature.low <= struct.unpack(">d", data)[0] <= feature.high)
    value = int.from_bytes(data, "big", signed=feature.signed)
    if feature.kind is Kind.ENUM:
        return value in feature.entries.values()
    if feature.kind is Kind.SWITCH:
        return value in (0, 1)
    return feature.low <= value <= feature.high and (value - int(feature.low)) % feature.step == 0
