"""The operator's orders: keys typed in the terminal, and signals."""

import contextlib
import os
import re
import select
import signal
import stat
import sys
import termios
import threading
from collections import deque
from dataclasses import dataclass
from enum import IntEnum
from types import FrameType, TracebackType
from typing import Any

from cfplan.flight.clock import REAL_CLOCK

_ESCAPE_WAIT = 0.03  # s to wait for the rest of an arrow key after its Esc
_LONGEST_BURST = 1 << 16  # bytes per read
_ARROWS = {b"A": "up", b"B": "down", b"C": "right", b"D": "left"}  # by the letter that ends the sequence
_KEY = re.compile(  # an arrow or function key as terminals send it, else a single byte
    rb"\x1b(?:(?:\[[0-9;]*|O)(?P<arrow>[A-D])|\[\[[A-E]|\[[0-?]*[!-/]*[@-Z\\-~]|O[0-9;]*[A-Za-z])|(?P<byte>.)",
    re.DOTALL,
)
_PARTIAL_KEY = re.compile(rb"\x1b(?:\[\[|\[[0-?]*[!-/]*|O[0-9;]*)?\Z")  # an incomplete arrow or function key
_MAX_TYPED = 1000  # keys kept for typed()


class Order(IntEnum):
    """Orders that the pilot obeys in the air."""

    FINISH = 0  # fly what is committed to its end, then land, without waiting for a new plan
    LAND = 1
    CUT = 2


_ORDERS = {b" ": Order.LAND, b"\x1b": Order.CUT}


@dataclass
class HeldOrders:
    """The state of the operator's orders and of the main process; an OrderSource."""

    worst: Order | None = None  # the gravest order so far that ends the flight early
    finishing: bool = False  # the vehicle is to land where its plan ends
    gone: bool = False  # the main process has ended

    def give(self, order: Order) -> None:
        """Take an order; one that is less grave than an earlier one changes nothing."""
        if order is Order.FINISH:
            self.finishing = True
        else:
            self.worst = max(order, self.worst or order)


def orders_of(keys: bytes) -> list[Order]:
    """Return the orders in a burst of typed keys: space lands, Esc cuts.

    Each Esc that does not begin an arrow or function key cuts, also one before another key. Alt with a key sends the
    same bytes, so it cuts too: an unwanted cut is better than a missed one.
    """
    return [_ORDERS[key["byte"]] for key in _KEY.finditer(keys) if key["byte"] in _ORDERS]


def keys_of(keys: bytes) -> list[str]:
    """Return the keys of a burst that are not orders: up, down, left, right, and printable characters except space."""
    names = []
    for key in _KEY.finditer(keys):
        if key["arrow"]:
            names.append(_ARROWS[key["arrow"]])
        elif key["byte"] and b"!" <= key["byte"] <= b"~":
            names.append(key["byte"].decode("ascii"))
    return names


