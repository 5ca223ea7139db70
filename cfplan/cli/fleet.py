"""Commands on a fleet file: plan, check and rehearse all vehicles together."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cfplan.cli import options
from cfplan.cli.output import Steps, print_json, print_table
from cfplan.errors import InputError

if TYPE_CHECKING:
    from cfplan.preparation.plan_fleet import PlannedFleet


def is_fleet(file: Path) -> bool:
    """Return whether a file is a fleet file."""
    from cfplan.planning.fleet.fleet_file import is_fleet_file

    return is_fleet_file(file)


def refuse_flight_options(given: Mapping[str, bool]) -> None:
    """Raise InputError for an option of `fly` that a fleet does not have; `given` says which are given."""
    for name, is_given in given.items():
        if is_given:
            raise InputError(
                f"fleets do not fly with {name} yet",
                where=name,
                hint="leave it out; `uri` and `body` of each vehicle stand in the fleet file",
            )


def refuse_output(output: Path | None) -> None:
    """Raise InputError for a plan file, which holds the plan of one vehicle."""
    if output is not None:
        raise InputError(
            "plan files are not supported for fleets",
            where=str(output),
            hint="omit -o; --json prints starts, ends and distances",
        )


def plan_and_print(
    file: Path, safety_file: Path | None, planning: dict[str, Any], figure: Path | None, force: bool, steps: Steps
) -> None:
    """Plan a fleet, draw it in a figure if one is named, and print all starts and the nearest approach of each pair."""
    fleet = _planned(file, safety_file, planning, steps)
    if figure is not None:
        from cfplan.planning.figure import save_figure
        from cfplan.preparation.fleet_figure import draw_fleet

        with steps.step("figure") as results:
            save_figure(draw_fleet(fleet), figure, overwrite=force)
            results.append(str(figure))
    if steps.as_json:
        print_json(fleet.to_dict())
    else:
        _print_tables(fleet)


def rehearse_and_print(file: Path, safety_file: Path | None, planning: dict[str, Any], steps: Steps) -> None:
    """Plan a fleet, rehearse each vehicle, also with link loss, and print results after those of plan_and_print()."""
    fleet = _planned(file, safety_file, planning, steps)
    with steps.waiting("loading simulator"):
        from cfplan.preparation.plan_fleet import rehearse_fleet

    rehearsed = rehearse_fleet(fleet, steps)
    if steps.as_json:
        print_json(fleet.to_dict() | {"dry_runs": {name: each.summary() for name, each in rehearsed.items()}})
    else:
        _print_tables(fleet)
        rows = [(name, each.reason or "passed", each.expected()) for name, each in rehearsed.items()]
        print_table("Dry runs", ["vehicle", "verdict", "largest deviation"], rows)


def _planned(file: Path, safety_file: Path | None, planning: dict[str, Any], steps: Steps) -> "PlannedFleet":
    limits = options.read_limits(safety_file, file, steps)
    with steps.waiting("loading planners"):
        from cfplan.preparation.plan_fleet import plan_fleet

    return plan_fleet(file, limits, options.flight_options(planning, safety_file, file), steps)


def _print_tables(fleet: "PlannedFleet") -> None:
    print_table("Vehicles", ["vehicle", "starts", "ends", "slower"], fleet.vehicle_rows())
    print_table("Separation: passed", ["pair", "nearest", "allowed", "at", "where, m"], fleet.pair_rows())
    verdict = "passed" if fleet.losses[0].keeps(fleet.lost_keep) else "not passed"
    columns = ["lost", "nearest pair", "distance", "allowed", "lost at", "where, m", "then", "nearer for"]
    print_table(f"Lost vehicles: {verdict}", columns, fleet.loss_rows())
