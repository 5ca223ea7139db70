"""Waypoints that come as lines of text: each line is answered, and whatever it holds the flight goes on."""

import math
import os
import socket
import stat
import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from subprocess import PIPE

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st
from waiting import until

from cfplan.air.requests import Wish
from cfplan.air.stepped import PlannerFault
from cfplan.cli import cfplan as command_line
from cfplan.errors import ExitCode, FlightEndedError, InputError
from cfplan.flight.pilot.keys import Order
from cfplan.steering.steered_vehicle import SteeredVehicle
from cfplan.steering.stepped_steering import SteppedSteering
from cfplan.steering.waypoint_lines import (
    MAX_LINE_BYTES,
    MAX_WAITING,
    QueuedLines,
    TextLine,
    opened_lines,
    parse_line,
    refuse_rest,
    steer_by_lines,
)


class ListedLines(QueuedLines):
    """Lines of a list; `sleep 0.5` lets 0.5 s of the flight pass."""

    def __init__(self, lines: Iterable[str]):
        super().__init__()
        self._lines = list(lines)
        self.vehicle: SteeredVehicle | None = None
        self.answers: list[str] = []

    def next(self, patience: float) -> TextLine | None:
        if not self._lines:
            raise EOFError
        text = self._lines.pop(0)
        if text.startswith("sleep"):
            self.vehicle.sleep(float(text.split()[1]))
            return None
        self.take(text.encode(), self.answers.append)
        return super().next(0.0)


def steer(limits, lines: Iterable[str]) -> tuple[SteeredVehicle, list[str]]:
    source = ListedLines(lines)
    with SteeredVehicle(SteppedSteering(limits, more_orders=source.orders), limits, uri="sim://0") as vehicle:
        source.vehicle = vehicle
        vehicle.take_off(0.8)
        steer_by_lines(vehicle, source)
    return vehicle, source.answers


def test_waypoints_are_flown_and_the_end_of_the_lines_lands(limits):
    vehicle, answers = steer(limits, ["1 0 1", "0, 1, 1.2", "sleep 0.8", "# a remark", "", "-1 0 1"])
    assert [answer.split()[:2] for answer in answers] == [[str(n), "accepted:"] for n in (1, 2, 3)]
    assert vehicle.outcome.exit_code is ExitCode.OK
    assert np.linalg.norm(np.subtract(vehicle.outcome.end_position[:2], [-1, 0])) < 0.15


def test_what_is_no_line_is_refused_in_words_and_changes_nothing(limits):
    bad = ["hello", "1 2", "nan 0 1", "inf 0 1", "0 0 9", "stop now", "1 0 1 0", "\x00\x1b[2J", "9" * 5000]
    vehicle, answers = steer(limits, ["1 0 1", "sleep 0.3", *bad, "0.5 1 1"])
    assert [answer.split()[1] for answer in answers] == ["accepted:", *["refused:"] * len(bad), "accepted:"]
    assert all("hint" in answer for answer in answers[1:-1])
    assert all(answer.isprintable() for answer in answers)
    assert vehicle.outcome.exit_code is ExitCode.OK
    assert np.linalg.norm(np.subtract(vehicle.outcome.end_position[:2], [0.5, 1])) < 0.15


def test_of_waypoints_that_wait_together_those_outside_are_refused_alone(limits):
    vehicle, answers = steer(limits, ["1 0 1", "0 0 9", "0 1 1.2"])
    assert [answer.split()[1] for answer in answers] == ["accepted:", "refused:", "accepted:"]
    assert np.linalg.norm(np.subtract(vehicle.outcome.end_position[:2], [0, 1])) < 0.15


def test_words_replace_slow_down_stop_and_land(limits):
    lines = ["1.5 2.5 1", "sleep 0.8", "slower", "replace -1 2 1", "sleep 0.5", "stop", "sleep 3", "land", "0 0 1"]
    vehicle, answers = steer(limits, lines)
    assert [answer.split()[1] for answer in answers] == ["accepted:"] * 5 + ["refused:"]
    assert answers[4] == "5 accepted: land"
    assert vehicle.outcome.exit_code in (ExitCode.OK, ExitCode.ENDED_BY_OPERATOR)


class TimedLines(QueuedLines):
    """Lines that come at given times of the flight, s after `begin`."""

    def __init__(self, lines: Iterable[tuple[float, str]]):
        super().__init__()
        self.left = list(lines)
        self.answers: list[str] = []
        self.ordered = math.nan  # s, when the last line was taken
        self.flight: SteppedSteering | None = None
        self._begun = math.inf

    def orders(self) -> Iterator[Order]:
        now = self.flight.clock.now()
        while self.left and now >= self._begun + self.left[0][0]:
            self.ordered = now
            self.take(self.left.pop(0)[1].encode(), self.answers.append)
        return super().orders()

    def next(self, patience: float) -> TextLine | None:
        line = super().next(0.0)
        if line is None:
            self.flight.wait(lambda: False, patience)
        return line

    def begin(self) -> None:
        self._begun = self.flight.clock.now()


