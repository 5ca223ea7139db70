"""Commands on a fleet file: plan, check, rehearse and export all vehicles together."""

import contextlib
import tempfile
from collections.abc import Iterator
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
    _require_file_names(file)
    with steps.waiting("loading planners"):
        from cfplan.preparation import export_fleet, export_flight

    form = export_flight.Form(settings.form)
    fleet = export_fleet.plan_fleet_to_export(file, limits, flight, steps, form=form)
    fitted = None
    if form is not export_flight.Form.SAMPLES:
        most = settings.pieces or export_flight.MOST_PIECES
        fitted = export_fleet.fit_fleet(fleet, export_fleet.export_fit(form, leads=settings.leads, most=most), steps)
        fleet = fitted.fleet
    documents = []
    with steps.step("save") as results, _new_folder(settings.output) as folder:
        for number, (member, planned) in enumerate(zip(fleet.members, fleet.flights, strict=True)):
            written = folder / f"{member.name}{form.suffix}"
            if fitted is None:
                count = export_flight.write_samples(planned, settings.rate, written, member.delay)
                document: dict[str, Any] = {"samples": count}
            else:
                exported = fitted.waiting[number]
                export_flight.write_polynomials(exported, form, written)
                document = exported.to_dict() | {"slowing": fitted.slowing}
            documents.append({"export": document | {"file": str(settings.output / written.name)}})
            results.append(written.name)
    if steps.as_json:
        whole = fleet.to_dict()
        vehicles = [each | more for each, more in zip(whole["vehicles"], documents, strict=True)]
        print_json(whole | {"vehicles": vehicles})
    else:
        _print_tables(fleet)


def _require_file_names(file: Path) -> None:
    """Raise InputError for a vehicle whose name cannot be that of a file."""
    from cfplan.planning.fleet.fleet_file import load_fleet_file

    for vehicle in load_fleet_file(file).vehicles:
        if "/" in vehicle.name or vehicle.name.startswith("."):
            raise InputError(
                f"no file can be named after the vehicle {vehicle.name!r}", where=str(file),
                hint="name it by letters and digits",
            )  # fmt: skip


def check_folder(folder: Path, force: bool) -> None:
    """Raise InputError, before anything is planned, if a fleet could not be written to the folder."""
    if folder.exists() and not folder.is_dir():
        raise InputError("this is a file", where=str(folder), hint="name a folder; it need not exist yet")
    if folder.exists() and not force:
        raise InputError("the folder already exists", where=str(folder), hint="give --force to write into it")
    if not folder.absolute().parent.is_dir():
        raise InputError("no such folder", where=str(folder.parent), hint="make it first")


@contextlib.contextmanager
def _new_folder(folder: Path) -> Iterator[Path]:
    """Yield a folder to write to, whose files come into `folder` once all are written. Raises InputError."""
    try:
        with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.resolve().parent) as unfinished:
            yield Path(unfinished)
            folder.mkdir(exist_ok=True)
            for file in Path(unfinished).iterdir():
                file.replace(folder / file.name)
    except OSError as error:
        raise InputError(
            f"the folder cannot be written ({error.strerror or error})", where=str(folder),
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
