"""`cfplan sim`: rehearse a flight in the dry run."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from cfplan.cli import fleet, options
from cfplan.cli.output import Steps, print_json, print_table


@click.command(short_help="Rehearse a flight in the dry run.", epilog="Example: cfplan sim flights/slalom.yaml")
@options.path_or_plan
@options.planning
@options.as_json
def sim(path_or_plan: Path, safety_file: Path | None, as_json: bool, **planning: Any) -> None:
    """Rehearse a path or a plan file: its setpoints on drawn vehicles, by the firmware's filter and controller.

    For a fleet file: plan and certify the fleet, and rehearse each vehicle.
    """
    steps = Steps(as_json=as_json)
    if fleet.is_fleet(path_or_plan):
        return fleet.rehearse_and_print(path_or_plan, safety_file, planning, steps)
    limits = options.read_limits(safety_file, path_or_plan, steps)
    with steps.waiting("loading planners and simulator"):
        from cfplan.preparation.plan_flight import plan_flight
        from cfplan.preparation.prepare_flight import encode_flight, find_link_loss, rehearse

    planned = plan_flight(path_or_plan, limits, options.flight_options(planning, safety_file, path_or_plan), steps)
    encoded = encode_flight(planned, steps)
    rehearsed = rehearse(planned, encoded, steps)
    lost = find_link_loss(encoded, limits, steps, planned.link_loss)
    if as_json:
        print_json(planned.to_dict() | {"dry_run": rehearsed.summary(), "link_loss": asdict(lost)})
    else:
        print_table("Dry run", ["", "value"], [*rehearsed.rows(), ("link loss", str(lost))])