@pytest.mark.parametrize(
    ("order", "reason"), [("land", "operator ended"), ("cut", "cut the motors"), (" LAND \r", "operator ended")]
)
@pytest.mark.parametrize("fault", [PlannerFault.KILLED, None])
def test_an_order_waits_for_no_line_before_it(limits, order, reason, fault):
    """Neither while a request waits for a planner that hangs, nor while 30 lines wait behind it."""
    many = [(0.0, f"{0.05 * k} 1 1") for k in range(30)]
    lines = TimedLines([*many, (0.5, "0 2 1"), (1.0, order), (1.0, "0 0 1")])
    flight = lines.flight = SteppedSteering(limits, more_orders=lambda: lines.orders())
    with SteeredVehicle(flight, limits, uri="sim://0") as vehicle:
        vehicle.take_off(0.8)
        flight.planner.fault = fault
        lines.begin()
        flight.wait(lambda: len(lines.left) == 3, 1.0)  # 30 are taken
        steer_by_lines(vehicle, lines)
        assert reason in vehicle.outcome.reason
    truth = flight.lab.truth()
    down = truth.time[truth.position[:, 2] > 0.1].max()
    assert 0.0 < down - lines.ordered < (4.0 if "land" in order.lower() else 0.6)
    numbers = [int(answer.split()[0]) for answer in lines.answers]
    assert sorted(numbers) == list(range(1, 34))
    assert f"32 accepted: {order.strip().lower()}" in lines.answers
    assert "33 refused: the flight ends" in lines.answers


def test_an_order_to_land_during_the_take_off_lands(limits):
    lines = TimedLines([(0.0, "1 0 1"), (0.0, "land")])

    def orders_in_the_climb() -> Iterator[Order]:
        if flight.first_pose()[0][2] > 0.2 and not lines.ending:
            lines.begin()
        return lines.orders()

    flight = lines.flight = SteppedSteering(limits, more_orders=orders_in_the_climb)
    with SteeredVehicle(flight, limits, uri="sim://0") as vehicle:
        with pytest.raises(FlightEndedError, match="operator"):
            vehicle.take_off(0.8)
        assert vehicle.position[2] < 0.05
    assert 0.1 < flight.lab.truth().position[:, 2].max() < 0.7
    refuse_rest(lines)
    assert lines.answers == ["2 accepted: land", "1 refused: the flight ends"]


@pytest.mark.parametrize("line", ["1,1 1,0 1,1", "1,1;1,0;1,1", "1,1\t1,0\t1,1", "replace 0,5 0,5 1", "1 0,5 1"])
def test_decimal_commas_are_refused_in_words(line):
    with pytest.raises(InputError, match="decimal comma") as refused:
        parse_line(line)
    assert "point" in refused.value.hint


@pytest.mark.parametrize("line", ["1 0 1.2", "1,0,1.2", "1, 0, 1.2", " 1 , 0 ,1.2\r\n", "1\t0\t1.2", "+1. -0 1.2e0"])
def test_numbers_are_separated_by_blanks_or_by_commas(line):
    assert parse_line(line) == (Wish.EXTEND, ((1.0, 0.0, 1.2),))


@given(st.text())
def test_any_line_is_a_wish_or_an_error_of_one_line(text):
    refused = ""
    try:
        wish, waypoints = parse_line(text)
    except InputError as error:
        refused = str(error)
    if refused:
        assert "hint" in refused
        assert "\n" not in refused
    else:
        assert wish in Wish
        assert np.isfinite(np.array(waypoints)).all()


LANDS = """
from cfplan.steering.waypoint_lines import opened_lines
with opened_lines("-", print) as lines:
    while not lines.ending:
        lines.next(0.1)
"""


