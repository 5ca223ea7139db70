"""`cfplan validate`: predict logged flights, and compare with the logs."""

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cfplan.cli import options
from cfplan.cli.output import Steps, print_json, print_table
from cfplan.errors import ExitCode, InputError

if TYPE_CHECKING:
    from cfplan.identification.logged_flight import LoggedFlight
    from cfplan.identification.reference import ReferenceMotion
    from cfplan.identification.validate import Validation
    from cfplan.vehicle.airframe import Airframe

AIRFRAME_FILE = Path("airframe.yaml")
_DEFAULT_VEHICLE = "crazyflie-2.1+"
_OF_LOGS = "gains", "polynomials", "time_scale", "plan", "offset"  # parameters that records do not need


@click.command(
    short_help="Predict logged flights and compare them with the log.",
    epilog="""\b
Examples:
  cfplan validate log.bin --gains gains.yaml --mass 0.0375
  cfplan validate log.bin --gains gains.yaml --polynomials flown.csv --time-scale 0.75
  cfplan validate records/20261122-094221-figure8 --report validation.html""",
)
@click.argument("logs", metavar="LOG...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--gains", type=click.Path(path_type=Path), help="YAML file of the controller's gains; for microSD logs.")
@click.option("--polynomials", type=click.Path(path_type=Path), help="Trajectory flown from the vehicle's memory, CSV.")
@click.option(
    "--time-scale",
    type=options.FiniteRange(0, min_open=True),
    default=1.0,
    show_default=True,
    help="Time scale of the polynomials.",
)
@click.option("--plan", type=click.Path(path_type=Path), help="Plan flown from the vehicle's memory, Parquet.")
@click.option(
    "--offset",
    type=options.FiniteRange(),
    nargs=3,
    help="Place of the trajectory's origin, m, if setpoints are not logged.",
)
@click.option(
    "--mass",
    type=options.FiniteRange(0, min_open=True),
    help="Mass with battery, kg.  [default: that of --vehicle, else the controller's]",
)
@click.option("--vehicle", help="Airframe, by name or file.  [default: the record's, or crazyflie-2.1+]")
@click.option(
    "--from",
    "begin",
    type=options.FiniteRange(0),
    default=0.0,
    show_default=True,
    help="Start of the part to validate, s.",
)
@click.option("--to", "end", type=options.FiniteRange(0), help="End of the part to validate, s.  [default: all]")
@click.option("--report", type=click.Path(path_type=Path, dir_okay=False), help="Page to write, with both curves.")
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, dir_okay=False),
    default=AIRFRAME_FILE,
    show_default=True,
    help="Airframe file to write.",
)
@click.option("--force", is_flag=True, help="Overwrite the files.")
@options.as_json
def validate(
    logs: tuple[Path, ...], output: Path, report: Path | None, force: bool, as_json: bool, **given: Any
) -> None:
    """Recompute the commands of each LOG, a record or a microSD log, measure the vehicle, and predict the flight.

    The prediction holds if rms and largest deviation agree within 20 % and correlate by 0.95; else the exit code is 4.
    """
    from cfplan.identification.airframe_yaml import write_airframe
    from cfplan.identification.measured import pooled
    from cfplan.identification.validate import validate as fly_again
    from cfplan.identification.validation_page import verdict, write_validation_page

    steps = Steps(as_json=as_json)
    _check_options(logs, output, report, force)
    found: list[Validation] = []
    vehicles: list[Airframe] = []
    for place in logs:
        with steps.step("read") as results:
            flight = _read(place, **given)
            vehicles.append(flight.airframe)
            check_same_vehicle(vehicles, place)
            results.append(f"{place.name}, {flight.log.duration:.1f} s, along {flight.reference.source}")
        with steps.step("predict") as results:
            predicted = fly_again(flight.log, flight.reference, flight.controller, flight.airframe, flight.poses)
            found.append(predicted)
            results.append(verdict(predicted))
    with steps.step("airframe") as results:
        kind = found[0].measured.airframe
        write_airframe(
            replace(pooled([each.measured for each in found], kind), source=f"{kind.source}; {len(found)} flights"),
            output, overwrite=force,
        )  # fmt: skip
        results.append(str(output))
    if report is not None:
        with steps.step("page") as results:
            write_validation_page(found, report, overwrite=force)
            results.append(str(report))
    _print(found, output, as_json)
    if not all(each.comparison.passes for each in found):
        raise SystemExit(int(ExitCode.NOT_CERTIFIED))


