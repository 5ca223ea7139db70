"""`cfplan fly`: plan, certify, rehearse, fly, record."""

import shlex
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cfplan.cli import fleet, options
from cfplan.cli.fly_waypoints import fly_waypoints
from cfplan.cli.output import Steps, print_json, print_table, styled
from cfplan.errors import ExitCode, InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from cfplan.cli.recorded_flight import Prepared, RecordedFlight
    from cfplan.preparation.plan_flight import FlightOptions
    from cfplan.safety.limits import Limits

BUSY = 0.02  # s; setpoints are later than this only if the computer is busy


@click.command(
    short_help="Plan, certify, rehearse, fly and record a path.",
    epilog="""\b
Examples:
  cfplan fly flights/figure8.yaml
  cfplan fly flights/figure8.yaml --speed 0.3
  cfplan fly flights/figure8.yaml --live --mavlink udp:127.0.0.1:14550
  cfplan fly flights/figure8.yaml --on-board
  cfplan fly flights/figure8.yaml --after records/<flight>
  printf '1 0 1\\n0 1 1.2\\n' | cfplan fly --waypoints -

Keys in the air: space lands, Esc cuts the motors; Ctrl-C once lands, twice cuts.""",
)
@options.path_or_plan_or_none
@options.planning
@click.option(
    "--waypoints",
    "lines",
    metavar="-|unix:PATH",
    help="Instead of a path: fly waypoints read in flight, one x y z per line, from standard input (-) or from clients "
    "of a Unix socket, e.g. unix:waypoints.sock.",
)
@click.option(
    "--on-board",
    is_flag=True,
    help="Upload the flight as polynomials for the vehicle's own commander, and stream only poses.",
)
@click.option(
    "--after",
    multiple=True,
    metavar="RECORD",
    type=click.Path(path_type=Path),
    help="Record of an earlier flight of this plan, to correct its repeated deviation; one per flight, in order.",
)
@click.option("--uri", default="sim://0", show_default=True, help="The vehicle; sim:// is the virtual Crazyflie.")
@click.option(
    "--mocap",
    "mocap_uri",
    help="Motion capture system and tracked body, e.g. vicon://192.168.1.2/cf1. sim:// has a virtual Vicon, "
    "vicon://lab/cf1; vicon-sdk://lab/cf1 reads it with Vicon's SDK.",
)
@click.option(
    "--records",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("records"),
    show_default=True,
    help="Folder in which the record's folder is created.",
)
@click.option("--live", is_flag=True, help="Show the flight live in rerun.")
@click.option(
    "--mavlink",
    help="Address of a ground station that watches and may stop the flight, e.g. udp:127.0.0.1:14550.",
)
@click.option("--yes", is_flag=True, help="Do not ask before hardware flies.")
@options.as_json
def fly(
    path_or_plan: Path | None,
    lines: str | None,
    on_board: bool,
    after: tuple[Path, ...],
    safety_file: Path | None,
    uri: str,
    mocap_uri: str | None,
    records: Path,
    live: bool,
    mavlink: str | None,
    yes: bool,
    as_json: bool,
    **planning: Any,
) -> int:
    """Fly along PATH: plan, certify, rehearse, then take off, stream the flight, land, and keep a record."""
    from cfplan.cli.watchers import Watched, check_watchers
    from cfplan.steering.starting_vehicle import StartingVehicle, check_uris, look_at_hardware

    steps, watched = Steps(as_json=as_json), Watched(live, mavlink)
    options.check_place(uri, safety_file, records)
    if path_or_plan is not None and lines is None and fleet.is_fleet(path_or_plan):
        return _fly_fleet(path_or_plan, safety_file, mocap_uri, records, planning, steps, on_board=on_board, yes=yes)
    check_uris(uri, mocap_uri)
    check_watchers(watched)
    if path_or_plan is None or lines is not None:
        place = _source_of_waypoints(path_or_plan, lines, on_board, after)
        return fly_waypoints(place, safety_file, uri, mocap_uri, records, watched, yes=yes, as_json=as_json)
    limits = options.read_limits(safety_file, path_or_plan, steps, compiled=True)
    look_at_hardware(uri, mocap_uri, limits.pose, steps)
    with StartingVehicle(uri, mocap_uri, limits) as vehicle:  # it starts while the flight is prepared
        with steps.waiting("loading planners and simulator"):
            from cfplan.cli.confirm import confirmed
            from cfplan.cli.recorded_flight import fly_and_record
        flight_options = options.flight_options(planning, safety_file, path_or_plan)
        flight = _preparation(on_board, after, uri)(path_or_plan, limits, flight_options, steps)
        if not confirmed({uri: flight}, flight.planned.name, records, yes=yes):
            return int(ExitCode.ENDED_BY_OPERATOR)
        flown = fly_and_record(flight, path_or_plan, records, vehicle, watched, steps)
    return _print_result(flight, flown, as_json)


def _fly_fleet(
    file: Path, safety_file: Path | None, mocap: str | None, records: Path, planning: dict[str, Any], steps: Steps,
    *, on_board: bool, yes: bool,
) -> int:  # fmt: skip
    """Fly a fleet file. Raises InputError for options that a fleet does not have."""
    hint = "leave it out; `uri` and `body` of each vehicle stand in the fleet file"
    options.refuse(("uri", "after", "live", "mavlink"), "fleets do not fly with this option yet", hint)
    with steps.waiting("loading planners and simulator"):
        from cfplan.cli.fleet_flight import fly_fleet
    return fly_fleet(file, safety_file, mocap, records, planning, steps, on_board=on_board, yes=yes)