class Keyboard:
    """Collects orders while it is entered; without a terminal, from signals only.

    Keys are read from the terminal that started the program where standard input is a pipe or a file.
    Space lands, Esc cuts; Ctrl-C lands the first time and cuts the second; SIGTERM, SIGHUP and Ctrl-\\ land.
    Ctrl-Z is ignored, and so is Ctrl-S where keys are read: they would stop the program in the air, Ctrl-S at its next
    line of output. If the terminal closes, the vehicle lands too, and further output is dropped.
    """

    def __init__(self, *, keys: bool = True) -> None:
        """Read `keys` too, or leave them to another reader; signals count either way."""
        self._keys = keys
        self._orders: deque[Order] = deque()
        self._typed: deque[str] = deque(maxlen=_MAX_TYPED)
        self._opened: int | None = None  # the program's own terminal, if standard input is something else
        self._interrupts = 0
        self._terminal: tuple[int, list[Any]] | None = None
        self._handlers: dict[int, Any] = {}

    def __enter__(self) -> "Keyboard":
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):
                self._handlers[number] = signal.signal(number, self._on_signal)
            self._handlers[signal.SIGTSTP] = signal.signal(signal.SIGTSTP, signal.SIG_IGN)
        # No terminal, or not in its foreground: signals only.
        with contextlib.suppress(termios.error, OSError, ValueError, AttributeError):
            descriptor = sys.stdin.fileno()
            if self._keys and not os.isatty(descriptor):
                self._opened = descriptor = os.open(os.ctermid(), os.O_RDWR | os.O_NOCTTY)
            if self._keys and os.isatty(descriptor) and os.tcgetpgrp(descriptor) == os.getpgrp():
                self._terminal = descriptor, termios.tcgetattr(descriptor)
                self._read_keys_at_once(descriptor)
        return self

    @staticmethod
    def _read_keys_at_once(descriptor: int) -> None:
        mode = termios.tcgetattr(descriptor)
        mode[0] &= ~(termios.IXON | termios.IXOFF)
        mode[3] &= ~(termios.ICANON | termios.ECHO)
        mode[6][termios.VMIN], mode[6][termios.VTIME] = 0, 0
        mode[6][termios.VSUSP] = b"\x00"
        termios.tcsetattr(descriptor, termios.TCSANOW, mode)  # resumes output that Ctrl-S has stopped

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._terminal is not None:
            with contextlib.suppress(termios.error):  # it has closed
                termios.tcsetattr(self._terminal[0], termios.TCSAFLUSH, self._terminal[1])
            self._terminal = None
        if self._opened is not None:
            os.close(self._opened)
            self._opened = None
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self._handlers.clear()

    def _on_signal(self, number: int, _: FrameType | None) -> None:
        if number == signal.SIGINT:
            self._interrupts += 1
        self._orders.append(Order.CUT if self._interrupts > 1 and number == signal.SIGINT else Order.LAND)

    @property
    def descriptor(self) -> int | None:
        """Return a file descriptor to wait on for keys; None without a terminal, or once it has closed."""
        return self._terminal[0] if self._terminal is not None else None

    def orders(self) -> list[Order]:
        """Return the orders since the last call. Waits up to 30 ms for the rest of an incomplete key."""
        if self._terminal is not None:
            burst = _burst(self._terminal[0])
            self._orders.extend(orders_of(burst))
            self._typed.extend(keys_of(burst))
            if not os.isatty(self._terminal[0]):
                self._terminal = None
                self._orders.append(Order.LAND)
                _drop_output()
        given = list(self._orders)
        self._orders.clear()
        return given

    def typed(self) -> list[str]:
        """Return the keys that orders() has read since the last call and that were not orders; from any thread."""
        keys = []
        while self._typed:
            keys.append(self._typed.popleft())
        return keys


def _burst(terminal: int) -> bytes:
    """Return the typed bytes; wait up to 30 ms for the rest of an incomplete key unless an Esc before it cuts."""
    keys, until = b"", dict[int, float]()  # s, deadline for the rest of a key, by where it begins
    with contextlib.suppress(OSError):  # it has closed
        while len(keys) < _LONGEST_BURST:
            more = os.read(terminal, 4096)
            keys += more
            if more:
                continue
            begun = _PARTIAL_KEY.search(keys)
            if begun is None or Order.CUT in orders_of(keys[: begun.start()]):
                break
            left = until.setdefault(begun.start(), REAL_CLOCK.now() + _ESCAPE_WAIT) - REAL_CLOCK.now()
            if left <= 0.0 or not select.select([terminal], [], [], left)[0]:
                break
    return keys


def _drop_output() -> None:
    """Discard output to a closed terminal, which would otherwise raise and interrupt the landing."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        with contextlib.suppress(OSError):
            if stat.S_ISCHR(os.fstat(stream).st_mode) and not os.isatty(stream):
                os.dup2(nowhere, stream)
    os.close(nowhere)
