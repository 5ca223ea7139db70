"""Steer by lines of text: one waypoint or word a line, from standard input or a Unix socket.

    1.0 0.0 1.2                   fly on through x y z, m, after what is ahead
    replace 0 -1 1.5  1 1 1       fly through these instead, from the next joint on
    stop | slower | faster | land | cut

Each line is answered by one that begins with its number. Waypoints that wait together are planned together. A line that
cannot be flown, or is invalid, is refused with a reason, and the flight continues unchanged. The lines `land` and `cut`
take effect as soon as they are read, before all waiting lines.
"""

import contextlib
import io
import os
import queue
import select
import socket
import stat
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Protocol

from cfplan.air.requests import Wish
from cfplan.errors import FlightEndedError, InputError, RequestRefusedError, printable
from cfplan.files.text import DECIMAL_COMMA_HINT, may_have_decimal_commas
from cfplan.flight.clock import REAL_CLOCK
from cfplan.flight.pilot.keys import Order
from cfplan.flight.telemetry import Triple
from cfplan.steering.recorded_steering import answer_text
from cfplan.steering.steered_vehicle import SteeredVehicle, checked_waypoints

STANDARD_INPUT = "-"
SOCKET = "unix:"  # before the path of a socket
MAX_BATCH = 20  # waiting waypoints that are planned as one request
MAX_WAITING = 10_000  # lines; more are refused
MAX_LINE_BYTES = 10_000  # bytes of a line
_PATIENCE = 0.1  # s
_ANSWERS_TIMEOUT = 180.0  # s after a client's last line, which may wait for the take-off
_OWNER_ONLY = 0o177  # umask: only the owner may connect
_HINT = "write x y z in metres, as 1.0 0.0 1.2; or replace, stop, slower, faster, land, cut"
_PLACE_HINT = "write - for standard input, or unix:PATH for a socket, as unix:waypoints.sock"
_ENDS = "refused: the flight ends"
_WISHES = {wish.value: wish for wish in Wish}
_ORDERS = {"land": Order.LAND, "cut": Order.CUT}


@dataclass(frozen=True, slots=True)
class TextLine:
    """A line, and where its answer goes."""

    number: int  # from 1 on, of all lines of a flight
    text: str
    reply: Callable[[str], None]

    def answer(self, text: str) -> None:
        """Answer the line."""
        self.reply(f"{self.number} {text}")


class LineSource(Protocol):
    """The lines of a flight."""

    ending: bool  # whether a line has ordered to land or to cut; lines that still wait are then refused

    def next(self, patience: float) -> TextLine | None:
        """Return the next line, waiting for it for `patience`, s; None if there is none. Raises EOFError at the end."""


@dataclass(frozen=True, slots=True)
class _LineRequest:
    """A line's request."""

    line: TextLine
    wish: Wish
    waypoints: tuple[Triple, ...] = ()


def order_of(text: str) -> Order | None:
    """Return the order in a line, None if there is none."""
    return _ORDERS.get(text.strip().lower())


def parse_line(text: str) -> tuple[Wish, tuple[Triple, ...]]:
    """Return the wish and the waypoints of a line that is not an order. Raises InputError if it is not a request."""
    word, rest = [*text.split(maxsplit=1), "", ""][:2]
    wish = _WISHES.get(word.lower())
    if wish is None:
        wish, rest = Wish.EXTEND, text
    if wish not in (Wish.EXTEND, Wish.REPLACE):
        if rest.strip():
            raise InputError(f"{rest.split()[0][:60]!r} after {wish.value!r}", where="line", hint=_HINT)
        return wish, ()
    if may_have_decimal_commas(rest):
        raise InputError(
            f"decimal commas, or two kinds of separators: {rest.strip()[:60]!r}", where="line", hint=DECIMAL_COMMA_HINT
        )
    try:
        numbers = [float(word) for word in rest.replace(",", " ").split()]
    except ValueError:
        raise InputError(f"{text.strip()[:60]!r} is not a waypoint", where="line", hint=_HINT) from None
    if not numbers or len(numbers) % 3:
        raise InputError(f"{len(numbers)} numbers, not three for each waypoint", where="line", hint=_HINT)
    rows = [numbers[at : at + 3] for at in range(0, len(numbers), 3)]
    return wish, checked_waypoints(rows)


def steer_by_lines(vehicle: SteeredVehicle, lines: LineSource) -> None:
    """Fly the requests in lines until the lines end, one orders to land or to cut, or the flight ends; then land.

    At the end of the lines the vehicle first flies all requests. Orders are not given here: their source passes them to
    the pilot. Raises FlightEndedError if a safety rule or the operator's keys ended the flight.
    """
    waiting: list[_LineRequest] = []
    try:
        _ask_until_the_end(vehicle, lines, waiting)
    except FlightEndedError:
        if not lines.ending:
            raise
    finally:
        for each in waiting:
            each.line.answer(_ENDS)
        refuse_rest(lines)
    vehicle.finish()


