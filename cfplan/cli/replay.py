"""`cfplan replay`: look at a recorded flight in rerun."""

from pathlib import Path

import click

from cfplan.cli import options
from cfplan.cli.output import Steps, print_json


@click.command(epilog="Example: cfplan replay records/2026-11-21_101500-figure-eight --save flight.rrd")
@click.argument("record", type=click.Path(path_type=Path))
@click.option("--save", type=click.Path(path_type=Path), help="Write a rerun file here instead of opening the viewer.")
@click.option("--force", is_flag=True, help="Overwrite the file.")
@options.as_json
def replay(record: Path, save: Path | None, force: bool, as_json: bool) -> None:
    """Replay a flight's RECORD (its folder, or its flight.mcap) in rerun."""
    from cfplan.recording.reader import read_record
    from cfplan.recording.rerun_view import show, write_rrd
    from cfplan.recording.summary import summarise

    steps = Steps(as_json=as_json)
    with steps.step("read") as said:
        flight = read_record(record)
        said.append(f"{flight.header.name}, {flight.duration:.1f} s, {len(flight.setpoints.time)} setpoints")
        if flight.truncated:
            said.append("truncated: what follows the last whole chunk is lost")
    if save is not None:
        with steps.step("rerun file") as said:
            write_rrd(flight, save, overwrite=force)
            said.append(f"{save} ({save.stat().st_size / 1e6:.1f} MB); open it with: rerun {save}")
    else:
        with steps.step("viewer"):
            show(flight)
    if as_json:
        print_json({"record": str(record), "rrd": str(save) if save else None, **summarise(flight).to_json()})
