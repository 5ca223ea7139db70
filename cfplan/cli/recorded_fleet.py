"""Read the record of a fleet for `cfplan replay` and `cfplan report`."""

from pathlib import Path
from typing import TYPE_CHECKING

from cfplan.cli.output import Steps

if TYPE_CHECKING:
    from cfplan.recording.fleet_record import FleetRecord


def read_fleet(folder: Path, steps: Steps) -> "FleetRecord":
    """Read the records of a fleet, and report missing ones and the nearest approach of each pair."""
    from cfplan.recording.fleet_record import read_fleet_record

    with steps.step("read") as results:
        fleet = read_fleet_record(folder)
        results.append(f"{fleet.name}, {len(fleet.records)} vehicles")
        for note in fleet.notes:
            results.warn(note)
    with steps.step("separation") as results:
        results.extend(f"{pair}: {near} at {time}" for pair, near, _, time, _ in fleet.pair_rows())
    return fleet