def _ask_until_the_end(vehicle: SteeredVehicle, lines: LineSource, waiting: list[_LineRequest]) -> None:
    """Make the requests in lines until the lines or the flight end; those that are `waiting` are made together."""
    while not lines.ending:
        if vehicle.outcome is not None:
            hint = vehicle.outcome.hint or "the record tells what happened"
            raise FlightEndedError(vehicle.outcome.reason, where="flight", hint=hint)
        try:
            line = lines.next(0.0 if waiting else _PATIENCE)
        except EOFError:
            _ask_all(vehicle, lines, waiting)
            return
        asked = _read(line) if line is not None else None
        if asked is not None and asked.wish is Wish.EXTEND and len(waiting) < MAX_BATCH:
            waiting.append(asked)
            continue
        try:
            _ask_all(vehicle, lines, waiting)
        finally:  # if the flight has ended meanwhile, it is answered with those that wait
            if asked is not None:
                waiting.append(asked)
        if asked is not None and asked.wish is not Wish.EXTEND:
            _ask_all(vehicle, lines, waiting)


def _read(line: TextLine) -> _LineRequest | None:
    try:
        return _LineRequest(line, *parse_line(line.text))
    except InputError as error:
        line.answer(f"refused: {error}")
        return None


def _ask_all(vehicle: SteeredVehicle, lines: LineSource, asked: list[_LineRequest]) -> None:
    """Make the requests of lines together; if that is refused, one by one, so that each line has its answer.

    Answered lines are removed from the list. After an order no request is made.
    """
    if len(asked) > 1 and not lines.ending:
        with contextlib.suppress(RequestRefusedError, InputError):
            answer = vehicle.ask(asked[0].wish, [point for each in asked for point in each.waypoints])
            for each in asked:
                each.line.answer(answer_text(answer))
            asked.clear()
    while asked and not lines.ending:
        asked[0].line.answer(_answer_alone(vehicle, asked[0]))
        del asked[0]


def _answer_alone(vehicle: SteeredVehicle, asked: _LineRequest) -> str:
    try:
        return answer_text(vehicle.ask(asked.wish, asked.waypoints))
    except (RequestRefusedError, InputError) as error:
        return error.what if "refused" in error.what else f"refused: {error}"


def refuse_rest(lines: LineSource) -> None:
    """Refuse the lines that still wait."""
    with contextlib.suppress(EOFError):
        while (line := lines.next(0.0)) is not None:
            line.answer(_ENDS)


class QueuedLines:
    """Lines that threads read; a LineSource. Orders among them do not wait: `orders` returns them at once."""

    def __init__(self) -> None:
        self._queue: queue.Queue[TextLine | None] = queue.Queue(MAX_WAITING)
        self._orders: deque[Order] = deque()
        self.taken = 0  # lines so far; each is answered once
        self.ending = False

    def next(self, patience: float) -> TextLine | None:
        try:
            line = self._queue.get(timeout=patience) if patience > 0.0 else self._queue.get_nowait()
        except queue.Empty:
            return None
        if line is None:
            raise EOFError
        return line

    def orders(self) -> Iterator[Order]:
        """Yield the orders since the last call; never waits."""
        while self._orders:
            yield self._orders.popleft()

    def take(self, content: bytes, reply: Callable[[str], None], *, fragment: bool = False) -> None:
        """Take a line; empty lines and remarks are skipped, and a fragment is refused unless it is an order."""
        text = content.decode("utf-8", "replace")
        if not text.strip() or text.lstrip().startswith("#"):
            return
        self.taken += 1
        line = TextLine(self.taken, text, reply)
        if (order := order_of(text)) is not None:
            self._orders.append(order)
            self.ending = True
            line.answer(f"accepted: {order.name.lower()}")
            return
        if len(content) >= MAX_LINE_BYTES:
            line.answer(f"refused: longer than {MAX_LINE_BYTES} bytes")
            return
        if fragment:
            line.answer("refused: no newline at its end")
            return
        try:
            self._queue.put_nowait(line)
        except queue.Full:
            line.answer(f"refused: {MAX_WAITING} lines wait already")

    def read(self, stream: IO[bytes], reply: Callable[[str], None], *, fragments: bool) -> None:
        """Take a stream's lines until it ends or breaks; `fragments`: whether the last one may lack its newline."""
        with contextlib.suppress(OSError, ValueError):
            while line := stream.readline(MAX_LINE_BYTES):
                rest = line
                while len(rest) == MAX_LINE_BYTES and not rest.endswith(
                    b"\n"
                ):  # skip the rest of a line that is too long
                    rest = stream.readline(MAX_LINE_BYTES)
                self.take(line, reply, fragment=not fragments and not rest.endswith(b"\n"))

    def end(self) -> None:
        """Mark the end of the lines."""
        self._queue.put(None)


