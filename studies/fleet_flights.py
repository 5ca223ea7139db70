"""Fly each FLEET in real time on virtual vehicles in one room, as `cfplan fly` does, and measure how together they are.

Every second flight is ended by an order to land at a moment drawn by its seed, so that all vehicles brake; the others
fly to their ends.
"""

import math
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cfplan import connect_fleet
from cfplan.errors import CfplanError, ExitCode
from cfplan.flight.pilot.outcome import FlightOutcome
from cfplan.flight.telemetry import Phase
from cfplan.planning.fleet.fleet_file import load_fleet_file
from cfplan.recording.fleet_record import FleetRecord, read_fleet_record
from cfplan.recording.record import Record
from cfplan.recording.summary import summarise
from cfplan.steering.connected_fleet import ConnectedFleet
from studies.runner.limits import limits_for
from studies.runner.options import argument, option
from studies.runner.reductions import count, largest, mean, smallest
from studies.runner.result import Column, Table, table
from studies.runner.study import Run, Study, Work


@dataclass(frozen=True, slots=True)
class Settings:
    """The fleets, and how often each flies."""

    fleet_files: tuple[Path, ...] = argument()
    flights: int = option(20, "Flights of each fleet.", least=1)
    seed: int = option(0, "Seed of the moments at which vehicles are stopped.", least=0)


@dataclass(frozen=True, slots=True)
class RealTimeFleetFlight:
    """One flight of a fleet; NaN where nothing was measured."""

    fleet: str
    vehicles: int
    number: int
    stopped: bool  # by an order
    landed: bool = False  # all, as meant
    reason: str = ""  # why not; else why all braked
    start_late: float = math.nan  # s after its time that the last one began
    start_skew: float = math.nan  # s, between the first one and the last one, each after its own time
    stop_skew: float = math.nan  # s, between the first setpoints of their stops
    deviation: float = math.nan  # m, of any vehicle from the reference in time, by the poses
    late_p99: float = math.nan  # s, of the setpoints of the vehicle whose are latest
    late_max: float = math.nan  # s
    nearest: float = math.nan  # m, of two vehicles in the air, by the poses


COLUMNS = (
    Column("fleet", "fleet"),
    Column("vehicles", "vehicles", "", "d"),
    Column("flights", "flights", value=count()),
    Column("landed", "landed", of="flights", meaning="all vehicles, at their ends or after the order to stop",
           value=count("landed")),
    Column("start_late", "start late, max", "ms", ".0f", meaning="of the last vehicle, after its own time",
           value=largest("start_late")),
    Column("start_skew", "start skew, max", "ms", ".0f", meaning="between the first vehicle and the last, each after "
           "its own time", value=largest("start_skew")),
    Column("stops", "stopped", value=count("stopped")),
    Column("stop_skew", "stop skew, max", "ms", ".0f", meaning="between the first setpoints of the stops",
           value=largest("stop_skew")),
    Column("deviation_mean", "deviation, mean", "cm", ".1f", meaning="largest of any vehicle in a flight, from the "
           "reference in time, by the poses", value=mean("deviation")),
    Column("deviation_max", "deviation, max", "cm", ".1f", value=largest("deviation")),
    Column("late_p99", "late, p99", "ms", ".2f", meaning="of setpoints, of the worst vehicle in the worst flight",
           value=largest("late_p99")),
    Column("late_max", "late, max", "ms", ".2f", value=largest("late_max")),
    Column("nearest", "nearest", "m", ".2f", meaning="least horizontal distance of two vehicles in the air",
           value=smallest("nearest")),
)  # fmt: skip
FAILURE_COLUMNS = (Column("fleet", "fleet"), Column("number", "flight", "", "d"), Column("reason", "ended"))


