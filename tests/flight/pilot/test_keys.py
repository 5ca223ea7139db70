"""Orders from keys and signals, and a terminal that is left as it was found."""

import os
import pty
import select
import signal
import sys
import termios
import textwrap

import pytest
from waiting import until

from cfplan.flight.clock import REAL_CLOCK
from cfplan.flight.pilot.keys import Keyboard, Order, keys_of, orders_of


@pytest.mark.parametrize(
    ("keys", "orders"),
    [
        (b"", []),
        (b" ", [Order.LAND]),
        (b"\x1b", [Order.CUT]),
        (b"x\n", []),
        (b"\x1b[A", []),
        (b"\x1bOP", []),
        (b"\x1b[1;5C", []),
        (b" \x1b", [Order.LAND, Order.CUT]),
        (b"\x1b[A\x1b", [Order.CUT]),
        (b"\x1b\x1b", [Order.CUT, Order.CUT]),
        (b"\x1b\x1bx", [Order.CUT, Order.CUT]),
        (b"\x1bx", [Order.CUT]),
        (b"\x1b\xc3\xa9", [Order.CUT]),
        (b"\x1bO", [Order.CUT]),
        (b"\x1b[", [Order.CUT]),
        (b"\x1b[1;", [Order.CUT]),
        (b"\x1b ", [Order.CUT, Order.LAND]),
        (b"\x1bO ", [Order.CUT, Order.LAND]),
        (b"\x1b\x1b[A", [Order.CUT]),
        (b"\x1bq", [Order.CUT]),
        (b"qqq\x1bqqq", [Order.CUT]),
        (b"\x1b[A\x1b[A\x1b\x1b[A", [Order.CUT]),
        (b"\x1b[24~\x1b[1;5P", []),
        (b"\x1b[[A", []),
        (b"\x1b[A" * 1000, []),
        (b"\x1b[A" * 1000 + b"\x1b", [Order.CUT]),
    ],
)
def test_space_lands_and_esc_cuts_whatever_is_typed_with_it_and_arrows_do_neither(keys, orders):
    assert orders_of(keys) == orders


@pytest.mark.parametrize(
    ("keys", "names"),
    [
        (b"", []),
        (b"\x1b[A\x1b[B\x1b[C\x1b[D", ["up", "down", "right", "left"]),
        (b"\x1bOA\x1b[1;5D", ["up", "left"]),
        (b"wW1;", ["w", "W", "1", ";"]),
        (b"a b\x1b", ["a", "b"]),
        (b"\x1bxa", ["x", "a"]),
        (b"\x1b[15~\x1bOP\x1b[[Aa", ["a"]),
        (b"\r\n\t\x00\xc3\xa9", []),
        (b"\x1b[", ["["]),
    ],
)
def test_other_keys_have_names(keys, names):
    assert keys_of(keys) == names


def test_the_first_interrupt_lands_and_the_second_cuts():
    with Keyboard() as keyboard:
        assert keyboard.orders() == []
        os.kill(os.getpid(), signal.SIGINT)
        assert keyboard.orders() == [Order.LAND]
        os.kill(os.getpid(), signal.SIGINT)
        assert keyboard.orders() == [Order.CUT]


@pytest.mark.parametrize("keys", [True, False])
def test_a_stop_of_the_program_from_the_terminal_is_ignored(keys):
    before = signal.getsignal(signal.SIGTSTP)
    with Keyboard(keys=keys) as keyboard:
        os.kill(os.getpid(), signal.SIGTSTP)
        assert keyboard.orders() == []
    assert signal.getsignal(signal.SIGTSTP) is before


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT])
def test_a_wish_to_end_the_program_lands(number):
    with Keyboard() as keyboard:
        os.kill(os.getpid(), number)
        os.kill(os.getpid(), number)
        assert keyboard.orders() == [Order.LAND, Order.LAND]


def test_signal_handlers_are_given_back_even_after_an_error():
    before = signal.getsignal(signal.SIGINT)

    def fail_inside():
        with Keyboard():
            assert signal.getsignal(signal.SIGINT) is not before
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail_inside()
    assert signal.getsignal(signal.SIGINT) is before


_PROGRAM = """
import sys, termios, time
from cfplan.flight.clock import REAL_CLOCK
from cfplan.flight.pilot.keys import Keyboard
before = termios.tcgetattr(0)
try:
    with Keyboard() as keyboard:
        print("ready", flush=True)
        seen = 0
        while seen < 3:
            for order in keyboard.orders():
                seen += 1
                print(f"{seen}: {order.name}", flush=True)
            time.sleep(0.01)
        raise ZeroDivisionError
except ZeroDivisionError:
    pass
print("restored" if termios.tcgetattr(0) == before else "changed", flush=True)
"""


@pytest.fixture
def typed(monkeypatch):
    """Yield a keyboard, and a function that types bytes on its terminal."""
    ours, theirs = pty.openpty()
    with os.fdopen(theirs) as terminal:
        monkeypatch.setattr("sys.stdin", terminal)
        monkeypatch.setattr("os.tcgetpgrp", lambda _: os.getpgrp())
        with Keyboard() as keyboard:
            yield keyboard, lambda keys: os.write(ours, keys)
        os.close(ours)


def test_a_burst_of_arrow_keys_is_not_torn(typed):
    keyboard, press = typed
    for burst in (b"\x1b[A" * 100, b"x" + b"\x1b[A" * 100, b"xy" + b"\x1b[A" * 100, b"x" * 63):
        press(burst)
        assert keyboard.orders() == []
        assert keyboard.orders() == []
    press(b"\x1b[A" * 100 + b"\x1b")
    assert keyboard.orders() == [Order.CUT]


