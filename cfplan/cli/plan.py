"""`cfplan plan`: plan a certified trajectory for a path file."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cfplan.cli import fleet, options
from cfplan.cli.output import Steps, print_json
from cfplan.errors import InputError
from cfplan.numbers import shown

if TYPE_CHECKING:
    from cfplan.preparation.plan_flight import PlannedFlight


@click.command(
    short_help="Plan a certified trajectory for a path.",
    epilog="""\b
Examples:
  cfplan plan flights/circle.yaml -o circle.parquet
  cfplan plan flights/fleets/two.yaml --figure fleet.png""",
)
@options.path_file
@options.planning
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Plan file to write, Parquet.")
@click.option("--figure", type=click.Path(path_type=Path), help="Figure of the plan to write: .png, .pdf or .svg.")
@click.option("--force", is_flag=True, help="Overwrite the files.")
@options.as_json
def plan(
    path_file: Path,
    safety_file: Path | None,
    output: Path | None,
    figure: Path | None,
    force: bool,
    as_json: bool,
    **planning: Any,
) -> None:
    """Plan the fastest flight along PATH within every limit, and print its certificate.

    For a fleet file: plan each vehicle, let them start later or fly slower where they would come too near, and print
    how near each pair comes.
    """
    steps = Steps(as_json=as_json)
    _check_files(output, figure, force)
    if fleet.is_fleet(path_file):
        fleet.refuse_output(output)
        return fleet.plan_and_print(path_file, safety_file, planning, figure, force, steps)
    limits = options.read_limits(safety_file, path_file, steps)
    with steps.waiting("loading planners"):
        from cfplan.cli.certificate_table import print_certificate
        from cfplan.preparation.plan_flight import plan_flight

    flight = options.flight_options(planning, safety_file, path_file)
    planned = plan_flight(path_file, limits, flight, steps)
    bounds = _bounds(planned, steps)
    if output is not None:
        with steps.step("save") as results:
            planned.save(output, {"path file": str(path_file)})
            results.append(str(output))
    if figure is not None:
        with steps.step("figure") as results:
            planned.save_figure(figure, overwrite=force)
            results.append(str(figure))
    if as_json:
        print_json(planned.to_dict() | bounds | ({"file": str(output)} if output else {}))
    else:
        print_certificate(planned.plan.certificate)


def _bounds(planned: "PlannedFlight", steps: Steps) -> dict[str, float | None]:
    """Return the bounds on the flight's duration, s, for JSON, and report how it compares with each as a step."""
    duration, speed_factor = planned.duration, planned.plan.speed_factor
    with steps.step("bound") as results:
        along_path = planned.lower_bound()
        results.append(_compared(duration, along_path, speed_factor, "no flight along it"))
    point_mass = None
    if planned.fastest:
        with steps.step("point mass") as results:
            point_mass = planned.point_mass_bound()
            if point_mass is None:
                results.append("not computed")
            else:
                results.append(_compared(duration, point_mass, speed_factor, "no vehicle"))
    return {"lower_bound": along_path, "point_mass_bound": point_mass}


def _compared(duration: float, bound: float, speed_factor: float, who: str) -> str:
    """Return one line that compares a flight's duration with a bound at the same speed factor, s."""
    at_speed = f" at {speed_factor:g} of full speed" if speed_factor < 1.0 else ""
    return f"{shown(100 * (duration / bound - 1.0), '.1f')} % above {bound:.2f} s, which {who}{at_speed} beats"


def _check_files(output: Path | None, figure: Path | None, force: bool) -> None:
    """Raise InputError, before anything is planned, if a file could not be written or the plan not be read again."""
    if figure is not None:
        from cfplan.planning.figure import check_figure_file

        check_figure_file(figure, overwrite=force)
    if output is None:
        return
    from cfplan.files.suffixes import PLAN_SUFFIX

    if output.suffix != PLAN_SUFFIX:
        raise InputError(
            f"plans are written as Parquet, not as {output.suffix or 'a file without suffix'}",
            where=str(output),
            hint=f"name it {output.with_suffix(PLAN_SUFFIX).name}",
        )
    if output.exists() and not force:
        raise InputError("the file already exists", where=str(output), hint="give --force to overwrite it")
    if not output.absolute().parent.is_dir():
        raise InputError("no such folder", where=str(output.parent), hint="make it first")
