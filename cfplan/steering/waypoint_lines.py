"""Steer by lines of text: one waypoint or word a line, from standard input or a socket on this machine.

    1.0 0.0 1.2                   fly on through x y z, m, after what is ahead
    replace 0 -1 1.5  1 1 1       fly through these instead, from the next joint on
    stop | slower | faster | land | cut

Each line is answered by one that begins with its number. Waypoints that wait together are planned together. A line that
cannot be flown, or is no such line, is refused in words, and the flight goes on as it was.
"""

import contextlib
import queue
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import IO, Protocol

from cfplan.errors import FlightEndedError, InputError, RequestRefusedError, printable
from cfplan.flight.telemetry import Triple
from cfplan.preparation.air_planner import Wish
from cfplan.steering.recorded_steering import answer_text
from cfplan.steering.steered_vehicle import SteeredVehicle, checked_waypoints

STANDARD_INPUT = "-"
LOCAL = ("127.0.0.1", "localhost", "::1")
LAND, CUT = "land", "cut"
MOST_TOGETHER = 20  # waiting waypoints that are planned as one request
_LONGEST = 10_000  # characters of a line
_WAITING = 1000  # lines that wait; a sender that is faster is held up
_PATIENCE = 0.1  # s
_HINT = "write x y z in metres, as 1.0 0.0 1.2; or replace, stop, slower, faster, land, cut"
_WORDS = {wish.value: wish for wish in Wish}


@dataclass(frozen=True, slots=True)
class TextLine:
    """A line, and where its answer goes."""

    text: str
    reply: Callable[[str], None]


class LineSource(Protocol):
    """Where lines come from."""

    def next(self, patience: float) -> TextLine | None:
        """Return the next line, waiting for it for `patience`, s; None where none came. Raises EOFError at the end."""


@dataclass(frozen=True, slots=True)
class _Asked:
    """What a line asks for: a wish with waypoints, or to land or to cut."""

    line: TextLine
    number: int  # of the line
    wish: Wish | str
    waypoints: tuple[Triple, ...] = ()


def parse_line(text: str) -> tuple[Wish | str, tuple[Triple, ...]]:
    """Return what a line asks for, and its waypoints. Raises InputError where it is no such line."""
    words = text.replace(",", " ").split()
    wish: Wish | str = Wish.EXTEND
    if words and words[0].lower() in (*_WORDS, LAND, CUT):
        word = words.pop(0).lower()
        wish = _WORDS.get(word, word)
    if wish not in (Wish.EXTEND, Wish.REPLACE):
        if words:
            raise InputError(f"{words[0]!r} after {str(wish)!r}", where="line", hint=_HINT)
        return wish, ()
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        raise InputError(f"{text.strip()[:60]!r} is no waypoint", where="line", hint=_HINT) from None
    if not numbers or len(numbers) % 3:
        raise InputError(f"{len(numbers)} numbers, not three for each waypoint", where="line", hint=_HINT)
    rows = [numbers[at : at + 3] for at in range(0, len(numbers), 3)]
    return wish, checked_waypoints(rows)


def steer_by_lines(vehicle: SteeredVehicle, lines: LineSource) -> None:
    """Fly what lines ask for until they end, one says to land, or the flight ends; then the vehicle lands.

    At the end of the lines it first flies what was asked for. Raises FlightEndedError where a safety rule or the
    operator ended the flight.
    """
    number, waiting = 0, list[_Asked]()
    while True:
        if vehicle.outcome is not None:
            hint = vehicle.outcome.hint or "the record tells what happened"
            raise FlightEndedError(vehicle.outcome.reason, where="flight", hint=hint)
        try:
            line = lines.next(0.0 if waiting else _PATIENCE)
        except EOFError:
            _ask_all(vehicle, waiting)
            vehicle.finish()
            return
        if line is not None and line.text.strip() and not line.text.lstrip().startswith("#"):
            number += 1
            asked = _read(line, number)
            if asked is not None and asked.wish is Wish.EXTEND and len(waiting) < MOST_TOGETHER:
                waiting.append(asked)
                continue
            _ask_all(vehicle, waiting)
            waiting = []
            if asked is not None and asked.wish in (LAND, CUT):
                asked.line.reply(f"{number} accepted: {asked.wish}")
                vehicle.land() if asked.wish == LAND else vehicle.cut()
                return
            waiting = [asked] if asked is not None else []
        if waiting and (line is None or waiting[0].wish is not Wish.EXTEND):
            _ask_all(vehicle, waiting)
            waiting = []


