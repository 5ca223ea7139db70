"""Fly each FLEET in real time on virtual vehicles in one room, as `cfplan fly` does; measure how they begin and stop.

Every second flight is ended by an order to land at a moment drawn by its seed, so that all vehicles brake; the others
fly to their ends.
"""

import math
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cfplan import connect_fleet
from cfplan.errors import CfplanError, ExitCode
from cfplan.flight.fleet.conductor import START_LEAD
from cfplan.flight.telemetry import Phase
from cfplan.planning.fleet.fleet_file import load_fleet_file
from cfplan.recording.fleet_record import FleetRecord, read_fleet_record
from cfplan.recording.record import Record
from cfplan.recording.summary import summarise
from cfplan.steering.connected_fleet import ConnectedFleet
from studies.runner.limits import limits_for
from studies.runner.options import argument, option
from studies.runner.reductions import among, count, largest, mean, smallest
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
    stopped: bool  # by an order to land
    landed: bool = False  # all vehicles, as ordered or at their ends
    reason: str = ""  # why they did not, or why all braked
    start_late: float = math.nan  # s after its time that the last one began
    start_skew: float = math.nan  # s, between the first one and the last one, each after its own time
    stop_skew: float = math.nan  # s, between the first setpoints of their stops, of two or more that stopped
    deviation: float = math.nan  # m, of any vehicle from the reference in time, by the poses
    late_p99: float = math.nan  # s, lateness of setpoints, of the worst vehicle
    late_max: float = math.nan  # s
    nearest: float = math.nan  # m, between two vehicles while at least one is in the air, by the poses

    @property
    def stop_measured(self) -> bool:
        """Return whether two vehicles or more stopped on their paths."""
        return math.isfinite(self.stop_skew)


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
    Column("stops", "stopped", meaning="flights in which two vehicles or more braked on their paths",
           value=count("stop_measured")),
    Column("stop_skew", "stop skew, max", "ms", ".0f", meaning="between the first setpoints of the stops",
           value=among("stop_measured", largest("stop_skew"))),
    Column("deviation_mean", "deviation, mean", "cm", ".1f", meaning="largest of any vehicle in a flight, from the "
           "reference in time, by the poses", value=mean("deviation")),
    Column("deviation_max", "deviation, max", "cm", ".1f", value=largest("deviation")),
    Column("late_p99", "late, p99", "ms", ".2f", meaning="of setpoints, of the worst vehicle in the worst flight",
           value=largest("late_p99")),
    Column("late_max", "late, max", "ms", ".2f", value=largest("late_max")),
    Column("nearest", "nearest", "m", ".2f", meaning="least horizontal distance between two vehicles while at "
           "least one is in the air", value=smallest("nearest")),
)  # fmt: skip
FAILURE_COLUMNS = (Column("fleet", "fleet"), Column("number", "flight", "", "d"), Column("reason", "ended"))


def work(settings: Settings, run: Run) -> Work:
    """Return one case per flight. A flight that fails is a row with its reason. Raises InputError."""
    for file in settings.fleet_files:
        load_fleet_file(file)
    flights = range(settings.flights)
    cases = {f"{file} {number}": (file, number, settings.seed) for file in settings.fleet_files for number in flights}
    return Work(cases, fly, RealTimeFleetFlight)


def fly(case: tuple[Path, int, int]) -> RealTimeFleetFlight:
    """Fly a fleet once."""
    file, number, seed = case
    stopped = number % 2 == 1
    row = RealTimeFleetFlight(file.stem, len(load_fleet_file(file).vehicles), number, stopped)
    fraction = float(np.random.default_rng((seed, number)).uniform(0.2, 0.8))
    with tempfile.TemporaryDirectory(prefix="cfplan-") as records:
        try:
            with connect_fleet(file, safety=limits_for(file), records=records, keys=False) as fleet:
                fleet.take_off()
                fleet.fly()
                if stopped:
                    fleet.sleep(START_LEAD + fraction * fleet.plan.end)
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
    late = [
        sent[0] - outcome.begins - each.member.delay
        for each in fleet.vehicles
        if each.name in record.records and len(sent := _streamed(record.records[each.name])[0])
    ]
    stops = [time for each in record.records.values() if (time := _stop_time(each)) is not None]
    summaries = [summarise(each) for each in record.records.values()]
    expected = ExitCode.ENDED_BY_OPERATOR if row.stopped else ExitCode.OK
    return replace(
        row,
        landed=outcome.exit_code is expected and len(record.records) == row.vehicles,
        reason=outcome.brakes,
        start_late=max(late, default=math.nan),
        start_skew=max(late) - min(late) if len(late) == row.vehicles else math.nan,
        stop_skew=max(stops) - min(stops) if row.stopped and len(stops) > 1 else math.nan,
        deviation=float(np.nanmax([each.max_deviation for each in summaries])),
        late_p99=float(np.nanmax([each.lateness_p99 for each in summaries])),
        late_max=float(np.nanmax([each.lateness_max for each in summaries])),
        nearest=outcome.nearest,
    )


def _streamed(record: Record) -> tuple[NDArray, NDArray]:
    """Return when each setpoint of the path and of a stop from it was sent, s, and its number."""
    begin, end = record.phase_span(Phase.STREAM) or (math.inf, math.inf)
    setpoints = record.setpoints
    rows = (setpoints.time >= begin) & (setpoints.time <= end)
    return setpoints.time[rows], setpoints.index[rows]


def _stop_time(record: Record) -> float | None:
    """Return when the first setpoint of the stop from the path was sent, s; None if it did not stop there."""
    sent, number = _streamed(record)
    restarts = np.flatnonzero(np.diff(number) < 0)  # the setpoints of a stop are numbered anew
    return float(sent[restarts[0] + 1]) if len(restarts) else None


def tables(settings: Settings, rows: list[RealTimeFleetFlight]) -> Iterator[Table]:
    """Yield a row per fleet, and the flights that failed."""
    yield table("fleets", "Fleets in real time, in one room with downwash", COLUMNS, rows, by=("fleet", "vehicles"))
    if failed := [row for row in rows if not row.landed]:
        yield table("not-landed", "Not landed", FAILURE_COLUMNS, failed)


STUDY = Study(Settings, work, tables, "flights/fleets/four.yaml -o results/fleet-flights.json", one_at_a_time=True)
