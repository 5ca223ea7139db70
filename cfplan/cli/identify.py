"""`cfplan identify`: estimate the vehicle's parameters from its flights."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from cfplan.cli import options
from cfplan.cli.output import Steps, print_json, print_table
from cfplan.errors import InputError

if TYPE_CHECKING:
    from cfplan.identification.quantities import Identification

AIRFRAME_FILE = Path("airframe.yaml")


@click.command(
    short_help="Estimate mass, thrust, lag, drag and latencies from flights.",
    epilog="""\b
Examples:
  cfplan fly flights/identify.yaml
  cfplan identify records/20261122-101500-identify --mass 0.0331
  cfplan identify records/*identify* --mass 0.0331 -o cf7.yaml""",
)
@click.argument("records", metavar="RECORD...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--mass", type=float, help="Mass with battery, kg; flights only determine the ratios of thrust and drag to it."
)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, dir_okay=False),
    default=AIRFRAME_FILE,
    show_default=True,
    help="Airframe file to write.",
)
@click.option("--force", is_flag=True, help="Overwrite the file.")
@options.as_json
def identify(records: tuple[Path, ...], mass: float | None, output: Path, force: bool, as_json: bool) -> None:
    """Identify the vehicle that flew one or more RECORDs: each figure with its standard uncertainty.

    Writes an airframe file, and prints the lines for safety.yaml.
    """
    from cfplan.identification.airframe_yaml import check_target, safety_lines, write_airframe
    from cfplan.identification.identify import identify as fit
    from cfplan.recording.reader import read_record

    steps, read = Steps(as_json=as_json), []
    check_target(output, overwrite=force)
    if len({place.resolve() for place in records}) < len(records):
        raise InputError("the same record is given twice", where="RECORD", hint="name each record once")
    for place in records:
        with steps.step("read") as results:
            read.append(read_record(place))
            results.append(f"{read[-1].header.name}, {read[-1].duration:.1f} s")
            results.extend(["ends early"] if read[-1].truncated else [])
    with steps.step("fit") as results:
        found = fit(read, mass=mass)
        results.append(f"{1e3 * found.misfit:.2f} mm rms unexplained, over predictions of a second")
    with steps.step("airframe") as results:
        write_airframe(found.airframe, output, overwrite=force)
        results.append(str(output))
    _print(found, output, safety_lines(found, output), as_json)


def _print(found: "Identification", output: Path, lines: str, as_json: bool) -> None:
    if as_json:
        print_json({"airframe": str(output), "safety": lines, **found.to_dict()})
        return
    rows = [quantity.row() for quantity in found.quantities.values()]
    print_table("Identified", ["quantity", "value", "before", "remark"], rows)
    for note in found.notes:
        click.echo(f"- {note}")
    click.echo(f"\nin safety.yaml, beside {output.name}:\n\n{lines}", nl=False)