def _read(line: TextLine, number: int) -> _Asked | None:
    try:
        return _Asked(line, number, *parse_line(line.text))
    except InputError as error:
        line.reply(f"{number} refused: {error}")
        return None


def _ask_all(vehicle: SteeredVehicle, asked: list[_Asked]) -> None:
    """Ask for what lines want, together; where that is refused, for each alone, so that each has its answer."""
    if not asked:
        return
    wish = asked[0].wish
    assert isinstance(wish, Wish)
    try:
        answer = vehicle.ask(wish, [point for each in asked for point in each.waypoints])
    except (RequestRefusedError, InputError) as error:
        if len(asked) == 1:
            asked[0].line.reply(f"{asked[0].number} {error.what if 'refused' in error.what else f'refused: {error}'}")
        else:
            for each in asked:
                _ask_all(vehicle, [each])
        return
    for each in asked:
        each.line.reply(f"{each.number} {answer_text(answer)}")


class QueuedLines:
    """Lines that threads read; a LineSource."""

    def __init__(self) -> None:
        self._queue: queue.Queue[TextLine | None] = queue.Queue(_WAITING)

    def next(self, patience: float) -> TextLine | None:
        try:
            line = self._queue.get(timeout=patience) if patience > 0.0 else self._queue.get_nowait()
        except queue.Empty:
            return None
        if line is None:
            raise EOFError
        return line

    def read(self, stream: IO[bytes], reply: Callable[[str], None]) -> None:
        """Take a stream's lines until it ends or breaks."""
        with contextlib.suppress(OSError, ValueError):
            while text := stream.readline(_LONGEST):
                self._queue.put(TextLine(text.decode("utf-8", "replace"), reply))

    def end(self) -> None:
        """Say that no more lines come."""
        self._queue.put(None)


@contextlib.contextmanager
def opened_lines(place: str, reply: Callable[[str], None]) -> Iterator[QueuedLines]:
    """Yield the lines of standard input, `-`, or of clients of a port of this machine, as 127.0.0.1:7777.

    Answers to standard input go to `reply`, those to a client to that client. Raises InputError where the place is
    wrong or its port is taken.
    """
    lines = QueuedLines()
    if place == STANDARD_INPUT:

        def read() -> None:
            lines.read(sys.stdin.buffer, reply)
            lines.end()

        threading.Thread(target=read, name="standard input", daemon=True).start()
        yield lines
        return
    with _listening(place) as server:
        threading.Thread(target=_serve, args=(server, lines), name="waypoint socket", daemon=True).start()
        yield lines


def _listening(place: str) -> socket.socket:
    host, _, port = place.rpartition(":")
    if host.strip("[]") not in LOCAL or not port.isdecimal() or not 0 < int(port) < 1 << 16:
        raise InputError(
            "not a port of this machine", where=printable(place), hint="write - for standard input, or 127.0.0.1:7777"
        )
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        return socket.create_server((host.strip("[]"), int(port)), family=family)
    except OSError as error:
        raise InputError(
            f"cannot be listened on ({error.strerror or error})", where=place, hint="take another port"
        ) from error


def _serve(server: socket.socket, lines: QueuedLines) -> None:
    """Read the lines of one client at a time; another is refused in words. One that vanishes changes nothing."""
    busy = threading.Lock()
    with contextlib.suppress(OSError):  # it was closed
        while True:
            client, _ = server.accept()
            if busy.acquire(blocking=False):
                threading.Thread(target=_attend, args=(client, lines, busy), name="client", daemon=True).start()
            else:
                with contextlib.suppress(OSError), client:
                    client.sendall(b"0 refused: another client steers this flight\n")


def _attend(client: socket.socket, lines: QueuedLines, busy: threading.Lock) -> None:
    def reply(text: str) -> None:
        with contextlib.suppress(OSError):
            client.sendall(f"{text}\n".encode())

    try:
        with client, client.makefile("rb") as stream:
            client.settimeout(None)
            lines.read(stream, reply)
    finally:
        busy.release()
