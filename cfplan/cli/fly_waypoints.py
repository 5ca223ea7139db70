"""`cfplan fly --waypoints`: read the path line by line while the vehicle flies."""

import sys
from contextlib import ExitStack, suppress
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cfplan.cli import options
from cfplan.cli.output import Steps, print_json, print_table, styled
from cfplan.errors import CfplanError, ExitCode, FlightEndedError, InputError
from cfplan.steering.starting_vehicle import SIMULATED

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cfplan.cli.watchers import Watched, Watching
    from cfplan.flight.pilot.keys import Order
    from cfplan.steering.recorded_steering import SteeringRecord
    from cfplan.steering.steered_vehicle import SteeredVehicle

NAME = "waypoints"  # of the flight, in its record


class _Watchers:
    """The live view and the ground station of a flight, opened together with its record."""

    def __init__(self, watched: "Watched", stack: ExitStack):
        self._watched, self._stack = watched, stack
        self._watching: Watching | None = None

    def open(self, record: "SteeringRecord") -> None:
        from cfplan.cli.watchers import watchers

        self._watching = self._stack.enter_context(watchers(record.header, record.folder, self._watched))
        record.listeners.extend(self._watching.listeners)

    def orders(self) -> "Sequence[Order]":
        return self._watching.orders() if self._watching is not None else ()


def fly_waypoints(
    place: str,
    safety_file: Path | None,
    uri: str,
    mocap_uri: str | None,
    records: Path,
    watched: "Watched",
    *,
    yes: bool,
    as_json: bool,
) -> int:
    """Take off, fly the requests in lines of standard input or of a Unix socket, land, and return the exit code."""
    steps = Steps(as_json=as_json)
    if not yes and not uri.startswith(SIMULATED):
        raise InputError("hardware takes off at once", where=uri, hint="--yes, once the room is clear of people")
    limits = options.read_limits(safety_file, Path.cwd(), steps, compiled=True)
    with steps.waiting("loading planners and simulator"):
        from cfplan.steering.connect import connect
        from cfplan.steering.waypoint_lines import STANDARD_INPUT, opened_lines, refuse_rest, steer_by_lines
    answers: list[str] = []
    typed = place == STANDARD_INPUT and sys.stdin.isatty()  # lines are typed, so single keys are not read

    def reply(text: str) -> None:
        answers.append(text)
        steps.print(text)

    with ExitStack() as stack:
        lines, watchers = stack.enter_context(opened_lines(place, reply)), _Watchers(watched, stack)
        vehicle = connect(
            uri, mocap=mocap_uri, safety=limits, records=records, name=NAME, keys=not typed,
            on_step=steps, on_record=watchers.open, more_orders=lambda: chain(lines.orders(), watchers.orders()),
        )  # fmt: skip
        stack.callback(refuse_rest, lines)
        with suppress(FlightEndedError), vehicle:  # the outcome has the reason
            vehicle.take_off()
            steps.print("in the air: one waypoint a line, as 1.0 0.0 1.2; land lands")
            steer_by_lines(vehicle, lines)
    return _print_result(vehicle, answers, as_json)


def _print_result(vehicle: "SteeredVehicle", answers: list[str], as_json: bool) -> int:
    outcome = vehicle.outcome
    if outcome is None:
        raise CfplanError("there was no flight", where="flight", hint="see the lines above")
    if as_json:
        print_json({"record": str(vehicle.record), "answers": answers, **vehicle.summary})
    else:
        print_table("Flight", ["", "value"], [("ended", outcome.reason), *_rows(vehicle)])
        click.echo(f"record: {vehicle.record}")
    if outcome.exit_code not in (ExitCode.OK, ExitCode.ENDED_BY_OPERATOR):
        click.echo(f"{styled('error:', 'red')} {outcome.reason}", err=True)
    return int(outcome.exit_code)


def _rows(vehicle: "SteeredVehicle") -> list[tuple[str, Any]]:
    from cfplan.recording.reader import read_record
    from cfplan.recording.summary import summarise, summary_rows

    assert vehicle.record is not None
    record = read_record(vehicle.record)
    return list(summary_rows(summarise(record), record.header.plan_limits))
