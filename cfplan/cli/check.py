"""`cfplan check`: the certificate of a plan or of a path."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import click

from cfplan.cli import fleet, options
from cfplan.cli.output import Steps, print_json, print_table
from cfplan.errors import ExitCode


@click.command(
    short_help="Certify a path, a plan or a record.",
    epilog="""\b
Examples:
  cfplan check flights/circle.yaml
  cfplan check records/<flight>""",
)
@options.path_or_plan
@options.planning
@options.as_json
def check(path_or_plan: Path, safety_file: Path | None, as_json: bool, **planning: Any) -> int:
    """Check every limit along the plan of a path or of a plan file and the setpoint packets that would fly it, and make
    their dry run: the deviation to expect.

    For a fleet file: plan and rehearse each vehicle, and check how near each pair comes.

    For a record's folder: certify again everything that was committed in that flight, under the limits in the record,
    and check that the setpoints sent are those committed. Exit code 4 if a limit is exceeded or a setpoint differs.
    """
    steps = Steps(as_json=as_json)
    if path_or_plan.is_dir():
        unused = "safety_file", *options.PLANNING
        options.refuse(unused, "a record is certified again as it was flown, under its own limits", "leave it out")
        return _check_record(path_or_plan, steps)
    if fleet.is_fleet(path_or_plan):
        fleet.rehearse_and_print(path_or_plan, safety_file, planning, steps)
        return 0
    limits = options.read_limits(safety_file, path_or_plan, steps)
    with steps.waiting("loading planners"):
        from cfplan.cli.certificate_table import print_certificate
        from cfplan.preparation.plan_flight import plan_flight

    planned = plan_flight(path_or_plan, limits, options.flight_options(planning, safety_file, path_or_plan), steps)
    if not as_json:
        print_certificate(planned.plan.certificate)
    if not planned.plan.certificate.passed:
        if as_json:
            print_json(planned.to_dict())
        return int(ExitCode.NOT_CERTIFIED)

    from cfplan.preparation.prepare_flight import encode_flight, rehearse

    rehearsed = rehearse(planned, encode_flight(planned, steps), steps)
    if as_json:
        print_json(planned.to_dict() | {"dry_run": rehearsed.summary()})
    return 0


def _check_record(folder: Path, steps: Steps) -> int:
    with steps.step("record") as results:
        from cfplan.recording.reader import read_record
        from cfplan.steering.recertify import recertify

        record = read_record(folder)
        plans = max(len(record.commitments.time), 1)
        results.append(f"{record.header.name}, {record.duration:.1f} s, {plans} commitment{'s' * (plans > 1)}")
    with steps.waiting("certifying again"):
        checked = recertify(record)
    if steps.as_json:
        certificate = checked.certificate.to_dict() if checked.certificate is not None else None
        print_json({**asdict(replace(checked, certificate=None)), "certificate": certificate})
    else:
        print_table("Certified again", ["", "value"], checked.rows())
    return 0
