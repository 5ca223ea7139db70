"""The MAVLink bridge: to and from ground stations during a flight, without ever delaying the flight.

A thread of the main process, never of the pilot's, sends the pilot's telemetry and listens for
commands to stop. These are returned by `orders`, and reach the pilot like keys. All packets of both directions
are kept in a .tlog, each after its time, µs since 1970, 8 bytes big endian.
"""

import contextlib
import ipaddress
import socket
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Any

from cfplan.errors import InputError
from cfplan.flight.clock import REAL_CLOCK, Clock, Repeated
from cfplan.flight.pilot.keys import Order
from cfplan.flight.telemetry import Estimate, Event, Level, PhaseEntered, SetpointSent, Telemetry, VehicleStatus
from cfplan.recording.mavlink import messages
from cfplan.recording.mavlink.commands import Answer, answer, command_of

SYSTEM, COMPONENT = 1, 1  # of the vehicle: the first, its autopilot
BROADCAST = 0
_V1, _V2, _SIGNED = 0xFE, 0xFD, 0x01
_LARGEST_DATAGRAM = 2048  # bytes; MAVLink's are never longer
_DATAGRAMS_AT_ONCE = 50  # before it is time to send again
_SHORTEST_WAIT, _LONGEST_WAIT = 0.001, 0.1  # s between checks of what is due
_FLUSH_PERIOD = 1.0  # s, of the .tlog
_CLOSE_TIMEOUT = 2.0  # s to wait for the last packets at the end of a flight
_SEVERITY = {Level.INFO: 6, Level.WARNING: 4, Level.ERROR: 3}  # MAV_SEVERITY
_WARNING = 4
_FORM = "as in udp:127.0.0.1:14550, where the ground station listens"


@dataclass(frozen=True, slots=True)
class Place:
    """The address of the ground station."""

    host: str
    port: int

    @property
    def here(self) -> bool:
        """Return whether it is on this machine."""
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"


def parse_place(text: str) -> Place:
    """Read udp:HOST:PORT. Raises InputError."""
    kind, _, rest = text.partition(":")
    host, _, port = rest.rpartition(":")
    if kind != "udp" or not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise InputError("not a MAVLink address", where=text, hint=_FORM)
    return Place(host.strip("[]"), int(port))


def check_place(text: str) -> None:
    """Check that MAVLink can be sent there. Raises InputError; also where the extra is not installed."""
    _dialect()
    link, _ = _open(parse_place(text))
    link.close()


