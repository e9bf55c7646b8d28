"""Commands of GVCP: who may give them, how they are answered."""

from __future__ import annotations

import struct
from collections.abc import Callable

from tests.gige.camera.bank import Bank
from tests.gige.camera.faults import Faults
from tests.gige.camera.wire import (
    ACK_HEADER,
    COMMAND_KEY,
    DISCOVERY_BYTES,
    FLAG_ACK,
    FLAG_SCHEDULED,
    GVCP_HEADER,
    Command,
    PacketId,
    Refused,
    Reg,
    Status,
    read_resend,
)

Peer = tuple[str, int]


class Commands:
    """Answers commands, and holds the privilege to control the device."""

    def __init__(
        self,
        bank: Bank,
        faults: Faults,
        resend: Callable[[PacketId, int], None],
        act: Callable[[int | None], Status],
    ) -> None:
        """Answer commands.

        Args:
            bank: the registers.
            faults: what is wrong.
            resend: sends packets again.
            act: carries an action out, at a time by the device's clock or at once.
        """
        self._bank, self._faults, self._resend, self._act = bank, faults, resend, act
        self.holder: Peer | None = None
        self._heard_ns = 0
        self._last_action: tuple[Peer, int, Status] | None = None
        self.lost_control: Callable[[], None] = lambda: None

    def answer(self, packet: bytes, peer: Peer, now_ns: int) -> bytes | None:
        """The answer to a packet; None when there is none."""
        if self._faults.dead or len(packet) < GVCP_HEADER.size or packet[0] != COMMAND_KEY:
            return None
        _key, flags, code, length, request = GVCP_HEADER.unpack_from(packet)
        body = packet[GVCP_HEADER.size : GVCP_HEADER.size + length]
        self.watch(now_ns)
        if peer == self.holder:
            self._heard_ns = now_ns
        status, reply = Status.SUCCESS, b""
        try:
            if code == Command.PACKET_RESEND:
                self._resend(*read_resend(flags, body))
                return None
            if code == Command.ACTION:
                status = self._action(flags, body, peer, request)
                if self._faults.mute_actions > 0:
                    self._faults.mute_actions -= 1
                    return None
            else:
                reply = self._run(code, body, peer, now_ns)
        except _NotMeant:
            return None
        except (Refused, struct.error) as error:
            status = error.status if isinstance(error, Refused) else Status.INVALID_PARAMETER
        if not flags & FLAG_ACK:
            return None
        return ACK_HEADER.pack(status, code + 1, len(reply), request) + reply

    def watch(self, now_ns: int) -> None:
        """Take the privilege from a holder that was not heard for too long."""
        patience_ns = self._bank.get(Reg.HEARTBEAT) * 1_000_000
        if self.holder is not None and now_ns - self._heard_ns > patience_ns:
            self._release()

    def _run(self, code: int, body: bytes, peer: Peer, now_ns: int) -> bytes:
        if code == Command.DISCOVERY:
            return self._bank.get_bytes(0, DISCOVERY_BYTES)
        if code == Command.READ_REGISTER:
            places = [place for (place,) in struct.iter_unpack(">I", body)]
            if any(place & 3 for place in places):
                raise Refused(Status.BAD_ALIGNMENT)
            return b"".join(self._bank.read(place, 4) for place in places)
        if code == Command.READ_MEMORY:
            place, count = struct.unpack_from(">IxxH", body)
            if place & 3 or count & 3:
                raise Refused(Status.BAD_ALIGNMENT)
            return struct.pack(">I", place) + self._bank.read(place, count)
        if code == Command.WRITE_REGISTER:
            pairs = list(struct.iter_unpack(">II", body))
            for place, value in pairs:
                self._write(place, struct.pack(">I", value), peer, now_ns)
            return struct.pack(">HH", 0, len(pairs))
        if code == Command.WRITE_MEMORY:
            self._write(int.from_bytes(body[:4], "big"), body[4:], peer, now_ns)
            return struct.pack(">HH", 0, len(body) - 4)
        raise Refused(Status.NOT_IMPLEMENTED)

    def _write(self, place: int, data: bytes, peer: Peer, now_ns: int) -> None:
        if place & 3:
            raise Refused(Status.BAD_ALIGNMENT)
        if place == Reg.PRIVILEGE:
            self._privilege(int.from_bytes(data, "big"), peer, now_ns)
        elif peer != self.holder:
            raise Refused(Status.ACCESS_DENIED)
        else:
            self._bank.write(place, data)

    def _privilege(self, value: int, peer: Peer, now_ns: int) -> None:
        if self.holder not in (None, peer):
            raise Refused(Status.ACCESS_DENIED)
        if value & 3:
            self.holder, self._heard_ns = peer, now_ns
            self._bank.put(Reg.PRIVILEGE, value)
        elif self.holder is not None:
            self._release()

    def _release(self) -> None:
        self.holder = None
        self._bank.put(Reg.PRIVILEGE, 0)
        self._bank.put(Reg.STREAM_PORT, 0)
        self.lost_control()

    def _action(self, flags: int, body: bytes, peer: Peer, request: int) -> Status:
        device_key, group_key, group_mask = struct.unpack_from(">III", body)
        wanted = (
            self.holder is not None
            and device_key == self._bank.get(Reg.ACTION_DEVICE_KEY)
            and group_key == self._bank.get(Reg.ACTION_GROUP_KEY)
            and group_mask & self._bank.get(Reg.ACTION_GROUP_MASK)
        )
        if not wanted:
            raise _NotMeant
        if self._last_action is not None and self._last_action[:2] == (peer, request):
            return self._last_action[2]  # sent twice: acknowledged twice, carried out once
        at_ns = struct.unpack_from(">Q", body, 12)[0] if flags & FLAG_SCHEDULED else None
        status = self._act(at_ns)
        self._last_action = (peer, request, status)
        return status


class _NotMeant(Exception):  # noqa: N818
    """A command for other devices."""
