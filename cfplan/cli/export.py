"""`cfplan export`: write a certified plan in the formats of other tools."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cfplan.cli import fleet, options
from cfplan.cli.output import Steps, print_json
from cfplan.errors import InputError

if TYPE_CHECKING:
    from cfplan.safety.certificate import Certificate

_FORMS = ("crazyswarm", "memory", "compressed", "samples")


@click.command(
    short_help="Write a certified plan for other tools.",
    epilog="""\b
Examples:
  cfplan export flights/circle.yaml --to crazyswarm -o circle.csv
  cfplan export flights/circle.yaml --to memory -o circle.bin
  cfplan export plan.parquet --to samples -o samples.csv
  cfplan export flights/fleets/two.yaml --to crazyswarm -o two""",
)
@options.path_or_plan
@options.planning
@click.option(
    "--to",
    "form",
    required=True,
    type=click.Choice(_FORMS),
    help="Polynomial CSV; the vehicle's trajectory memory, compressed if necessary or always; or a CSV of states.",
)
@click.option(
    "-o", "--output", required=True, type=click.Path(path_type=Path), help="File to write; a folder for a fleet."
)
@click.option("--plain", is_flag=True, help="Export the plan's motion without corrections for the firmware.")
@click.option(
    "--pieces",
    type=click.IntRange(2, 255),
    help="Maximum number of uncompressed pieces.  [default: 31, as a vehicle holds]",
)
@click.option(
    "--rate", type=options.FiniteRange(1, 1000), default=100.0, show_default=True, help="Rate of samples, Hz."
)
@click.option("--force", is_flag=True, help="Overwrite the output.")
@options.as_json
def export(path_or_plan: Path, safety_file: Path | None, form: str, output: Path, as_json: bool, **rest: Any) -> None:
    """Write a plan for other tools, certified in the form that they read.

    Polynomials stay within 2 cm of the plan and within every limit; if they cannot, the entire flight is slowed down.
    The simulator flies them as the vehicle's own commander would.

    For a fleet file: write one file per vehicle, to be started simultaneously.
    """
    plain, pieces, rate, force = (rest.pop(name) for name in ("plain", "pieces", "rate", "force"))
    steps = Steps(as_json=as_json)
    _check_options(form, pieces)
    if fleet.is_fleet(path_or_plan):
        fleet.check_folder(output, force)
        settings = fleet.ExportSettings(form, output, leads=not plain, pieces=pieces, rate=rate)
        return fleet.export_and_print(path_or_plan, safety_file, rest, settings, steps)
    _check_file(form, output, force)
    limits = options.read_limits(safety_file, path_or_plan, steps)
    with steps.waiting("loading planners"):
        from cfplan.preparation import export_flight
        from cfplan.preparation.plan_flight import plan_flight

    flight, kind = options.flight_options(rest, safety_file, path_or_plan), export_flight.Form(form)
    if kind is export_flight.Form.SAMPLES:
        planned = plan_flight(path_or_plan, limits, flight, steps)
        with steps.step("save") as results:
            count = export_flight.write_samples(planned, rate, output)
            results.append(f"{output}, {count} samples")
        document, certificate = planned.to_dict() | {"samples": count}, planned.certificate
    else:
        planned = export_flight.plan_for_polynomials(path_or_plan, limits, flight, steps)
        most = pieces or export_flight.MOST_PIECES
        exported = export_flight.fit_polynomials(planned, kind, leads=not plain, most=most, on_step=steps)
        with steps.step("save") as results:
            export_flight.write_polynomials(exported, kind, output)
            results.append(str(output))
        document, certificate = exported.to_dict(), exported.on_board.certificate
    _print(document | {"file": str(output)}, certificate, as_json=as_json)


def _print(document: dict[str, Any], certificate: "Certificate", *, as_json: bool) -> None:
    from cfplan.cli.certificate_table import print_certificate

    print_json(document) if as_json else print_certificate(certificate)


def _check_options(form: str, pieces: int | None) -> None:
    """Raise InputError for options that the form does not have, or too many pieces."""
    if form == "samples":
        options.refuse(("plain", "pieces"), "samples are those of the plan, not of polynomials", "leave it out")
    else:
        options.refuse(("rate",), f"{form} has no samples", "leave it out, or choose --to samples")
    if form == "compressed":
        options.refuse(("pieces",), "as many compressed pieces are written as the memory holds", "leave it out")
    if pieces is not None and form != "crazyswarm" and pieces > 31:
        raise InputError("a vehicle's memory holds 31 pieces", where="--pieces", hint="use --to compressed, without it")


def _check_file(form: str, output: Path, force: bool) -> None:
    """Raise InputError, before anything is planned, if the file could not be written."""
    if output.is_dir():
        raise InputError("that is a folder", where=str(output), hint="name a file in it")
    suffix = ".bin" if form in ("memory", "compressed") else ".csv"
    if output.suffix != suffix:
        raise InputError(
            f"{form} is written as {suffix}, not as {output.suffix or 'a file without suffix'}",
            where=str(output), hint=f"name it {output.with_suffix(suffix).name}",
        )  # fmt: skip
    if output.exists() and not force:
        raise InputError("the file already exists", where=str(output), hint="give --force to overwrite it")
    if not output.absolute().parent.is_dir():
        raise InputError("no such folder", where=str(output.parent), hint="make it first")