class GroundStation:
    """The link to one ground station; sends and receives while it is entered.

    `show` takes a message of the pilot's and returns at once; `orders` returns the commands since the last call.
    Only packets from the host and port of that place are heard.
    """

    def __init__(self, place: Place, log: Path | None = None, *, boot: float | None = None, clock: Clock = REAL_CLOCK):
        """Raises InputError if the extra is missing, the address cannot be reached or the log cannot be written."""
        self._mav = _dialect().MAVLink(self, srcSystem=SYSTEM, srcComponent=COMPONENT)
        self._clock = clock
        self._wall_zero = time.time() - clock.now()  # s since 1970 at which the clock was zero
        self._latest = messages.Latest(clock.now() if boot is None else boot)
        self._texts: deque[tuple[int, str]] = deque(maxlen=200)
        self._orders: deque[Order] = deque(maxlen=100)
        self._due = [0.0] * len(messages.RATES)
        self._text_number = 0
        self._socket, self._target = _open(place)
        self._log: IO[bytes] | None = None
        if log is not None:
            try:
                self._log = log.open("xb")
            except OSError as error:
                self._socket.close()
                raise InputError(
                    f"cannot be written ({error.strerror or error})", where=str(log), hint="choose another folder"
                ) from error
        self._flushed = 0.0
        self.failure = ""  # why the log is incomplete, one line; empty if it is not
        self.heard = 0  # packets from ground stations
        self._serving: Repeated | None = None

    def __enter__(self) -> "GroundStation":
        self._serving = self._clock.repeat(self._serve, name="mavlink", last=self._send_last, wake=self._socket)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._serving is not None:
            self._serving.stop(_CLOSE_TIMEOUT)
        self._socket.close()
        if self._log is not None:
            with contextlib.suppress(OSError):
                self._log.close()

    def show(self, message: Telemetry) -> None:
        """Take a message."""
        match message:
            case Estimate():
                self._latest.estimate = message
            case VehicleStatus():
                self._latest.status = message
            case SetpointSent():
                self._latest.setpoint = message
            case PhaseEntered(phase=phase):
                self._latest.phase = phase
                self._texts.append((_SEVERITY[Level.INFO], f"phase: {phase}"))
            case Event(level=level, text=text):
                self._texts.append((_SEVERITY[level], text))

    def orders(self) -> list[Order]:
        """Return the commands since the last call; never waits."""
        given = []
        while self._orders:
            given.append(self._orders.popleft())
        return given

    def write(self, packet: bytes) -> None:
        """Send a packet; the dialect's encoder calls this."""
        self._keep(packet)
        with contextlib.suppress(OSError):  # no listener
            self._socket.sendto(packet, self._target)

    def _serve(self) -> float:
        """Read received packets, send due messages, and return s until the next is due."""
        for act in (self._listen, self._send_due):
            try:
                act()
            except Exception as error:  # a fault here must not block a later stop
                self._fail(f"fault in MAVLink: {error!r}")
        return min(_LONGEST_WAIT, max(_SHORTEST_WAIT, min(self._due) - self._clock.now()))

    def _send_last(self) -> None:
        with contextlib.suppress(Exception):
            self._send_texts()
            self._mav.send(messages.heartbeat(self._mav, self._latest))

    def _send_due(self) -> None:
        now = self._clock.now()
        for index, (make, rate) in enumerate(messages.RATES):
            if now >= self._due[index]:
                self._due[index] = max(self._due[index] + 1 / rate, now + 0.5 / rate)
                message = make(self._mav, self._latest)
                if message is not None:
                    self._mav.send(message)
        self._send_texts()
        if self._log is not None and now - self._flushed > _FLUSH_PERIOD:
            self._flushed = now
            try:
                self._log.flush()
            except OSError as error:
                self._fail(f"the .tlog ends early: {error}")

    def _send_texts(self) -> None:
        while self._texts:
            severity, text = self._texts.popleft()
            self._text_number = self._text_number % 65535 + 1
            for message in messages.status_texts(self._mav, severity, text, self._text_number):
                self._mav.send(message)

    def _listen(self) -> None:
        for _ in range(_DATAGRAMS_AT_ONCE):
            if not self._clock.readable([self._socket], 0.0):
                return
            try:
                data, sender = self._socket.recvfrom(_LARGEST_DATAGRAM)
            except OSError:  # an earlier packet was not deliverable
                continue
            if sender[:2] != self._target[:2]:  # no other program may stop the flight
                continue
            for packet, message in messages_in(data):
                self._hear(packet, message)

    def _hear(self, packet: bytes, message: Any) -> None:
        self.heard += 1
        self._keep(packet)
        command = command_of(message)
        if command is not None and self._is_for_us(message):
            self._obey(command[0], answer(*command), message)
        elif message.get_type() == "MISSION_REQUEST_LIST" and self._is_for_us(message):
            self._mav.send(self._mav.mission_count_encode(message.get_srcSystem(), message.get_srcComponent(), 0))

    def _obey(self, command: int, found: Answer, message: Any) -> None:
        if found.order is not None:
            self._orders.append(found.order)  # before anything that might fail
        acknowledgement = self._mav.command_ack_encode(
            command,
            int(found.result),
            target_system=message.get_srcSystem(),
            target_component=message.get_srcComponent(),
        )
        self._mav.send(acknowledgement)
        if found.message is not None:
            self._mav.send(messages.autopilot_version(self._mav, self._latest))
        if found.text:
            self._texts.append((_WARNING, found.text))

    def _is_for_us(self, message: Any) -> bool:
        return message.target_system in (BROADCAST, SYSTEM) and message.target_component in (BROADCAST, COMPONENT)

    def _keep(self, packet: bytes) -> None:
        if self._log is None:
            return
        try:
            self._log.write(round(1e6 * (self._wall_zero + self._clock.now())).to_bytes(8, "big") + packet)
        except (OSError, ValueError) as error:
            self._fail(f"the .tlog ends early: {error}")
            self._log = None

    def _fail(self, text: str) -> None:
        self.failure = self.failure or text


def messages_in(data: bytes) -> Iterator[tuple[bytes, Any]]:
    """Yield the complete and known packets of a datagram, in order, each with its message.

    Each datagram is decoded alone, so that garbage in one can never swallow a command in the next.
    """
    dialect = _dialect()
    place = 0
    while place < len(data):
        size = _size(data, place)
        packet = data[place : place + size]
        message = None
        if 0 < size == len(packet):
            with contextlib.suppress(dialect.MAVError):
                message = dialect.MAVLink(None).decode(bytearray(packet))
        if message is None or isinstance(message, dialect.MAVLink_unknown):  # whose checksum is unknown
            place += 1
            continue
        yield packet, message
        place += size


def _size(data: bytes, place: int) -> int:
    """Return the length of the packet that begins there; 0 where none does."""
    if data[place] == _V2 and place + 2 < len(data):
        return 12 + data[place + 1] + (13 if data[place + 2] & _SIGNED else 0)
    if data[place] == _V1 and place + 1 < len(data):
        return 8 + data[place + 1]
    return 0


def _dialect() -> Any:
    try:
        from pymavlink.dialects.v20 import common
    except ImportError as error:
        raise InputError(
            "MAVLink needs the package pymavlink", where="--mavlink", hint="pip install 'cfplan[mavlink]'"
        ) from error
    return common


def _open(place: Place) -> tuple[socket.socket, Any]:
    """Open a socket, reachable only from this machine if the place is on it; return it and the place's address."""
    try:
        family, kind, _, _, address = socket.getaddrinfo(place.host, place.port, type=socket.SOCK_DGRAM)[0]
        link = socket.socket(family, kind)
    except OSError as error:
        raise InputError(
            f"there is no such host ({error.strerror or error})", where=f"udp:{place.host}:{place.port}", hint=_FORM
        ) from error
    any_address, loopback = ("::", "::1") if family == socket.AF_INET6 else ("0.0.0.0", "127.0.0.1")
    link.bind((loopback if place.here else any_address, 0))
    link.setblocking(False)
    return link, address