def _check_options(logs: tuple[Path, ...], output: Path, report: Path | None, force: bool) -> None:
    """Raise InputError, before anything is computed, for options that are not used, or files that exist."""
    from cfplan.files.atomic import check_new_file
    from cfplan.identification.airframe_yaml import check_target

    if all(map(_is_record, logs)):
        options.refuse(_OF_LOGS, "this is for microSD logs: a record holds its controller and its plan", "leave it out")
    if report is not None and report.resolve() == output.resolve():
        raise InputError("that is the airframe's file", where=str(report), hint="another name after --report or -o")
    check_target(output, overwrite=force)
    if report is not None:
        check_new_file(report, overwrite=force)


def check_same_vehicle(vehicles: "list[Airframe]", place: Path) -> None:
    """Raise InputError unless the last flight is by the vehicle of the first one."""
    before, airframe = vehicles[0], vehicles[-1]
    if (airframe.name, airframe.mass) != (before.name, before.mass):
        raise InputError(
            f"{airframe.name} of {1000 * airframe.mass:.1f} g flew, in the first log {before.name} of "
            f"{1000 * before.mass:.1f} g",
            where=str(place), hint="validate each vehicle by itself",
        )  # fmt: skip


def _is_record(place: Path) -> bool:
    return place.is_dir() or place.suffix == ".mcap"


def _read(
    place: Path, *, gains: Path | None, polynomials: Path | None, time_scale: float, plan: Path | None,
    offset: tuple[float, float, float] | None, mass: float | None, vehicle: str | None, begin: float, end: float | None,
) -> "LoggedFlight":  # fmt: skip
    """Return a flight, its reference begun as flown. One parameter per option of the command."""
    from cfplan.identification.flight_log import read_microsd
    from cfplan.identification.gains_file import read_gains
    from cfplan.identification.logged_flight import flight_of_log, flight_of_record
    from cfplan.recording.reader import read_record
    from cfplan.vehicle.airframes import load_airframe

    if end is None:
        end = math.inf
    if end <= begin:
        raise InputError("no part of a flight ends before it begins", where="--to", hint="a time later than --from")
    airframe = load_airframe(vehicle) if vehicle else None
    if _is_record(place):
        flight = flight_of_record(read_record(place), begin, end)
        known = airframe or flight.airframe
        return replace(flight, airframe=replace(known, mass=mass or known.mass))
    if gains is None:
        hint = "write those that flew to a YAML file: --gains FILE"
        raise InputError("its gains are not known", where=str(place), hint=hint)
    controller = read_gains(gains)
    known = airframe or load_airframe(_DEFAULT_VEHICLE)
    weighed = replace(known, mass=mass or (known.mass if airframe else controller.gains.mass))
    log = read_microsd(place).between(begin, end)
    return flight_of_log(log, controller, weighed, _trajectory(polynomials, time_scale, plan), offset)


def _trajectory(polynomials: Path | None, time_scale: float, plan: Path | None) -> "ReferenceMotion | None":
    from cfplan.identification.reference import reference_of_polynomials, reference_of_trajectory
    from cfplan.planning.plan_file import load_plan

    if polynomials is not None and plan is not None:
        raise InputError("both polynomials and a plan", where=str(plan), hint="leave one of them out")
    if polynomials is not None:
        return reference_of_polynomials(polynomials, time_scale)
    return None if plan is None else reference_of_trajectory(load_plan(plan).trajectory, plan.name)


def _print(found: "list[Validation]", output: Path, as_json: bool) -> None:
    from cfplan.identification.validation_page import (
        ABLATION_COLUMNS,
        COMPARISON_COLUMNS,
        ablation_rows,
        comparison_rows,
        measured_rows,
        validation_to_dict,
        verdict,
    )

    if as_json:
        print_json({"airframe": str(output), "flights": [validation_to_dict(each) for each in found]})
        return
    for each in found:
        print_table(each.log.name, list(COMPARISON_COLUMNS), comparison_rows(each.comparison))
        print_table("What each piece explains", list(ABLATION_COLUMNS), ablation_rows(each))
        print_table("The vehicle", ["", ""], measured_rows(each))
        click.echo(f"{each.log.name} {verdict(each)}")
