"""Fly the setpoints of each PATH by RotorPy and by drone-models, and compare with cfplan's own closed loop.

Setpoints, controller and start are those of the dry run, bit by bit. Only the body differs, in equations, parameters or
both, so that any difference is one of the simulators.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError
from cfplan.flight.firmware import gains_for
from cfplan.flight.setpoints.encoding import EncodedFlight
from cfplan.preparation.plan_flight import plan_flight
from cfplan.preparation.prepare_flight import encode_flight
from cfplan.simulation.dry_run import fly_motion
from cfplan.simulation.engine.flight import Conditions
from cfplan.simulation.other_bodies import BodyStep, fly_on, identified_body, rotorpy_body
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.trajectory import Trajectory
from studies.runner.limits import limits_for
from studies.runner.options import argument
from studies.runner.reductions import among, largest
from studies.runner.result import Column, Table, table
from studies.runner.study import Run, Study, Work

REALISTIC_LAG, PAPER_LAG = 0.072, 0.005  # s, of the motors: RotorPy's current default, and that of the paper's version


@dataclass(frozen=True, slots=True)
class Settings:
    """The paths to fly."""

    path_files: tuple[Path, ...] = argument()


@dataclass(frozen=True, slots=True)
class OtherBody:
    """A body to compare with."""

    name: str
    make: Callable[[Airframe], BodyStep]  # raises InputError if the body is not available
    motor_lag: float | None = None  # s, of cfplan's body that it is compared with; None: the airframe's

    def beside(self, airframe: Airframe) -> Airframe:
        """Return the airframe of cfplan's body that it is compared with."""
        return airframe if self.motor_lag is None else replace(airframe, motor_time_constant=self.motor_lag)


@dataclass(frozen=True, slots=True)
class ComparedFlight:
    """The setpoints of one path flown by one body and by cfplan's, or the reason why that body does not fly."""

    path: str
    body: str
    reason: str = ""  # why it does not fly
    motor_lag: float = math.nan  # s, of cfplan's body
    duration: float = math.nan  # s, of the motion
    deviation: float = math.nan  # m, largest distance of the other body from the trajectory at the same time
    own_deviation: float = math.nan  # m, that of cfplan's body
    apart: float = math.nan  # m, largest distance of the two at the same time
    apart_time: float = math.nan  # s, time of that distance
    apart_rms: float = math.nan  # m


BODIES = (
    OtherBody("drone-models", identified_body),
    *(OtherBody(f"RotorPy, {lag:g} s", partial(rotorpy_body, lag=lag), lag) for lag in (REALISTIC_LAG, PAPER_LAG)),
)


def work(settings: Settings, run: Run) -> Work:
    """Return one case per path."""
    return Work({str(file): file for file in settings.path_files}, measure, ComparedFlight)


def measure(path_file: Path, bodies: Sequence[OtherBody] = BODIES) -> list[ComparedFlight]:
    """Fly the setpoints of a path with each body. Raises InputError if none of them is available."""
    limits = limits_for(path_file)
    limits = replace(limits, airframe=limits.airframe.simplified())
    planned = plan_flight(path_file, limits)
    encoded, trajectory, airframe = encode_flight(planned), planned.plan.trajectory, limits.airframe
    rows = []
    for body in bodies:
        try:
            rows.append(compared(path_file.stem, body, encoded, trajectory, airframe))
        except InputError as error:
            rows.append(ComparedFlight(path_file.stem, body.name, reason=error.what))
    if all(row.reason for row in rows):
        reasons = "; ".join(dict.fromkeys(row.reason for row in rows))
        raise InputError(reasons, hint="pip install rotorpy==3.0.0 drone-models==0.1.0")
    return rows


def compared(
    path: str, body: OtherBody, encoded: EncodedFlight, trajectory: Trajectory, airframe: Airframe
) -> ComparedFlight:  # fmt: skip
    """Compare how a body and cfplan's own follow setpoints; the controller assumes `airframe`.

    Raises InputError if the body is not available.
    """
    own_body = body.beside(airframe)
    times, theirs = fly_on(body.make(airframe), encoded, trajectory, airframe)
    loop = fly_motion(encoded, trajectory, own_body, conditions=Conditions(gains_for(airframe)))
    own = loop.position[np.minimum(np.searchsorted(loop.time, times - 1e-9), len(loop.time) - 1)]
    wanted, apart = trajectory.at(times).position, np.linalg.norm(theirs - own, axis=1)
    return ComparedFlight(
        path, body.name, motor_lag=own_body.motor_time_constant, duration=trajectory.duration,
        deviation=_largest(theirs - wanted), own_deviation=_largest(own - wanted), apart=float(apart.max()),
        apart_time=float(times[np.argmax(apart)]), apart_rms=float(np.sqrt(np.mean(apart**2))),
    )  # fmt: skip


def _largest(errors: NDArray) -> float:
    return float(np.linalg.norm(errors, axis=1).max())


def tables(settings: Settings, rows: list[ComparedFlight]) -> Iterator[Table]:
    """Yield the largest deviations of each body and of cfplan's, and the distance between the two."""
    flown = [row for row in rows if not row.reason]
    columns = [Column("path", "path"), Column("duration", "flight", "s", ".1f")]
    for k, (name, lag) in enumerate({row.body: row.motor_lag for row in flown}.items()):
        for key, field, title, meaning in (
            ("deviation", "deviation", name, "largest distance from where the trajectory is at that time"),
            ("own", "own_deviation", f"cfplan, {lag:g} s",
             "the same by cfplan's body, whose motors' thrust follows with that lag"),
            ("apart", "apart", "apart", "the two at the same time, at most"),
        ):  # fmt: skip
            value = among(partial(_is_of, name), largest(field))
            columns.append(Column(f"{key}_{k}", title, "cm", ".1f", meaning="" if k else meaning, value=value))
    yield table("bodies", "The same bytes, flown by bodies of three kinds", columns, flown, by=("path",))
    if left_out := [row for row in rows if row.reason]:
        columns = [Column("path", "path"), Column("body", "body"), Column("reason", "why not")]
        yield table("left-out", "Bodies that did not fly", columns, left_out)


def _is_of(body: str, row: ComparedFlight) -> bool:
    return row.body == body


STUDY = Study(Settings, work, tables, "flights/line.yaml flights/helix.yaml -o results/physics.json")
