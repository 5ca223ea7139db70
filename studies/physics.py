"""The same bytes flown by bodies that others have written: how far they end up from cfplan's own closed loop.

Setpoints, controller and start are the same to the bit: the dry run's. Only the body differs, in equations, in
parameters or in both, so what differs is what a simulator says and not what flies.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError
from cfplan.flight.setpoints.encoding import EncodedFlight
from cfplan.preparation.plan_flight import plan_flight
from cfplan.preparation.prepare_flight import encode_flight
from cfplan.safety.limits import FlightLimits
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.dry_run import dry_run
from cfplan.simulation.other_bodies import BodyStep, fly_on, identified_body, rotorpy_body
from studies.runner.result import Column, StudyResult, Table, collect, detail_table
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.trajectory import Trajectory

PAPER_LAG, REALISTIC_LAG = 0.005, 0.072  # s, of the motors: RotorPy's of the paper's day, and its today


class OtherBody(NamedTuple):
    """A body to compare with, and the airframe that cfplan's own closed loop has beside it."""

    name: str
    step: BodyStep
    airframe: Airframe


@dataclass(frozen=True, slots=True)
class ComparedFlight:
    """The bytes of one path, flown by one body and by cfplan's."""

    path: str
    body: str
    motor_lag: float  # s, of cfplan's body
    duration: float  # s, of the motion
    deviation: float  # m, the other body's largest distance from where the trajectory is at that time
    own_deviation: float  # m, that of cfplan's body
    apart: float  # m, largest distance of the two at the same time
    apart_time: float  # s, when that was
    apart_rms: float  # m


def physics(
    path_files: Sequence[Path],
    find_safety_file: Callable[[Path], Path],
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> StudyResult:
    """Fly the bytes of each path by RotorPy, with two motor lags, and by drone-models. An interrupt keeps what is done.

    Bodies whose package is not installed are left out, and the settings say so.

    Raises:
        InputError: a path or limits file is wrong, or neither package is installed.
    """
    missing: list[str] = []

    def measure() -> Iterator[ComparedFlight]:
        for done, file in enumerate(path_files):
            yield from _compared(file, find_safety_file(file), missing)
            progress(done + 1, len(path_files))

    flights, interrupted = collect(measure())
    if missing and not flights:
        raise InputError("; ".join(dict.fromkeys(missing)), hint="pip install rotorpy==3.0.0 drone-models==0.1.0")
    settings = {"paths": [file.stem for file in path_files], "left_out": list(dict.fromkeys(missing))}
    tables = (comparison_table(flights),)
    return StudyResult("physics", settings, tables, (detail_table("flights", flights),), interrupted)


def _compared(path_file: Path, safety_file: Path, missing: list[str]) -> Iterator[ComparedFlight]:
    limits = load_limits(safety_file)
    planned = plan_flight(path_file, limits)
    encoded, trajectory, airframe = encode_flight(planned), planned.plan.trajectory, limits.airframe
    for other in bodies_for(airframe, missing):
        yield compared(path_file.stem, encoded, trajectory, other, airframe, limits.flight)


def compared(
    path: str, encoded: EncodedFlight, trajectory: Trajectory, other: OtherBody, airframe: Airframe,
    limits: FlightLimits,
) -> ComparedFlight:  # fmt: skip
    """Return how the bytes are followed by a body and by cfplan's; the controller believes in `airframe`."""
    times, theirs = fly_on(other.step, encoded, trajectory, airframe)
    loop = dry_run(encoded, trajectory, other.airframe, limits, believed=airframe).loop
    own = loop.position[np.minimum(np.searchsorted(loop.time, times - 1e-9), len(loop.time) - 1)]
    wanted, apart = trajectory.at(times).position, np.linalg.norm(theirs - own, axis=1)
    return ComparedFlight(
        path, other.name, other.airframe.motor_time_constant, trajectory.duration,
        deviation=_largest(theirs - wanted), own_deviation=_largest(own - wanted),
        apart=float(apart.max()), apart_time=float(times[np.argmax(apart)]),
        apart_rms=float(np.sqrt(np.mean(apart**2))),
    )  # fmt: skip


def bodies_for(airframe: Airframe, missing: list[str]) -> list[OtherBody]:
    """Return the bodies that can be had, and append to `missing` why others cannot."""
    makers: list[tuple[str, Callable[[], BodyStep], Airframe]] = [
        ("drone-models", partial(identified_body, airframe), airframe),
        *(
            (f"RotorPy, {lag:g} s", partial(rotorpy_body, airframe, lag), replace(airframe, motor_time_constant=lag))
            for lag in (REALISTIC_LAG, PAPER_LAG)
        ),
    ]
    found = []
    for name, make, own in makers:
        try:
            found.append(OtherBody(name, make(), own))
        except InputError as error:
            missing.append(error.what)
    return found


def _largest(errors: NDArray) -> float:
    return float(np.linalg.norm(errors, axis=1).max())


def comparison_table(flights: Sequence[ComparedFlight]) -> Table:
    """Return the largest deviation by each body beside that by cfplan's, and how far the two are apart."""
    names = list(dict.fromkeys(flight.body for flight in flights))
    columns = [Column("path", "path"), Column("duration", "flight", "s", ".1f")]
    for k, name in enumerate(names):
        lag = next(flight.motor_lag for flight in flights if flight.body == name)
        columns += [
            Column(f"deviation_{k}", name, "cm", ".1f",
                   meaning="" if k else "largest distance from where the trajectory is at that time"),
            Column(f"own_{k}", f"cfplan, {lag:g} s", "cm", ".1f",
                   meaning="" if k else "the same by cfplan's body, whose motors' thrust follows with that lag"),
            Column(f"apart_{k}", "apart", "cm", ".1f", meaning="" if k else "the two at the same time, at most"),
        ]  # fmt: skip
    rows: list[dict[str, Any]] = []
    for path in dict.fromkeys(flight.path for flight in flights):
        row: dict[str, Any] = {"path": path}
        for flight in (flight for flight in flights if flight.path == path):
            k = names.index(flight.body)
            row |= {
                "duration": flight.duration, f"deviation_{k}": flight.deviation, f"own_{k}": flight.own_deviation,
                f"apart_{k}": flight.apart,
            }  # fmt: skip
        rows.append(row)
    return Table("bodies", "The same bytes, flown by bodies of three kinds", tuple(columns), tuple(rows))