@pytest.mark.parametrize("torn", [(b"\x1b", b"[A"), (b"\x1b[", b"A"), (b"\x1b[1", b";5A"), (b"\x1b", b"[", b"A")])
def test_an_arrow_key_that_comes_in_pieces_does_not_cut(typed, monkeypatch, torn):
    keyboard, press = typed
    pieces = list(torn)

    def next_piece_comes(*_):
        if not pieces:
            return [], [], []
        press(pieces.pop(0))
        return [0], [], []

    press(pieces.pop(0))
    monkeypatch.setattr("select.select", next_piece_comes)
    assert keyboard.orders() == []
    assert keyboard.typed() == ["up"]


@pytest.mark.parametrize(("first", "held"), [(b"\x1b", b"\x1b"), (b"\x1b[", b"0"), (b"ww\x1bw", b"w")])
def test_esc_cuts_while_a_key_is_held_down(typed, monkeypatch, first, held):
    keyboard, press = typed
    select_now, repeats = select.select, 0

    def key_repeats(sources, *_):
        nonlocal repeats
        repeats += 1
        REAL_CLOCK.sleep(0.01)  # a hundred a second
        press(held)
        return select_now(sources, [], [], 0.1)

    press(first)
    monkeypatch.setattr("select.select", key_repeats)
    assert Order.CUT in keyboard.orders()
    assert repeats < 10


def test_ctrl_s_does_not_stop_the_output(monkeypatch):
    ours, theirs = pty.openpty()
    with os.fdopen(theirs) as terminal:
        monkeypatch.setattr("sys.stdin", terminal)
        monkeypatch.setattr("os.tcgetpgrp", lambda _: os.getpgrp())
        with Keyboard() as keyboard:
            assert not termios.tcgetattr(terminal)[0] & termios.IXON
            os.write(ours, b"\x13")
            assert keyboard.orders() == []
        assert termios.tcgetattr(terminal)[0] & termios.IXON
        os.close(ours)


_LEFT_ALONE = """
import sys, time
from cfplan.flight.clock import REAL_CLOCK
from cfplan.flight.pilot.keys import Keyboard
with Keyboard() as keyboard:
    print("ready", flush=True)
    seen = []
    while not seen or keyboard.descriptor is not None:
        seen += keyboard.orders()
        time.sleep(0.01)
    print("nobody reads this", flush=True)
with open(sys.argv[1], "w") as file:
    print(*sorted({order.name for order in seen}), file=file)
"""


def test_a_terminal_that_closes_lands_and_output_to_it_ends_nothing(tmp_path):
    said = tmp_path / "said"
    child, terminal = pty.fork()
    if child == 0:
        os.execv(sys.executable, [sys.executable, "-c", textwrap.dedent(_LEFT_ALONE), str(said)])
    _read_until(terminal, "ready\r\n")
    os.close(terminal)
    assert os.waitpid(child, 0)[1] == 0
    assert said.read_text() == "LAND\n"


_PIPED = """
import os, sys, time
from cfplan.flight.clock import REAL_CLOCK
from cfplan.flight.pilot.keys import Keyboard
reading, writing = os.pipe()
os.write(writing, b"0 1 2 \\x1b")
os.dup2(reading, 0)
with Keyboard() as keyboard:
    print("ready", flush=True)
    seen, typed = [], []
    while len(seen) < 2:
        seen += keyboard.orders()
        typed += keyboard.typed()
        time.sleep(0.01)
print(*(order.name for order in seen), *typed, os.read(0, 100), flush=True)
"""


def test_where_lines_come_by_a_pipe_keys_are_those_of_the_terminal():
    child, terminal = pty.fork()
    if child == 0:
        os.execv(sys.executable, [sys.executable, "-c", textwrap.dedent(_PIPED)])
    try:
        _read_until(terminal, "ready")
        os.write(terminal, b"\x1b[Aq ")
        os.write(terminal, b"\x1b")
        _read_until(terminal, "LAND CUT up q b'0 1 2 \\x1b'")
    finally:
        os.close(terminal)
        os.waitpid(child, 0)


def _read_until(descriptor: int, text: str) -> str:
    got = ""

    def come() -> bool:
        nonlocal got
        try:
            got += os.read(descriptor, 1024).decode() if select.select([descriptor], [], [], 0)[0] else ""
        except OSError:  # the other end has closed
            return True
        return text in got

    assert until(come)
    assert text in got
    return got


def test_keys_of_a_real_terminal_are_read_and_its_mode_comes_back():
    child, terminal = pty.fork()
    if child == 0:
        os.execv(sys.executable, [sys.executable, "-c", textwrap.dedent(_PROGRAM)])
    try:
        _read_until(terminal, "ready")
        local = termios.tcgetattr(terminal)[3]
        assert not local & termios.ICANON
        assert not local & termios.ECHO
        os.write(terminal, b" ")
        _read_until(terminal, "1: LAND")
        os.write(terminal, b"\x1b[A")
        os.write(terminal, b"\x03")  # Ctrl-C comes as a signal
        _read_until(terminal, "2: LAND")
        os.write(terminal, b"\x1b")
        said = _read_until(terminal, "restored")
        assert "3: CUT" in said
    finally:
        os.close(terminal)
        os.waitpid(child, 0)
