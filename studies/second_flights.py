"""Learn a correction from the other flights of a plan, and subtract it from each public flight in FOLDER.

The others' deviations by motion capture are fitted as `cfplan fly --after` fits them, and the mean is subtracted. The
remainder is the deviation of a second flight if the vehicle follows its correction. Plans flown only once are
left out. The logs are not kept here.
"""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError
from cfplan.identification.earlier_flights import HOVER, SPACING
from cfplan.identification.reference import POSITION
from cfplan.vehicle.correction import PlanCorrection, fit_correction
from studies.real_flights_data import flights_of, read_flight
from studies.runner.options import argument
from studies.runner.reductions import count, rms
from studies.runner.result import Column, Table, table
from studies.runner.study import Run, Study, Work

_END = 1.0  # s before the plan's end, in which the shift changes to that of the hover


@dataclass(frozen=True, slots=True)
class Settings:
    """The folder of the flights."""

    folder: Path = argument()


@dataclass(frozen=True, slots=True)
class SecondFlight:
    """One flight, before and after the mean of the others is subtracted; rms distances from the plan, m."""

    flight: str
    plan: str
    others: int
    speed: float  # m/s, the plan's largest
    before: float  # horizontal
    after: float
    until_end: float  # after, without the plan's last _END seconds
    least: float  # with the others' mean itself, not its spline: the rest does not repeat
    height_before: float
    height_after: float


class _Flown(NamedTuple):
    """The deviation of a vehicle in one flight."""

    time: NDArray  # (N,) s from the plan's start, to HOVER after its end
    off: NDArray  # (N, 3) m
    speed: float  # m/s, the plan's largest


def work(settings: Settings, run: Run) -> Work:
    """Return one case per flight that has siblings and motion capture. Raises InputError if there is none."""
    plans: dict[str, list[Path]] = {}
    for file in flights_of(settings.folder).values():
        about = json.loads(file.read_text())
        if "reference_start" in about and "mocap_time" in about["columns"]:
            plans.setdefault(about["family"], []).append(file)
    cases = {file.stem: (plan, file, files) for plan, files in plans.items() if len(files) > 1 for file in files}
    if not cases:
        hint = "name the folder of the public flights, with its index.json"
        raise InputError("no plan was flown twice", where=str(settings.folder), hint=hint)
    return Work(cases, measure, SecondFlight)


def measure(case: tuple[str, Path, list[Path]]) -> SecondFlight:
    """Learn from a flight's siblings, and subtract."""
    plan, file, files = case
    duration = max(_ends(each) for each in files)
    own, *others = (_flown(each, duration) for each in sorted(files, key=lambda each: each != file))
    each = [fit_correction(one.time, one.off, duration, SPACING).coefficients for one in others]
    along = own.time <= duration
    time, off = own.time[along], own.off[along]
    left = off - PlanCorrection(np.mean(each, axis=0), duration).at(time)[:, 0]
    mean = np.mean([[np.interp(time, one.time, axis) for axis in one.off.T] for one in others], axis=0).T
    return SecondFlight(
        file.stem, plan, len(others), own.speed, _rms(off[:, :2]), _rms(left[:, :2]),
        _rms(left[time <= duration - _END, :2]), _rms((off - mean)[:, :2]), _rms(off[:, 2:]), _rms(left[:, 2:]),
    )  # fmt: skip


def _ends(file: Path) -> float:
    """Return the end of a flight's plan, s from its start: when the reference moves last."""
    reference = read_flight(file).reference
    moves = np.flatnonzero(np.any(np.diff(reference.rows[:, POSITION], axis=0) != 0.0, axis=1))
    return float(reference.time[moves[-1] + 1]) - _start(file)


def _start(file: Path) -> float:
    return float(json.loads(file.read_text())["reference_start"])


def _flown(file: Path, duration: float) -> _Flown:
    """Return the deviation of a flight. Raises InputError if motion capture has too long a gap to learn from it."""
    flight, start = read_flight(file), _start(file)
    log, reference = flight.log, flight.reference
    time = log.pose_time - start
    inside = (time >= 0.0) & (time <= duration + HOVER)
    time = time[inside]
    gap = float(np.diff(time, prepend=0.0, append=duration + HOVER).max())
    if gap > SPACING:
        raise InputError(f"no poses for {gap:.2f} s", where=str(file), hint="leave this flight out")
    off = log.poses[inside, :3] - reference.at(log.pose_time[inside])[:, POSITION]
    return _Flown(time, off, float(np.linalg.norm(reference.rows[:, 3:6], axis=1).max()))


def _rms(off: NDArray) -> float:
    return math.sqrt(np.square(off).sum(axis=1).mean())


_FIGURES = (
    Column("speed", "speed", "m/s", ".2f", meaning="the plan's largest"),
    Column("before", "deviation", "cm", ".1f", meaning="horizontal, rms over the plan", value=rms("before")),
    Column("after", "after", "cm", ".1f", meaning="with the mean spline of the others subtracted", value=rms("after")),
    Column("until_end", "after, until the last second", "cm", ".1f", value=rms("until_end")),
    Column("least", "not repeating", "cm", ".1f",
           meaning="with the others' mean itself subtracted, which no spline is better than", value=rms("least")),
    Column("height_before", "height", "cm", ".1f", meaning="rms", value=rms("height_before")),
    Column("height_after", "height, after", "cm", ".1f", value=rms("height_after")),
)  # fmt: skip
PLANS = (
    Column("plan", "plan"),
    Column("flights", "flights", value=count()),
    *_FIGURES,
)
FLIGHTS = (Column("flight", "flight"), Column("others", "learned from", "", ".0f", meaning="flights"), *_FIGURES)


def tables(settings: Settings, rows: list[SecondFlight]) -> Iterator[Table]:
    """Yield a table with one row per plan, and one with one row per flight."""
    yield table("plans", "Each flight less what the other flights of its plan show", PLANS, rows, by=("plan",))
    yield table("flights", "Each flight", FLIGHTS, rows)


STUDY = Study(Settings, work, tables, "public-flights -o results/second-flights.json")