def work(settings: Settings, run: Run) -> Work:
    """Return one case per flight. A flight that ends otherwise is a row with its reason. Raises InputError."""
    for file in settings.fleet_files:
        load_fleet_file(file)
    flights = range(settings.flights)
    cases = {
        f"{file.stem} {number}": (file, number, settings.seed) for file in settings.fleet_files for number in flights
    }
    return Work(cases, fly, RealTimeFleetFlight)


def fly(case: tuple[Path, int, int]) -> RealTimeFleetFlight:
    """Fly a fleet once."""
    file, number, seed = case
    stopped = number % 2 == 1
    row = RealTimeFleetFlight(file.stem, len(load_fleet_file(file).vehicles), number, stopped)
    share = float(np.random.default_rng((seed, number)).uniform(0.2, 0.8))
    with tempfile.TemporaryDirectory(prefix="cfplan-") as records:
        try:
            with connect_fleet(file, safety=limits_for(file), records=records, keys=False) as fleet:
                fleet.take_off()
                fleet.fly()
                if stopped:
                    fleet.sleep(share * fleet.plan.end)
                    fleet.land()
                else:
                    fleet.wait()
        except CfplanError as error:
            return replace(row, reason=str(error))
        return _measured(row, fleet, read_fleet_record(Path(records) / fleet.record.name)) if fleet.record else row


def _measured(row: RealTimeFleetFlight, fleet: ConnectedFleet, record: FleetRecord) -> RealTimeFleetFlight:
    outcome = fleet.outcome
    assert outcome is not None
    if outcome.exit_code is ExitCode.ENDED_BY_OPERATOR and not row.stopped:
        raise KeyboardInterrupt  # the operator's stop ends the study too
    late = _start_lateness(fleet, outcome.outcomes, outcome.begins)
    stops = [begin for each in record.records.values() if (begin := _stop_begins(each)) is not None]
    summaries = [summarise(each) for each in record.records.values()]
    meant = ExitCode.ENDED_BY_OPERATOR if row.stopped else ExitCode.OK
    return replace(
        row,
        landed=outcome.exit_code is meant and len(record.records) == row.vehicles,
        reason=outcome.brakes,
        start_late=max(late, default=math.nan),
        start_skew=max(late, default=math.nan) - min(late, default=math.nan),
        stop_skew=max(stops) - min(stops) if row.stopped and len(stops) == row.vehicles else math.nan,
        deviation=max(each.max_deviation for each in summaries),
        late_p99=max(each.lateness_p99 for each in summaries),
        late_max=max(each.lateness_max for each in summaries),
        nearest=outcome.nearest,
    )


def _start_lateness(fleet: ConnectedFleet, outcomes: Mapping[str, FlightOutcome], begins: float) -> list[float]:
    """Return how late each vehicle began, s."""
    begun = [
        (each.member.delay, outcomes[each.name].first_setpoint) for each in fleet.vehicles if each.name in outcomes
    ]
    return [first - begins - delay for delay, first in begun if first]


def _stop_begins(record: Record) -> float | None:
    """Return when the first setpoint of the stop from the path was due, s; None if it did not stop there."""
    span = record.phase_span(Phase.STREAM)
    if span is None:
        return None
    setpoints = record.setpoints
    rows = np.flatnonzero((setpoints.time >= span[0]) & (setpoints.time <= span[1]))
    back = np.flatnonzero(np.diff(setpoints.index[rows]) < 0)  # numbers of a stop begin anew
    return float(setpoints.due[rows[back[0] + 1]]) if len(back) else None


def tables(settings: Settings, rows: list[RealTimeFleetFlight]) -> Iterator[Table]:
    """Yield a row per fleet, and the flights that ended otherwise."""
    yield table("fleets", "Fleets in real time, in one room with downwash", COLUMNS, rows, by=("fleet", "vehicles"))
    if failed := [row for row in rows if not row.landed]:
        yield table("not-landed", "Not landed", FAILURE_COLUMNS, failed)


STUDY = Study(Settings, work, tables, "flights/fleets/four.yaml -o results/fleet-flights.json", one_at_a_time=True)
