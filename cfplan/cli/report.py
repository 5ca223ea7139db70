"""`cfplan report`: write a page about a flight."""

from pathlib import Path

import click

from cfplan.cli import options
from cfplan.cli.output import Steps, print_json


@click.command(
    short_help="Write a page with a flight's figures.",
    epilog="""\b
Examples:
  cfplan report records/20261122-094221-figure8
  cfplan report records/20261122-094221-figure8 records/20261122-101500-figure8 -o comparison.html
  cfplan report records/20261122-094221-figure8 --json""",
)
@click.argument("records", metavar="RECORD...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Page to write.  [default: report.html in the record's folder, or in this one for several records]",
)
@click.option("--force", is_flag=True, help="Overwrite the page.")
@options.as_json
def report(records: tuple[Path, ...], output: Path | None, force: bool, as_json: bool) -> None:
    """Report on a flight's RECORD, or compare several, in one self-contained HTML page.

    With --json the numbers are printed, and a page is written only where -o names one.
    """
    from cfplan.recording.report.report import flight_to_dict, read_flight

    steps = Steps(as_json=as_json)
    flights = []
    for place in records:
        with steps.step("read") as results:
            flights.append(read_flight(place))
            results.append(f"{flights[-1].name}, {flights[-1].record.duration:.1f} s")
            results.extend(flights[-1].notes)
    file = output
    if file is None and not as_json:
        file = flights[0].record.folder / "report.html" if len(flights) == 1 else Path("report.html")
    if file is not None:
        from cfplan.recording.report.page import write_page

        with steps.step("page") as results:
            write_page(flights, file, overwrite=force)
            results.append(f"{file} ({file.stat().st_size / 1e6:.1f} MB)")
    if as_json:
        print_json({"flights": [flight_to_dict(flight) for flight in flights], "page": str(file) if file else None})