def test_a_program_ends_in_order_though_its_standard_input_is_still_open():
    with subprocess.Popen([sys.executable, "-c", LANDS], stdin=PIPE, stdout=PIPE, stderr=PIPE) as program:
        program.stdin.write(b"land\n")
        program.stdin.flush()
        assert program.wait(120.0) == 0, program.stderr.read()
        assert program.stdout.read() == b"1 accepted: land\n"


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A place for a socket, by a path that is short enough."""
    monkeypatch.chdir(tmp_path)
    return "unix:steer.sock"


def connected() -> socket.socket:
    client = socket.socket(socket.AF_UNIX)
    client.settimeout(60.0)
    client.connect("steer.sock")
    return client


def test_a_second_client_is_refused_and_one_that_vanishes_makes_room(place):
    with opened_lines(place, print) as lines:
        with connected() as first:
            first.sendall(b"1 0 1\n\xff\xfe\n")
            line = lines.next(60.0)
            assert line.text == "1 0 1\n"
            line.answer("accepted")
            assert first.recv(100) == b"1 accepted\n"
            assert "�" in lines.next(60.0).text
            with connected() as second:
                assert b"another client" in second.recv(100)
        line.answer("nobody hears that")

        def another_steers() -> bool:
            with connected() as third, suppress(BrokenPipeError):  # refused, as the first one is still there
                third.sendall(b"0 1 1\n")
                return lines.next(0.5) is not None
            return False

        assert until(another_steers)
    assert not Path("steer.sock").exists()


def test_an_order_is_read_though_nobody_takes_lines_or_reads_answers(place):
    with opened_lines(place, print) as lines, connected() as client:
        client.sendall(b"1 0 1\n" * (MAX_WAITING + 20_000) + b"land\n")
        assert until(lambda: lines.ending)
        assert list(lines.orders()) == [Order.LAND]
        assert client.recv(100).startswith(f"{MAX_WAITING + 1} refused: {MAX_WAITING} lines wait".encode())


def test_a_line_that_is_too_long_is_refused_whole_and_the_next_one_counts(place):
    with opened_lines(place, print) as lines, connected() as client:
        client.sendall(b"replace " + b"1 0 1 " * MAX_LINE_BYTES + b"\n0 1 1\n")
        assert lines.next(60.0).text == "0 1 1\n"
        assert client.recv(100) == f"1 refused: longer than {MAX_LINE_BYTES} bytes\n".encode()


@pytest.mark.parametrize("ends", [socket.socket.close, lambda client: client.shutdown(socket.SHUT_WR)])
def test_the_fragment_of_a_client_that_dies_within_a_line_is_not_flown(place, ends):
    with opened_lines(place, print) as lines, connected() as client:
        client.sendall(b"0 1 1\nreplace 1 0 1.2  0 1 1")
        ends(client)
        assert lines.next(60.0).text == "0 1 1\n"
        assert lines.next(0.5) is None
        if client.fileno() >= 0:
            assert client.recv(100).startswith(b"2 refused: no newline")


def test_an_order_needs_no_newline(place):
    with opened_lines(place, print) as lines, connected() as client:
        client.sendall(b"land")
        client.close()
        assert until(lambda: lines.ending)


def test_a_client_that_ends_its_lines_stays_until_they_are_answered(place):
    with opened_lines(place, print) as lines, connected() as client:
        client.sendall(b"1 0 1\n0 1 1\n")
        client.shutdown(socket.SHUT_WR)
        first, second = lines.next(60.0), lines.next(60.0)
        first.answer("accepted")
        with connected() as another:
            assert b"another client" in another.recv(100)
        second.answer("refused")
        assert client.makefile("rb").read() == b"1 accepted\n2 refused\n"


def test_nobody_else_may_connect_and_no_port_is_open(place):
    before = os.umask(0)
    try:
        with opened_lines(place, print):
            mode = os.lstat("steer.sock").st_mode
    finally:
        assert os.umask(before) == 0
    assert stat.S_ISSOCK(mode)
    assert stat.S_IMODE(mode) == 0o600


def test_a_socket_that_a_killed_program_left_behind_is_replaced(place):
    with socket.socket(socket.AF_UNIX) as left_behind:
        left_behind.bind("steer.sock")
    with opened_lines(place, print) as lines, connected() as client:
        client.sendall(b"1 0 1\n")
        assert lines.next(60.0).text == "1 0 1\n"


def test_a_socket_on_which_another_flight_listens_is_refused_and_stays(place):
    with opened_lines(place, print) as lines:
        with pytest.raises(InputError, match="another program listens"), opened_lines(place, print):
            pass

        def steers() -> bool:
            with connected() as client, suppress(BrokenPipeError):  # refused, as the look is still there
                client.sendall(b"1 0 1\n")
                return lines.next(0.5) is not None
            return False

        assert until(steers)


@pytest.mark.parametrize("make", [Path.touch, Path.mkdir, lambda path: path.symlink_to("nowhere")])
def test_what_is_no_socket_is_refused_and_stays(place, make):
    make(Path("steer.sock"))
    with pytest.raises(InputError, match="not a socket"), opened_lines(place, print):
        pass
    assert os.path.lexists("steer.sock")


@pytest.mark.parametrize("place", ["unix:nowhere/steer.sock", f"unix:{'x' * 200}"])
def test_a_path_where_no_socket_can_be_is_refused(place, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="cannot be listened on"), opened_lines(place, print):
        pass


@pytest.mark.parametrize("place", ["", "7777", "unix:", "127.0.0.1:7777", "[::1]:7777", "0.0.0.0:7777"])
def test_lines_come_from_no_other_place(place):
    """A port of this machine can be reached by each of its users, and by pages in a browser."""
    with pytest.raises(InputError, match="neither standard input nor a socket"), opened_lines(place, print):
        pass


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "neither a path nor waypoints"),
        (["flights/line.yaml", "--waypoints", "-"], "both a path and waypoints"),
        (["--waypoints", "-", "--uri", "radio://0/80/2M/E7E7E7E7E7", "--mocap", "vicon://1.2.3.4/cf1"], "at once"),
    ],
)
def test_the_command_line_refuses_what_makes_no_sense(arguments, words):
    result = CliRunner().invoke(command_line, ["fly", *arguments])
    assert isinstance(result.exception, InputError)
    assert words in str(result.exception)
