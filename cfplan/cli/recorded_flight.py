"""Fly and record a prepared flight, shown on the terminal, in a live view and in a ground station."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from cfplan.cli.flight_progress import FlightProgress
from cfplan.cli.output import Steps
from cfplan.cli.watchers import Watched, watchers
from cfplan.errors import CfplanError
from cfplan.flight.mocap.poses import PoseSource
from cfplan.flight.pilot.keys import Keyboard
from cfplan.flight.pilot.outcome import FlightOutcome
from cfplan.flight.pilot.process import fly
from cfplan.flight.telemetry import Telemetry
from cfplan.identification.advice import suggests_identification
from cfplan.planning.plan_file import save_plan
from cfplan.preparation.on_board_flight import PreparedOnBoard
from cfplan.preparation.prepare_flight import PreparedFlight
from cfplan.recording.header import FLOWN, header_of_plan
from cfplan.recording.reader import read_record
from cfplan.recording.record import PLAN_FILE, UNCORRECTED_FILE, Record
from cfplan.recording.summary import summarise
from cfplan.recording.writer import RecordWriter, new_record_folder, wall_time_at_zero, write_summary
from cfplan.steering.starting_vehicle import StartingVehicle

Prepared = PreparedFlight | PreparedOnBoard


class RecordedFlight(NamedTuple):
    """A completed flight with its record."""

    outcome: FlightOutcome
    record: Record
    summary: dict[str, Any]  # as written to the record's folder


def fly_and_record(
    prepared: Prepared, source: Path, records: Path, vehicle: StartingVehicle, watched: Watched, steps: Steps
) -> RecordedFlight:
    """Fly, and return the outcome, the record and its summary. Without a flight, the folder is removed.

    Raises a CfplanError if the vehicle or its poses are not available.
    """
    pose_source = vehicle.poses(steps)
    folder = new_record_folder(records, prepared.planned.name)
    progress = FlightProgress(duration=prepared.mission.duration, steps=steps)
    with Keyboard() as keyboard:  # until the summary is written: Ctrl-C during landing must not end the program
        try:
            outcome, failures = _fly_into(
                folder, prepared, source, vehicle, watched, poses=pose_source, progress=progress, keyboard=keyboard
            )
        except CfplanError:
            if progress.heard_vehicle:
                steps.print(f"record of the incomplete flight: {folder}")
            else:
                shutil.rmtree(folder)  # there was no flight
            raise
        for what, failure in failures:
            steps.failed(what, failure)
        with steps.waiting("measuring the flight"):
            record = read_record(folder)
            summary = {"uri": vehicle.uri, "outcome": outcome.to_dict(), **summarise(record).to_json()}
            summary["deviation_grows_with_speed"] = suggests_identification(record)
            try:
                write_summary(folder, summary)
            except OSError as error:  # the vehicle has landed all the same
                steps.failed("summary", str(error))
    return RecordedFlight(outcome, record, summary)


def _fly_into(
    folder: Path,
    prepared: Prepared,
    source: Path,
    vehicle: StartingVehicle,
    watched: Watched,
    *,
    poses: PoseSource,
    progress: FlightProgress,
    keyboard: Keyboard,
) -> tuple[FlightOutcome, list[tuple[str, str]]]:
    """Fly, and return the outcome and the failures of record or watchers: (which, reason)."""
    name, uri = prepared.planned.name, vehicle.uri
    uncorrected, provenance = prepared.planned.uncorrected, {"name": name, "path file": str(source)}
    save_plan(prepared.plan, folder / PLAN_FILE, provenance)
    if uncorrected is not None:
        save_plan(uncorrected, folder / UNCORRECTED_FILE, provenance)
    header = header_of_plan(
        prepared.plan, name=name, uri=uri, source=source, wall_time_at_zero=wall_time_at_zero(), uncorrected=uncorrected
    )
    if prepared.mission.on_board is not None:
        header = replace(header, provenance={**header.provenance, FLOWN: "on board"})
    with (
        RecordWriter(folder, header) as writer,
        watchers(header, folder, watched) as watching,
        progress,
    ):
        outcome = fly(
            prepared.mission,
            uri=uri,
            pose_source=poses,
            pilot=vehicle.pilot,
            on_telemetry=_for_all(writer.write, progress.show, *watching.listeners),
            more_orders=watching.orders,
            keyboard=keyboard,
        )
    failures = [("record", writer.failure)] if writer.failure else []
    return outcome, failures + [("watching", failure) for failure in watching.failures()]


def _for_all(*listeners: Callable[[Telemetry], None]) -> Callable[[Telemetry], None]:
    """Return a listener that passes each message to all `listeners`."""

    def tell(message: Telemetry) -> None:
        for listener in listeners:
            listener(message)

    return tell
