"""The registers of a device: memory with rules, and what a write sets off."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from tests.gige.camera.wire import Refused, Status


@dataclass
class Register:
    """One register.

    Attributes:
        address: where it begins.
        size: bytes.
        writable: whether an application may write it.
        check: refuses a value, by raising `Refused`; it gets the bytes.
        wrote: called after a value was stored.
        source: makes the value at every reading.
    """

    address: int
    size: int = 4
    writable: bool = False
    check: Callable[[bytes], None] | None = None
    wrote: Callable[[int], None] | None = None
    source: Callable[[], int] | None = None


class Bank:
    """Registers by address, and blocks of plain bytes."""

    def __init__(self) -> None:
        self._registers: dict[int, Register] = {}
        self._bytes: dict[int, bytearray] = {}  # by start; blocks never overlap

    def block(self, start: int, size: int, data: bytes = b"") -> None:
        """Add a block of memory."""
        self._bytes[start] = bytearray(data.ljust(size, b"\0"))

    def register(self, register: Register) -> None:
        """Give a place within a block its rules."""
        self._registers[register.address] = register

    def read(self, address: int, size: int) -> bytes:
        """Read bytes, asking the sources of the registers among them.

        Raises:
            Refused: when there is no such memory.
        """
        start, block = self._block(address, size)
        for place in range(address & ~7, address + size, 4):
            found = self._registers.get(place)
            if found is not None and found.source is not None:
                self.put(place, found.source(), found.size)
        return bytes(block[address - start : address - start + size])

    def write(self, address: int, data: bytes) -> None:
        """Write a register, as an application.

        Raises:
            Refused: when it cannot be written, or not with this value.
        """
        self._block(address, len(data))
        found = self._registers.get(address)
        if found is None or not found.writable:
            raise Refused(Status.WRITE_PROTECT)
        if len(data) > found.size:
            raise Refused(Status.INVALID_PARAMETER)
        if found.check is not None:
            found.check(data)
        self.put_bytes(address, data)
        if found.wrote is not None:
            found.wrote(int.from_bytes(data, "big"))

    def put(self, address: int, value: int, size: int = 4) -> None:
        """Set a number, as the device itself."""
        self.put_bytes(address, (value & ((1 << 8 * size) - 1)).to_bytes(size, "big"))

    def put_bytes(self, address: int, data: bytes) -> None:
        """Set bytes, as the device itself."""
        start, block = self._block(address, len(data))
        block[address - start : address - start + len(data)] = data

    def get(self, address: int, size: int = 4) -> int:
        """A number as it stands, without asking its source."""
        start, block = self._block(address, size)
        return int.from_bytes(block[address - start : address - start + size], "big")

    def get_bytes(self, address: int, size: int) -> bytes:
        """Bytes as they stand."""
        start, block = self._block(address, size)
        return bytes(block[address - start : address - start + size])

    def _block(self, address: int, size: int) -> tuple[int, bytearray]:
        for start, block in self._bytes.items():
            if start <= address and address + size <= start + len(block):
                return start, block
        raise Refused(Status.INVALID_ADDRESS)
