"""`cfplan check`: the certificate of a plan or of a path."""

from pathlib import Path
from typing import Any

import click

from cfplan.cli import options
from cfplan.cli.output import Steps, print_json
from cfplan.errors import ExitCode
from cfplan.preparation.compiled_calls import Stage


@click.command(short_help="The certificate of a path or of a plan.", epilog="Example: cfplan check flights/circle.yaml")
@options.path_or_plan
@options.planning
@options.as_json
def check(path_or_plan: Path, safety_file: Path | None, as_json: bool, **planning: Any) -> int:
    """Check every limit along a path's plan, or along a plan file's, and the bytes that would fly it.

    Exit code 4 where a limit is exceeded.
    """
    steps = Steps(as_json=as_json)
    limits = options.read_limits(safety_file, path_or_plan, steps, compile_to=Stage.REHEARSAL)
    with steps.waiting("loading planners"):
        from cfplan.cli.certificate_table import print_certificate
        from cfplan.preparation.plan_flight import plan_flight

    planned = plan_flight(path_or_plan, limits, options.flight_options(planning, safety_file, path_or_plan), steps)
    if as_json:
        print_json(planned.to_dict())
    else:
        print_certificate(planned.plan.certificate)
    if not planned.plan.certificate.passed:
        return int(ExitCode.NOT_CERTIFIED)

    from cfplan.preparation.prepare_flight import encode_flight

    encode_flight(planned, steps)
    return 0
