"""Waypoints that come as lines of text: each line is answered, and whatever it holds the flight goes on."""

import socket
from collections.abc import Iterable

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st
from waiting import until

from cfplan.cli import cfplan as command_line
from cfplan.errors import ExitCode, InputError
from cfplan.preparation.air_planner import Wish
from cfplan.steering.steered_vehicle import SteeredVehicle
from cfplan.steering.stepped_steering import SteppedSteering
from cfplan.steering.waypoint_lines import TextLine, opened_lines, parse_line, steer_by_lines


class ListedLines:
    """Lines of a list; `sleep 0.5` lets so many s of the flight pass."""

    def __init__(self, vehicle: SteeredVehicle, lines: Iterable[str]):
        self._vehicle, self._lines = vehicle, list(lines)
        self.answers: list[str] = []

    def next(self, patience: float) -> TextLine | None:
        if not self._lines:
            raise EOFError
        text = self._lines.pop(0)
        if text.startswith("sleep"):
            self._vehicle.sleep(float(text.split()[1]))
            return None
        return TextLine(text, self.answers.append)


def steer(limits, lines: Iterable[str]) -> tuple[SteeredVehicle, list[str]]:
    with SteeredVehicle(SteppedSteering(limits), limits, uri="sim://0") as vehicle:
        vehicle.take_off(0.8)
        source = ListedLines(vehicle, lines)
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
    assert [answer.split()[1] for answer in answers] == ["accepted:"] * 4 + ["accepted:"]
    assert answers[-1] == "5 accepted: land"
    assert vehicle.outcome.exit_code is ExitCode.OK


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
        assert wish in (*Wish, "land", "cut")
        assert np.isfinite(np.array(waypoints)).all()


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


def test_a_second_client_is_refused_and_one_that_vanishes_makes_room():
    port = free_port()
    with opened_lines(f"127.0.0.1:{port}", print) as lines:
        with socket.create_connection(("127.0.0.1", port)) as first:
            first.sendall(b"1 0 1\n\xff\xfe\n")
            line = lines.next(60.0)
            assert line.text == "1 0 1\n"
            line.reply("1 accepted")
            assert first.recv(100) == b"1 accepted\n"
            assert "�" in lines.next(60.0).text
            with socket.create_connection(("127.0.0.1", port)) as second:
                assert b"another client" in second.recv(100)
        line.reply("nobody hears that")

        def another_steers() -> bool:
            with socket.create_connection(("127.0.0.1", port)) as third:
                third.sendall(b"0 1 1\n")
                return lines.next(0.5) is not None

        assert until(another_steers)


@pytest.mark.parametrize("place", ["", "7777", "example.org:7777", "127.0.0.1:0", "127.0.0.1:x", "127.0.0.1:99999"])
def test_a_place_that_is_no_port_of_this_machine_is_refused(place):
    with pytest.raises(InputError, match="port of this machine"), opened_lines(place, print):
        pass


def test_a_port_that_is_taken_is_refused():
    with socket.create_server(("127.0.0.1", 0)) as server:
        place = f"127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(InputError, match="cannot be listened on"), opened_lines(place, print):
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