@contextlib.contextmanager
def opened_lines(place: str, reply: Callable[[str], None]) -> Iterator[QueuedLines]:
    """Yield the lines of standard input, `-`, or of clients of a Unix socket, `unix:PATH`.

    Only the socket's owner can connect to it. Answers to standard input go to `reply`, those to a client to that
    client. The caller also passes the `orders` of the lines to the pilot. Raises InputError if the place is wrong or
    taken.
    """
    lines = QueuedLines()
    if place == STANDARD_INPUT:

        def read() -> None:
            try:
                lines.read(_standard_input(), reply, fragments=True)
            finally:
                lines.end()

        threading.Thread(target=read, name="standard input", daemon=True).start()
        yield lines
        return
    path = place.removeprefix(SOCKET)
    if not path or path == place:
        raise InputError("neither standard input nor a socket", where=printable(place), hint=_PLACE_HINT)
    with _listening(Path(path)) as server:
        threading.Thread(target=_serve, args=(server, lines), name="waypoint socket", daemon=True).start()
        yield lines


def _standard_input() -> IO[bytes]:
    """Open standard input again: the interpreter aborts if a thread still reads from `sys.stdin` when it exits."""
    try:
        return open(sys.stdin.fileno(), "rb", closefd=False)
    except io.UnsupportedOperation:  # a program replaced it by a stream without a file
        return sys.stdin.buffer


@contextlib.contextmanager
def _listening(path: Path) -> Iterator[socket.socket]:
    """Yield a socket that listens at a path, to which only its owner can connect; remove it afterwards."""
    with socket.socket(socket.AF_UNIX) as server:
        try:
            made = _bind(server, path)
        except OSError as error:
            raise InputError(
                f"cannot be listened on ({error.strerror or error})",
                where=_shown(path),
                hint="name a short path in a folder of yours",
            ) from error
        try:
            yield server
        finally:
            with contextlib.suppress(OSError):
                server.shutdown(socket.SHUT_RDWR)  # which wakes the thread that waits for clients
            with contextlib.suppress(OSError):
                if os.path.samestat(os.lstat(path), made):
                    os.unlink(path)


def _bind(server: socket.socket, path: Path) -> os.stat_result:
    """Let a socket listen at a path; return the status of that path. Raises InputError or OSError."""
    _remove_left_over(path)
    mask = os.umask(_OWNER_ONLY)
    try:
        server.bind(str(path))
    finally:
        os.umask(mask)
    server.listen()
    return os.lstat(path)


def _shown(path: Path) -> str:
    return printable(f"{SOCKET}{path}")


def _remove_left_over(path: Path) -> None:
    """Remove a socket on which no program listens. Raises InputError if anything else is there, or OSError."""
    try:
        found = os.lstat(path)
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(found.st_mode):
        raise InputError("exists, and is not a socket", where=_shown(path), hint="name another path, or remove that")
    with socket.socket(socket.AF_UNIX) as probe:
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            os.unlink(path)
            return
    raise InputError("another program listens there", where=_shown(path), hint="name another path, or end that program")


def _serve(server: socket.socket, lines: QueuedLines) -> None:
    """Read the lines of one client at a time; another is refused. A client that vanishes changes nothing."""
    busy = threading.Lock()
    while server.fileno() >= 0:
        try:
            client, _ = server.accept()
        except OSError:  # it was closed, or too many files are open for now
            REAL_CLOCK.sleep(_PATIENCE)
            continue
        if busy.acquire(blocking=False):
            threading.Thread(target=_attend, args=(client, lines, busy), name="client", daemon=True).start()
        else:
            with contextlib.suppress(OSError), client:
                client.sendall(b"0 refused: another client steers this flight\n")


def _attend(client: socket.socket, lines: QueuedLines, busy: threading.Lock) -> None:
    """Take a client's lines, then wait until all are answered, unless the client is gone or does not read."""
    hears, answered, before = True, 0, lines.taken
    one_answer = threading.Lock()

    def reply(text: str) -> None:
        """Answer unless the client is gone or does not read its answers; never wait for it."""
        nonlocal hears, answered
        answer = f"{text}\n".encode()
        with one_answer:
            try:
                hears = hears and client.send(answer, socket.MSG_DONTWAIT) == len(answer)
            except OSError:
                hears = False
            answered += 1

    try:
        with client, client.makefile("rb") as stream:
            lines.read(stream, reply, fragments=False)
            gone = select.poll()
            gone.register(client, 0)  # reports a client that has closed its socket, not one that only ended its lines
            until = REAL_CLOCK.now() + _ANSWERS_TIMEOUT
            while hears and answered < lines.taken - before and REAL_CLOCK.now() < until:
                if gone.poll(1000.0 * _PATIENCE):
                    break
    finally:
        busy.release()
