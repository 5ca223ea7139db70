"""`cfplan sim`: the dry run alone."""

from pathlib import Path

import click

from cfplan.cli import options
from cfplan.cli.output import Steps, print_json, print_table
from cfplan.cli.rehearsal import PlanOptions, certify_bytes, obtain_plan, rehearse


@click.command(short_help="The dry run alone.", epilog="Example: cfplan sim flights/slalom.yaml")
@options.path_or_plan
@options.planning
@options.as_json
def sim(
    path_or_plan: Path,
    safety_file: Path | None,
    planner: str,
    nodes: int | None,
    speed_factor: float | None,
    as_json: bool,
) -> None:
    """Rehearse a path or a plan file: its very setpoints, the firmware's controller, a body with drag and motor lag."""
    steps = Steps(as_json=as_json)
    flight = obtain_plan(path_or_plan, PlanOptions(safety_file, planner, nodes, speed_factor), steps)
    encoded = certify_bytes(flight, steps)
    result = rehearse(flight, encoded, steps)
    if as_json:
        print_json(flight.to_dict() | {"dry_run": result.summary()})
    else:
        print_table("Dry run", ["", "value"], result.rows())
