"""One CRTP session with a vehicle over any transport: requests with answers, parameters, logs, memory and pings.

A request is repeated until it is answered, on reliable transports too, so every request must tolerate arriving twice.
Packets in flight are sent once, without waiting for an answer.
"""

import struct
import threading
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from cfplan.errors import LinkError
from cfplan.flight.clock import Clock
from cfplan.flight.radio.crtp import Port, pack
from cfplan.flight.radio.log_block import DATA_CHANNEL, DELETE, RESET, SETTINGS_CHANNEL, LogBlock
from cfplan.flight.radio.parameter_tables import Table, TableCache, read_table
from cfplan.flight.radio.transport import Transport

TABLES_TIMEOUT = 30.0  # s, from the first answer to the last table, read item by item over a lossy radio
PING_PERIOD = 0.1  # s
READ_PARAMETER, WRITE_PARAMETER = 1, 2  # channels
_RETRY_PERIOD = 0.2  # s
_LOOK_PERIOD = 0.02  # s between calls of `waiting`
_MAX_PINGS = 100  # for the round trip: 10 s
_ECHO, _VERSION = 0, 1  # channels: of the link port, of the platform port
_PROTOCOL, _FIRMWARE = b"\0", b"\1"
_MEMORY_INFO, _MEMORY_READ, _MEMORY_WRITE = range(3)
_TRAJECTORY_MEMORY = 0x12  # type of memory
_CHUNK = 24  # bytes of memory in a packet
_UPLOAD_TIMEOUT = 30.0  # s to write and read back 4,096 bytes, in some 340 packets
_LOG_ATTEMPTS = 5  # to create a log

# Type codes of parameters in the table, with flags.
_TYPE_MASK, _READ_ONLY = 0x0F, 0x40
_LAYOUTS = {0x08: "<B", 0x09: "<H", 0x0A: "<I", 0x0B: "<Q", 0x00: "<b", 0x01: "<h", 0x02: "<i", 0x03: "<q", 0x06: "<f",
            0x07: "<d"}  # fmt: skip


