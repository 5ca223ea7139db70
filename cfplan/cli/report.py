"""`cfplan report`: write a page about a flight."""

from pathlib import Path

import click

from cfplan.cli import options
from cfplan.cli.output import Steps, print_json
from cfplan.cli.recorded_fleet import read_fleet


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

    The folder of a fleet's flight makes one page about all vehicles, with the distance of each pair over time.

    With --json the numbers are printed, and a page is written only where -o names one.
    """
    from cfplan.recording.fleet_record import is_fleet_record
    from cfplan.recording.report.report import flight_to_dict, read_flight, reported

    steps = Steps(as_json=as_json)
    flights, fleet = [], None
    if len(records) == 1 and is_fleet_record(records[0]):
        fleet = read_fleet(records[0], steps)
        flights = [reported(record, name) for name, record in fleet.records.items()]
    for place in records if fleet is None else ():
        with steps.step("read") as results:
            flights.append(read_flight(place))
            results.append(f"{flights[-1].name}, {flights[-1].record.duration:.1f} s")
            results.extend(flights[-1].notes)
    file = output
    if file is None and not as_json:
        folder = records[0] if fleet is not None else flights[0].record.folder
        file = folder / "report.html" if len(records) == 1 else Path("report.html")
    if file is not None:
        from cfplan.recording.report.page import write_page

        with steps.step("page") as results:
            write_page(flights, file, fleet=fleet, overwrite=force)
            results.append(f"{file} ({file.stat().st_size / 1e6:.1f} MB)")
    if as_json:
        document = {"flights": [flight_to_dict(flight) for flight in flights], "page": str(file) if file else None}
        print_json(document | ({} if fleet is None else fleet.to_json()))
