"""The operator's orders, by keys of the terminal and by signals."""

import contextlib
import os
import re
import signal
import sys
import termios
import threading
import time
from collections import deque
from enum import IntEnum
from types import FrameType, TracebackType
from typing import Any

_ESCAPE_WAIT = 0.03  # s in which the rest of an arrow key follows its Esc
_SEQUENCES = re.compile(rb"\x1b[\[O][0-9;]*[A-Za-z~]")


class Order(IntEnum):
    """Orders that the pilot obeys in the air."""

    LAND = 1
    CUT = 2


def orders_of(keys: bytes) -> list[Order]:
    """Return the orders of typed keys: space lands, Esc cuts; arrow keys and the like begin with Esc but do not cut."""
    found = {ord(" "): Order.LAND, 0x1B: Order.CUT}
    return [found[key] for key in _SEQUENCES.sub(b"", keys) if key in found]


class Keyboard:
    """Collects orders while it is entered. Without a terminal only signals give any.

    Space lands, Esc cuts; Ctrl-C lands the first time and cuts the second; SIGTERM and SIGHUP land.
    Ctrl-Z is off: it would stop the program in the air.
    """

    def __init__(self) -> None:
        self._orders: deque[Order] = deque()
        self._interrupts = 0
        self._terminal: tuple[int, list[Any]] | None = None
        self._handlers: dict[int, Any] = {}

    def __enter__(self) -> "Keyboard":
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                self._handlers[number] = signal.signal(number, self._on_signal)
        # No terminal, or not in its foreground: signals alone.
        with contextlib.suppress(termios.error, OSError, ValueError, AttributeError):
            descriptor = sys.stdin.fileno()
            if os.isatty(descriptor) and os.tcgetpgrp(descriptor) == os.getpgrp():
                self._terminal = descriptor, termios.tcgetattr(descriptor)
                self._read_keys_at_once(descriptor)
        return self

    @staticmethod
    def _read_keys_at_once(descriptor: int) -> None:
        mode = termios.tcgetattr(descriptor)
        mode[3] &= ~(termios.ICANON | termios.ECHO)
        mode[6][termios.VMIN], mode[6][termios.VTIME] = 0, 0
        mode[6][termios.VSUSP] = b"\x00"
        termios.tcsetattr(descriptor, termios.TCSADRAIN, mode)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._terminal is not None:
            termios.tcsetattr(self._terminal[0], termios.TCSAFLUSH, self._terminal[1])
            self._terminal = None
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self._handlers.clear()

    def _on_signal(self, number: int, _: FrameType | None) -> None:
        if number == signal.SIGINT:
            self._interrupts += 1
        self._orders.append(Order.CUT if self._interrupts > 1 and number == signal.SIGINT else Order.LAND)

    @property
    def descriptor(self) -> int | None:
        """A file descriptor to wait on for keys; None without a terminal."""
        return self._terminal[0] if self._terminal is not None else None

    def orders(self) -> list[Order]:
        """Return the orders since the last call. Takes 30 ms after an Esc, else does not wait."""
        if self._terminal is not None:
            keys = os.read(self._terminal[0], 64)
            if keys.endswith(b"\x1b"):
                time.sleep(_ESCAPE_WAIT)
                keys += os.read(self._terminal[0], 64)
            self._orders.extend(orders_of(keys))
        given = list(self._orders)
        self._orders.clear()
        return given
