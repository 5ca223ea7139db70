"""Export each PATH for the vehicle's memory, fly it on board, and compare deviations with those of streaming the plan.

Exports are flown in the dry run; the pilot flies on-board plans on the stepped lab's virtual Crazyflie. Vehicles have
firmware that reads the yaw of compressed pieces.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from cfplan.errors import CfplanError
from cfplan.flight.on_board.memory_format import YAW_READ_SINCE
from cfplan.flight.pilot.mission import Mission, mission_of
from cfplan.flight.pilot.outcome import Rung
from cfplan.preparation.export_flight import Form, fit_polynomials, plan_for_polynomials
from cfplan.preparation.on_board_flight import prepare_on_board_flight
from cfplan.preparation.plan_flight import FlightOptions
from cfplan.preparation.prepare_flight import encode_flight
from cfplan.safety.limits import Limits
from cfplan.simulation.dry_run import dry_run
from studies.runner.limits import limits_for
from studies.runner.options import argument
from studies.runner.result import Column, Table, table
from studies.runner.study import Run, Study, Work
from studies.stepped_flight import Scenario, fly_stepped


@dataclass(frozen=True, slots=True)
class Settings:
    """The paths to fly."""

    path_files: tuple[Path, ...] = argument()


@dataclass(frozen=True, slots=True)
class OnBoard:
    """A path flown on board in one of two ways, or the reason why it was not."""

    path: str
    what: str  # exports: in the dry run; on-board: in the stepped lab
    reason: str = ""  # why it was not flown; empty if it was
    kind: str = ""  # of the pieces: raw or compressed
    pieces: int = 0
    bytes: int = 0
    planned: float = math.nan  # s, of the plan that the polynomials are fitted to
    duration: float = math.nan  # s, of the flown motion
    slowed: float = math.nan  # slow-down that makes the polynomials keep the limits, relative
    time_lost: float = math.nan  # fraction of the time lost to keep a fall after link loss inside the walls
    on_board: float = math.nan  # m, largest deviation from the plan
    streamed: float = math.nan  # m, largest deviation of the same plan when streamed
    end: str = ""  # how the flight ended

    @property
    def difference(self) -> float:
        """Return the deviation on board minus the deviation streamed, m."""
        return self.on_board - self.streamed


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
    Column("time_lost", "slower for the fall", "%", ".0f", meaning="the fraction of time that it costs"),
    *_DEVIATIONS,
    Column("end", "end", meaning="of the flight on board"),
)
REFUSED_COLUMNS = (Column("path", "path"), Column("what", "what"), Column("reason", "why not"))


def work(settings: Settings, run: Run) -> Work:
    """Return one case per path."""
    return Work({str(file): file for file in settings.path_files}, measure, OnBoard)


def measure(path_file: Path) -> list[OnBoard]:
    """Export a path, fly it on board, and fly the same plans streamed.

    A failure to plan, fit or prepare becomes a row with its reason. Raises what reading the limits raises.
    """
    limits, rows = limits_for(path_file), []
    limits = replace(limits, firmware=replace(limits.firmware, oldest=YAW_READ_SINCE))
    for what, fly in (("exports", _exported), ("on-board", _flown)):
        try:
            rows.append(fly(path_file, limits))
        except CfplanError as error:
            rows.append(OnBoard(path_file.stem, what, reason=str(error)))
    return rows


def _exported(path_file: Path, limits: Limits) -> OnBoard:
    exported = fit_polynomials(plan_for_polynomials(path_file, limits, FlightOptions()), Form.MEMORY)
    made, planned = exported.on_board, exported.planned
    streamed = dry_run(encode_flight(planned), planned.plan.trajectory, limits)
    return OnBoard(
        path_file.stem, "exports", kind=_kind(made.compressed), pieces=len(made.pieces.durations),
        bytes=len(made.memory), planned=planned.duration, duration=made.duration, slowed=made.reference.slowing - 1.0,
        on_board=exported.dry_run.deviation, streamed=streamed.deviation,
    )  # fmt: skip


def _flown(path_file: Path, limits: Limits) -> OnBoard:
    prepared = prepare_on_board_flight(path_file, limits)
    program = prepared.mission.on_board
    assert program is not None
    on_board, end = _fly(prepared.mission)
    streamed, _ = _fly(mission_of(encode_flight(prepared.planned), prepared.mission.limits))
    return OnBoard(
        path_file.stem, "on-board", kind=_kind(program.compressed), pieces=program.pieces, bytes=len(program.memory),
        duration=prepared.planned.duration, time_lost=prepared.plan.time_lost, on_board=on_board, streamed=streamed,
        end=end,
    )  # fmt: skip


def _kind(compressed: bool) -> str:
    return "compressed" if compressed else "raw"


def _fly(mission: Mission) -> tuple[float, str]:
    """Fly a mission in the stepped lab; return the largest deviation by the poses, m, and how the flight ended."""
    flown = fly_stepped(Scenario("none", Rung.NONE), mission)
    return math.nan if flown.outcome is None else flown.outcome.deviation.max, flown.reason


def tables(settings: Settings, rows: list[OnBoard]) -> Iterator[Table]:
    """Yield the dry runs, the flights in the stepped lab, and the paths that did not fly."""
    exported, flown = ([row for row in rows if row.what == what and not row.reason] for what in ("exports", "on-board"))
    yield table("exports", "Exports for the vehicle's memory, in the dry run", EXPORT_COLUMNS, exported)
    yield table("on-board", "Flights on board, in the stepped lab", FLIGHT_COLUMNS, flown)
    if refused := [row for row in rows if row.reason]:
        yield table("refused", "Neither exported nor flown on board", REFUSED_COLUMNS, refused)


STUDY = Study(Settings, work, tables, "flights/line.yaml flights/helix.yaml -o results/exports.json")