def _preparation(on_board: bool, after: tuple[Path, ...], uri: str) -> "Callable[..., Prepared]":
    """Return the function that prepares a flight: streamed or on board, the first of its plan or one after others.

    Raises InputError if an option requires a new plan with --after.
    """
    from cfplan.preparation.on_board_flight import prepare_on_board_flight
    from cfplan.preparation.prepare_flight import prepare_flight

    prepare: Callable[..., Prepared] = prepare_on_board_flight if on_board else prepare_flight
    if not after:
        return prepare
    options.refuse(options.NEW_PLAN, "--after flies the plan of the records", "leave one of them out")
    return partial(_prepare_again, prepare, after, on_board=on_board, uri=uri)


def _prepare_again(
    prepare: "Callable[..., Prepared]", after: tuple[Path, ...], path_or_plan: Path, limits: "Limits",
    flight_options: "FlightOptions", steps: Steps, *, on_board: bool, uri: str,
) -> "Prepared":  # fmt: skip
    """Prepare the plan of earlier flights, corrected by what repeated in them."""
    from cfplan.identification.earlier_flights import earlier_flights, learn_correction

    with steps.step("records") as results:
        earlier = earlier_flights(after, path_or_plan, limits, on_board=on_board)
        learned = learn_correction(earlier.flights)
        results.append(learned.describe())
        if earlier.uri != uri:
            results.warn(f"flown by {earlier.uri}, not {uri}: another vehicle deviates differently")
    prepared = prepare(earlier.plan_file, limits, replace(flight_options, correction=learned.correction), steps)
    return replace(prepared, planned=replace(prepared.planned, name=earlier.name))


def _source_of_waypoints(path_or_plan: Path | None, lines: str | None, on_board: bool, after: tuple[Path, ...]) -> str:
    """Return the source of waypoints. Raises InputError unless it is the only source of the path."""
    if after and lines is not None:
        raise InputError(
            "waypoints received in flight make a new plan", where="--after", hint="name the path of the records"
        )
    if on_board and lines is not None:
        raise InputError(
            "waypoints that come in the air are streamed", where="--on-board", hint="name a path, or leave it out"
        )
    if lines is None or path_or_plan is not None:
        raise InputError(
            "neither a path nor waypoints" if lines is None else "both a path and waypoints",
            where=str(path_or_plan or "cfplan fly"),
            hint="name a path file, or --example figure8, or give --waypoints -",
        )
    hint = "leave it out; to fly slower, lower `speed` of `plan` in safety.yaml"
    options.refuse(options.PLANNING, "waypoints received in flight are planned without this option", hint)
    return lines


def _print_result(prepared: "Prepared", flown: "RecordedFlight", as_json: bool) -> int:
    """Print how a flight went, and return its exit code."""
    outcome, summary, folder = flown.outcome, flown.summary, str(flown.record.folder)
    if as_json:
        document = {"record": folder, "plan": prepared.planned.to_dict(), **summary}
        program = prepared.mission.on_board
        print_json(document | _expected(prepared) | {"on_board": program is not None})
    else:
        if outcome.checks and outcome.exit_code == ExitCode.PREFLIGHT:
            columns = ["check", "value", "must be", "verdict", "hint"]
            print_table("Preflight", columns, outcome.check_rows())
        print_table("Flight", ["", "value"], _rows(prepared, flown))
        click.echo(f"record: {folder}")
        click.echo(f"replay: cfplan replay {shlex.quote(folder)}")
        click.echo(f"report: cfplan report {shlex.quote(folder)}")
        if summary["deviation_grows_with_speed"]:
            click.echo("the deviation grows with speed: fly flights/identify.yaml, then `cfplan identify` its record")
    hint = why_late(outcome.exit_code, summary) or outcome.hint
    reason = f"{outcome.reason} (hint: {hint})" if hint else outcome.reason
    if outcome.exit_code is ExitCode.ENDED_BY_OPERATOR:  # as requested: not an error
        click.echo(f"{styled('ended:', 'yellow')} {reason}", err=True)
    elif outcome.exit_code is not ExitCode.OK:
        click.echo(f"{styled('error:', 'red')} {reason}", err=True)
    return int(outcome.exit_code)


def _expected(prepared: "Prepared") -> dict[str, float]:
    """Return the largest deviation that the dry run led to expect, m."""
    run = prepared.dry_run
    return {"dry_run_deviation_median": run.deviation_median, "dry_run_deviation_95": run.deviation}


def why_late(exit_code: ExitCode, summary: dict[str, Any]) -> str:
    """Return the hint that the computer was busy, if a safety rule ended the flight and setpoints were late."""
    late = summary["lateness_max"]
    if exit_code is not ExitCode.ENDED_BY_SAFETY or late is None or late < BUSY:
        return ""
    return (
        f"setpoints were sent up to {1e3 * late:.0f} ms late: this computer was busy, which may be the cause; "
        "run nothing else on it"
    )


def _rows(prepared: "Prepared", flown: "RecordedFlight") -> list[tuple[str, str]]:
    """Return rows with the verdicts of preflight and dry run, and the figures that `cfplan report` shows too."""
    from cfplan.recording.summary import summarise, summary_rows

    outcome, program = flown.outcome, prepared.mission.on_board
    return [
        ("ended", outcome.reason),
        *([("flown on board", f"{program.pieces} pieces, {len(program.memory)} bytes")] if program else []),
        ("preflight", f"{sum(check.passed for check in outcome.checks)} of {len(outcome.checks)} checks passed"),
        ("largest deviation, dry run", prepared.dry_run.expected()),
        *summary_rows(summarise(flown.record), flown.record.header.plan_limits),
    ]
