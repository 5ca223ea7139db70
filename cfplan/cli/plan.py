"""`cfplan plan`: from a path file to a certified trajectory."""

from pathlib import Path

import click

from cfplan.cli import options
from cfplan.cli.output import Steps, print_json
from cfplan.cli.rehearsal import PlanOptions, obtain_plan
from cfplan.errors import InputError


@click.command(
    short_help="A certified trajectory for a path.", epilog="Example: cfplan plan flights/circle.yaml -o circle.parquet"
)
@options.path_file
@options.planning
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Write the plan here, as Parquet.")
@click.option("--force", is_flag=True, help="Overwrite the output.")
@options.as_json
def plan(
    path_file: Path,
    safety_file: Path | None,
    planner: str,
    nodes: int | None,
    speed_factor: float | None,
    output: Path | None,
    force: bool,
    as_json: bool,
) -> None:
    """Plan the fastest flight along PATH within every limit, and print its certificate."""
    from cfplan.cli.certificate_table import print_certificate

    steps = Steps(as_json=as_json)
    flight = obtain_plan(path_file, PlanOptions(safety_file, planner, nodes, speed_factor), steps)
    if output is not None:
        from cfplan.planning.plan_file import save_plan

        with steps.step("save") as said:
            if output.exists() and not force:
                raise InputError("there is a file already", where=str(output), hint="give --force to overwrite it")
            save_plan(flight.plan, output, {"name": flight.name, "path file": str(path_file)})
            said.append(str(output))
    if as_json:
        print_json(flight.to_dict() | ({"file": str(output)} if output else {}))
    else:
        print_certificate(flight.plan.certificate)
