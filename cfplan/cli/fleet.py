"""Commands on a fleet file: plan, check, rehearse and export all vehicles together."""

from collections.abc import Mapping
from dataclasses import dataclass
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


@dataclass(frozen=True, slots=True)
class ExportSettings:
    """The form of an export, and where it is written."""

    form: str
    output: Path  # the folder
    leads: bool
    pieces: int | None  # at most, of polynomials
    rate: float  # Hz, of samples


def export_and_print(
    file: Path, safety_file: Path | None, planning: dict[str, Any], settings: ExportSettings, steps: Steps
) -> None:
    """Plan a fleet, write a file per vehicle, and print when each begins and how near each pair comes."""
    limits, flight = options.read_limits(safety_file, file, steps), options.flight_options(planning, safety_file, file)
    with steps.waiting("loading planners"):
        from cfplan.preparation import export_fleet, export_flight

    form, folder = export_flight.Form(settings.form), settings.output
    fleet = export_fleet.plan_fleet_to_export(file, limits, flight, steps, form=form)
    if form is not export_flight.Form.SAMPLES:
        most = settings.pieces or export_flight.MOST_PIECES
        fit = export_fleet.export_fit(form, leads=settings.leads, most=most)
        fitted = export_fleet.fit_fleet(fleet, fit, steps)
        fleet, polynomials = fitted.fleet, fitted.waiting
    documents = []
    with steps.step("save") as results:
        _make_folder(folder)
        for number, member in enumerate(fleet.members):
            written = folder / f"{member.name}{form.suffix}"
            if form is export_flight.Form.SAMPLES:
                count = export_flight.write_samples(fleet.flights[number], settings.rate, written, member.delay)
                documents.append({"file": str(written), "samples": count})
            else:
                export_flight.write_polynomials(polynomials[number], form, written)
                documents.append({"file": str(written)} | polynomials[number].to_dict())
            results.append(str(written))
    if steps.as_json:
        document = fleet.to_dict()
        vehicles = [each | {"export": more} for each, more in zip(document["vehicles"], documents, strict=True)]
        print_json(document | {"vehicles": vehicles})
    else:
        _print_tables(fleet)


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(
            f"the folder cannot be made ({error.strerror or error})", where=str(folder),
            hint="name a folder in one that can be written",
        ) from error  # fmt: skip


def _planned(file: Path, safety_file: Path | None, planning: dict[str, Any], steps: Steps) -> "PlannedFleet":
    limits = options.read_limits(safety_file, file, steps)
    with steps.waiting("loading planners"):
        from cfplan.preparation.plan_fleet import plan_fleet

    return plan_fleet(file, limits, options.flight_options(planning, safety_file, file), steps)


def _print_tables(fleet: "PlannedFleet") -> None:
    print_table("Vehicles", ["vehicle", "starts", "ends", "slower"], fleet.vehicle_rows())
    print_table("Separation: passed", ["pair", "nearest", "allowed", "at", "where, m"], fleet.pair_rows())
    if not fleet.losses:
        return
    verdict = "passed" if fleet.losses[0].keeps(fleet.lost_keep) else "not passed"
    columns = ["lost", "nearest pair", "distance", "allowed", "lost at", "where, m", "then", "nearer for"]
    print_table(f"Lost vehicles: {verdict}", columns, fleet.loss_rows())