class Session:
    """A session, usable after `open`. While it waits for an answer it calls `waiting`, which may raise."""

    def __init__(self, transport: Transport, uri: str, clock: Clock, waiting: Callable[[], None] = lambda: None):
        self.uri, self.clock = uri, clock
        self.lost = ""  # why the link is lost; empty while it is up
        self.protocol, self.firmware = -1, ""
        self.parameters: Table = {}
        self.log_variables: Table = {}
        self.acknowledged = clock.now()  # s, when the vehicle's main processor last answered a ping
        self._transport, self._waiting = transport, waiting
        self._listeners: dict[int, Callable[[int, bytes], None]] = {}
        self._logs: dict[int, tuple[LogBlock, Callable[[int, dict[str, Any]], None]]] = {}
        self._expected: tuple[int, int, bytes] | None = None  # port, channel and first bytes of the expected answer
        self._answer, self._answered = b"", threading.Event()
        self._pings: dict[bytes, float] = {}  # unanswered, with the time, s, of sending
        self._round_trips: deque[float] = deque(maxlen=_MAX_PINGS)
        self._pinged = 0
        transport.listen(self.hear, self.fail)

    def open(self, patience: float, tables: TableCache) -> None:
        """Ask for versions and tables, and begin to ping.

        Raises LinkError if nothing answers for `patience`, s, or if the tables do not come within 30 s.
        """
        self.protocol = int.from_bytes(self.ask(Port.PLATFORM, _VERSION, _PROTOCOL, 1, patience)[1:2])
        end = self.clock.now() + TABLES_TIMEOUT

        def ask(port: Port, channel: int, payload: bytes, head: int) -> bytes:
            return self.ask(port, channel, payload, head, end - self.clock.now())

        try:
            version = ask(Port.PLATFORM, _VERSION, _FIRMWARE, 1)[1:]
            self.firmware = version.split(b"\0")[0].decode("ascii", "replace")
            self.log_variables = read_table(Port.LOG, ask, tables)
            self.parameters = read_table(Port.PARAMETERS, ask, tables)
        except LinkError as error:
            if self.lost:
                raise
            raise LinkError("the vehicle answers, but its tables do not come through", where=self.uri,
                            hint="move closer, or choose a freer channel") from error  # fmt: skip
        except (ValueError, IndexError, struct.error) as error:
            raise LinkError("the vehicle's tables are damaged", where=self.uri, hint="restart the vehicle") from error
        self.clock.repeat(self._ping, name="ping")

    def close(self) -> None:
        """End the session and its transport."""
        self.fail("the link was closed")
        self._transport.close()

    @property
    def round_trip(self) -> float:
        """Return the round trip, s: 95th percentile of the last pings; 0 before the first."""
        return float(np.percentile(self._round_trips, 95)) if self._round_trips else 0.0

    def listen(self, port: Port, note: Callable[[int, bytes], None]) -> None:
        """Call `note` with channel and payload of each packet from a port."""
        self._listeners[port] = note

    # Sent at any time: these never wait for an answer.

    def send(self, packet: bytes) -> None:
        """Send a packet; a lost link drops it silently, see `lost`."""
        if not self.lost:
            self._transport.send(packet)

    def fail(self, reason: str) -> None:
        """Record why the link is lost, unless it already was."""
        self.lost = self.lost or (reason.splitlines() or ["no reason given"])[0]

    def _ping(self) -> float | None:
        """Send a ping. The radio processor acknowledges packets by itself; only the main processor answers pings."""
        if self.lost:
            return None
        self._pinged += 1
        content = struct.pack("<BI", 0, self._pinged)
        self._pings[content] = self.clock.now()
        if len(self._pings) > _MAX_PINGS:
            del self._pings[next(iter(self._pings))]
        self.send(pack(Port.LINK, _ECHO, content))
        return PING_PERIOD

    # Callbacks: these run in the transport's thread and must be quick.

    def hear(self, packet: bytes) -> None:
        """Take a packet from the vehicle."""
        if not packet:
            return
        port, channel, payload = packet[0] >> 4, packet[0] & 3, packet[1:]
        if (port, channel) == (Port.LOG, DATA_CHANNEL):
            self._take_log(payload)
        elif (port, channel) == (Port.LINK, _ECHO):
            sent = self._pings.pop(payload, None)
            if sent is not None:
                self.acknowledged = self.clock.now()
                self._round_trips.append(self.acknowledged - sent)
        else:
            expected = self._expected
            if expected is not None and expected[:2] == (port, channel) and payload.startswith(expected[2]):
                self._answer = payload
                self._answered.set()
            if port in self._listeners:
                self._listeners[port](channel, payload)

    def _take_log(self, payload: bytes) -> None:
        block, note = self._logs.get(payload[0] if payload else -1, (None, None))
        if block is not None and note is not None:
            values = block.decode(payload)
            if values is not None:
                note(int.from_bytes(payload[1:4], "little"), values)

    # For the ground only: these wait for an answer.

    def ask(self, port: Port, channel: int, payload: bytes, head: int, patience: float, what: str = "") -> bytes:
        """Send until an answer begins with the first `head` bytes of the payload, and return it.

        Raises LinkError if there is none within `patience`, s, or if the link is lost meanwhile.
        """
        request, clock, now = pack(port, channel, payload), self.clock, self.clock.now()
        end = now + patience
        self._answered.clear()
        self._expected = port, channel, payload[:head]
        try:
            while not self.lost and now < end:
                self.send(request)
                again = min(now + _RETRY_PERIOD, end)
                while not self.lost and now < again:
                    self._waiting()
                    if clock.wait(self._answered, min(_LOOK_PERIOD, again - now)):
                        return self._answer
                    now = clock.now()
        finally:
            self._expected = None
        if self.lost:
            raise LinkError(f"the link is lost: {self.lost}", where=self.uri, hint="check the radio link")
        raise LinkError(f"no answer to {what or port.name.lower()}", where=self.uri, hint="check the radio link")

    def read_parameter(self, name: str, patience: float) -> float:
        """Return the present value of an existing parameter. Raises LinkError if the vehicle does not answer."""
        number, kind = self.parameters[name]
        head = struct.pack("<H", number)
        answer = self.ask(Port.PARAMETERS, READ_PARAMETER, head, len(head), patience, f"reading {name}")
        try:
            return float(struct.unpack_from(_LAYOUTS[kind & _TYPE_MASK], answer, 3)[0])
        except (struct.error, KeyError) as error:
            raise LinkError(f"the vehicle gives no value of {name}", where=self.uri,
                            hint="restart the vehicle") from error  # fmt: skip

    def write_parameter(self, name: str, value: float, patience: float) -> None:
        """Write a parameter. Raises LinkError if the vehicle lacks it, it is read-only, or there is no answer."""
        number, kind = self.parameters.get(name, (-1, _READ_ONLY))
        layout = _LAYOUTS.get(kind & _TYPE_MASK)
        if kind & _READ_ONLY or layout is None:
            raise LinkError(
                f"the vehicle has no parameter {name} that can be set", where=self.uri, hint="update its firmware"
            )
        content = struct.pack("<H", number) + struct.pack(layout, value if layout in ("<f", "<d") else int(value))
        self.ask(Port.PARAMETERS, WRITE_PARAMETER, content, 2, patience, f"setting {name}")

    def reset_logs(self) -> None:
        """Delete all log blocks of the vehicle, also those of an earlier session."""
        self._logs.clear()
        self.ask(Port.LOG, SETTINGS_CHANNEL, bytes((RESET,)), 1, _RETRY_PERIOD * _LOG_ATTEMPTS, "resetting the log")

    def start_log(
        self, variables: Sequence[tuple[str, str]], period_ms: int, note: Callable[[int, dict[str, Any]], None]
    ) -> LogBlock:
        """Create a log block of variables, (name, type in C), and start it; `note` gets ms and values of each message.

        Raises LinkError if the vehicle lacks one of them or does not create the block.
        """
        lacking = next((name for name, _ in variables if name not in self.log_variables), None)
        if lacking is not None:
            raise LinkError(f"the vehicle has no log variable {lacking}", where=self.uri, hint="update its firmware")
        entries = tuple((name, kind, self.log_variables[name][0]) for name, kind in variables)
        block = LogBlock(len(self._logs), period_ms, entries)
        self._logs[block.number] = block, note
        for _ in range(_LOG_ATTEMPTS):
            if all(self._run_log_command(payload) for payload in block.creation()):
                return block
            self._run_log_command(bytes((DELETE, block.number)))  # it may exist in part
        raise LinkError("the vehicle does not create a log", where=self.uri, hint="check the radio link")

    def _run_log_command(self, payload: bytes) -> bool:
        """Send a log command once; return whether the vehicle confirms it."""
        try:
            answer = self.ask(Port.LOG, SETTINGS_CHANNEL, payload, 2, _RETRY_PERIOD)
        except LinkError:
            return False
        return answer[2:3] == b"\0"

    def write_trajectory_memory(self, content: bytes) -> bytes:
        """Write the beginning of the trajectory memory, and return the same bytes as read back.

        Raises LinkError if the vehicle has no such memory, or does not write and read all of it within 30 s.
        """
        end = self.clock.now() + _UPLOAD_TIMEOUT

        def ask(channel: int, payload: bytes, head: int, act: str) -> bytes:
            return self.ask(Port.MEMORY, channel, payload, head, end - self.clock.now(), f"{act} its memory")

        count = ask(_MEMORY_INFO, b"\1", 1, "listing")[1:2]
        details = (ask(_MEMORY_INFO, bytes((2, number)), 2, "listing") for number in range(ord(count or b"\0")))
        number = next((found[1] for found in details if found[2:3] == bytes((_TRAJECTORY_MEMORY,))), None)
        if number is None:
            raise LinkError("the vehicle has no trajectory memory", where=self.uri, hint="update its firmware")
        parts = {at: content[at : at + _CHUNK] for at in range(0, len(content), _CHUNK)}
        held = b""
        for channel, act in ((_MEMORY_WRITE, "writing"), (_MEMORY_READ, "reading")):
            for at, part in parts.items():
                more = part if channel == _MEMORY_WRITE else bytes((len(part),))
                answer = ask(channel, struct.pack("<BI", number, at) + more, 5, act)
                if answer[5:6] != b"\0":
                    raise LinkError(f"the vehicle refuses {act} its trajectory memory", where=self.uri,
                                    hint="restart the vehicle")  # fmt: skip
                held += answer[6:] if channel == _MEMORY_READ else b""
        return held
