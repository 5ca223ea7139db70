"""Export path files for the vehicle's memory and fly them on board: deviations, beside the same plans streamed.

Exports are flown in the dry run, flights by the pilot on the virtual Crazyflie of the stepped lab.
"""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from cfplan.errors import CfplanError
from cfplan.flight.pilot.mission import Mission, mission_of
from cfplan.flight.pilot.outcome import Rung
from cfplan.preparation.export_flight import Form, fit_polynomials, plan_for_polynomials
from cfplan.preparation.on_board_flight import prepare_on_board_flight
from cfplan.preparation.plan_flight import FlightOptions
from cfplan.preparation.prepare_flight import encode_flight
from cfplan.safety.limits import Limits
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.dry_run import dry_run
from studies.fault_scenarios import Scenario
from studies.faults import fly_stepped
from studies.runner.result import Column, StudyResult, Table, collect

_SIZE = (
    Column("kind", "kind", meaning="of the pieces: *raw* as polynomials, or *compressed*"),
    Column("pieces", "pieces", meaning="that the memory holds"),
    Column("bytes", "bytes"),
)
_DEVIATIONS = (
    Column("on_board", "on board", "cm", ".1f", meaning="largest deviation from the plan, the polynomials flown"),
    Column("streamed", "streamed", "cm", ".1f", meaning="the same of this plan, streamed"),
    Column("difference", "difference", "cm", "+.1f", meaning="of the two"),
)
EXPORT_COLUMNS = (
    Column("path", "path"),
    *_SIZE,
    Column("planned", "plan", "s", ".1f", meaning="duration of the plan that the polynomials were fitted to"),
    Column("duration", "polynomials", "s", ".1f", meaning="their duration, the second for the lead included"),
    Column("slowed", "slowed", "%", ".1f", meaning="by how much the plan was slowed until polynomials keep the limits"),
    *_DEVIATIONS,
)
FLIGHT_COLUMNS = (
    Column("path", "path"),
    *_SIZE,
    Column("duration", "plan", "s", ".1f", meaning="its duration, as slow as the polynomials are"),
    Column("time_lost", "slower for the fall", "%", ".0f", meaning="the share of time that it costs"),
    *_DEVIATIONS,
    Column("end", "end", meaning="of the flight on board"),
)
REFUSED_COLUMNS = (Column("path", "path"), Column("what", "what"), Column("reason", "why not"))


class _Deviations(NamedTuple):
    """Largest deviations from one plan, m."""

    on_board: float
    streamed: float

    def row(self) -> dict[str, float]:
        return {**self._asdict(), "difference": self.on_board - self.streamed}


def exports(
    path_files: Sequence[Path],
    find_safety_file: Callable[[Path], Path],
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> StudyResult:
    """Export each path and fly it on board, and the same plans streamed. An interrupt keeps what is done by then.

    What cannot be planned, fitted or prepared is a row of the table `refused`. Raises InputError where there is no
    safety.yaml, or a mistake in it.
    """

    def measure() -> Iterator[tuple[str, dict[str, Any]]]:
        for done, file in enumerate(path_files):
            progress(done, len(path_files))
            limits = load_limits(find_safety_file(file))
            for name, make in (("exports", _exported), ("on-board", _flown)):
                try:
                    yield name, make(file, limits)
                except CfplanError as error:
                    yield "refused", {"path": file.stem, "what": name, "reason": str(error)}

    rows, interrupted = collect(measure())
    tables = [
        Table(name, title, columns, tuple(row for table, row in rows if table == name))
        for name, title, columns in (
            ("exports", "Exports for the vehicle's memory, in the dry run", EXPORT_COLUMNS),
            ("on-board", "Flights on board, in the stepped lab", FLIGHT_COLUMNS),
            ("refused", "Neither exported nor flown on board", REFUSED_COLUMNS),
        )
    ]
    tables = [table for table in tables if table.rows or table.name != "refused"]
    return StudyResult("exports", {"paths": [file.stem for file in path_files]}, tuple(tables), interrupted=interrupted)


def _exported(path_file: Path, limits: Limits) -> dict[str, Any]:
    exported = fit_polynomials(plan_for_polynomials(path_file, limits, FlightOptions()), Form.MEMORY)
    made, planned = exported.on_board, exported.planned
    streamed = dry_run(encode_flight(planned), planned.plan.trajectory, limits.airframe, limits.flight)
    return {
        "path": path_file.stem,
        **_size(len(made.pieces.durations), made.compressed, made.memory),
        "planned": planned.duration,
        "duration": made.duration,
        "slowed": made.reference.slowing - 1.0,
        **_Deviations(exported.dry_run.deviation, streamed.deviation).row(),
    }


def _flown(path_file: Path, limits: Limits) -> dict[str, Any]:
    prepared = prepare_on_board_flight(path_file, limits)
    program = prepared.mission.on_board
    assert program is not None
    on_board, end = _fly(prepared.mission)
    streamed, _ = _fly(mission_of(encode_flight(prepared.planned), prepared.mission.limits))
    return {
        "path": path_file.stem,
        **_size(program.pieces, program.compressed, program.memory),
        "duration": prepared.planned.duration,
        "time_lost": prepared.plan.time_lost,
        **_Deviations(on_board, streamed).row(),
        "end": end,
    }


def _size(pieces: int, compressed: bool, memory: bytes) -> dict[str, Any]:
    return {"kind": "compressed" if compressed else "raw", "pieces": pieces, "bytes": len(memory)}


def _fly(mission: Mission) -> tuple[float, str]:
    """Fly a mission in the stepped lab; return the largest deviation by the poses, m, and how the flight ended."""
    flown = fly_stepped(Scenario("none", Rung.NONE), mission)
    return float("nan") if flown.outcome is None else flown.outcome.deviation.max, flown.reason
