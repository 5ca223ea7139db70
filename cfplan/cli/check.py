"""`cfplan check`: the certificate of a plan or of a path."""

from pathlib import Path

import click

from cfplan.cli import options
from cfplan.cli.output import Steps, print_json
from cfplan.cli.rehearsal import PlanOptions, certify_bytes, obtain_plan
from cfplan.errors import ExitCode


@click.command(short_help="The certificate of a path or of a plan.", epilog="Example: cfplan check flights/circle.yaml")
@options.path_or_plan
@options.planning
@options.as_json
def check(
    path_or_plan: Path,
    safety_file: Path | None,
    planner: str,
    nodes: int | None,
    speed_factor: float | None,
    as_json: bool,
) -> int:
    """Check every limit along a path's plan, or along a plan file's, and the bytes that would fly it.

    Exit code 4 where a limit is exceeded.
    """
    from cfplan.cli.certificate_table import print_certificate

    steps = Steps(as_json=as_json)
    flight = obtain_plan(path_or_plan, PlanOptions(safety_file, planner, nodes, speed_factor), steps)
    if as_json:
        print_json(flight.to_dict())
    else:
        print_certificate(flight.plan.certificate)
    if not flight.plan.certificate.passed:
        return int(ExitCode.NOT_CERTIFIED)
    certify_bytes(flight, steps)
    return 0
