"""Overlay flights with one another and with a plan: each is a trial, with time 0 at the beginning of the path."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.signal import oaconvolve

from cfplan.errors import InputError
from cfplan.numbers import coordinates, shown
from cfplan.recording.header import Triple
from cfplan.recording.importers.mocap_log import LoggedSubject
from cfplan.recording.record import Record
from cfplan.recording.summary import planned_positions, reference_span, reference_times
from cfplan.vehicle.trajectory import Trajectory

STEP = 0.01  # s, grid of the first search for the time offset
NEARBY = 0.2  # s, range of the fine search around the first result
SPEED_SPAN = 0.025  # s, before and after
_LONGEST_GAP = 0.1  # s between poses, longest gap bridged by a straight line
_SHORTEST_STEP = 1e-5  # s, shortest measurable interval between poses
_MAX_UNEXPLAINED = 0.5  # of the plan's variance; with more left, log and plan are hardly the same flight


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """The reference motion of a vehicle."""

    name: str
    time: NDArray  # (M,) s from the start of the path
    position: NDArray  # (M, 3) m

    def at(self, time: NDArray) -> NDArray:
        """Return (N, 3) m; NaN before its begin and after its end."""
        axes = [np.interp(time, self.time, axis, left=np.nan, right=np.nan) for axis in self.position.T]
        return np.stack(axes, axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """One flight of the overlay."""

    name: str
    time: NDArray  # (N,) s from the start of the path, or of the log where there is no reference
    position: NDArray  # (N, 3) m, NaN where it was not seen
    quaternion: NDArray  # (N, 4) body→world, x y z w, NaN where not known
    reference: Reference | None
    room: tuple[Triple, Triple] | None = None  # m, lower and upper corner; None for a log

    @property
    def deviation(self) -> NDArray:
        """Return (N,) m from the reference at that time; NaN where there is none."""
        if self.reference is None:
            return np.full(len(self.time), np.nan)
        return np.linalg.norm(self.position - self.reference.at(self.time), axis=1)

    @property
    def speed(self) -> NDArray:
        """Return (N,) m/s over SPEED_SPAN before and after, so that noise of a millimetre hardly shows; NaN at gaps."""
        speed = np.full(len(self.time), np.nan)
        if len(self.time) > 2:
            step = max(float(np.median(np.diff(self.time))), _SHORTEST_STEP)
            reach = max(1, round(SPEED_SPAN / step))
            moved = self.position[2 * reach :] - self.position[: -2 * reach]
            took = self.time[2 * reach :] - self.time[: -2 * reach]
            speed[reach:-reach] = np.linalg.norm(moved, axis=1) / took
        return speed


@dataclass(frozen=True, slots=True)
class Alignment:
    """Alignment of a log with a plan: shifted in time, not in space."""

    offset: float  # s of the log's clock at which the plan begins
    covered: float  # fraction of the plan's time in which the subject was seen
    aside: tuple[float, float, float]  # m, mean of the log minus the plan
    max_deviation: float  # m
    rms_deviation: float  # m
    alike: bool  # whether the log resembles a flight of the plan

    def __str__(self) -> str:
        return (
            f"offset {shown(self.offset, '.3f')} s, {100 * self.covered:.0f} % of the plan seen, deviation "
            f"{100 * self.rms_deviation:.1f} cm rms, {100 * self.max_deviation:.1f} cm max, "
            f"in the mean {coordinates((100 * each for each in self.aside), '.1f')} cm aside"
        )


def short_name(name: str) -> str:
    """Return a label for charts: `figure8 09:42:21` for the record 20261122-094221-figure8; other names as they are."""
    stamped = re.fullmatch(r"\d{8}-(\d\d)(\d\d)(\d\d)-(.+)", name)
    return f"{stamped[4]} {stamped[1]}:{stamped[2]}:{stamped[3]}" if stamped else name


def reference_of(trajectory: Trajectory, name: str) -> Reference:
    """Sample a plan."""
    time = np.append(np.arange(0.0, trajectory.duration, STEP), trajectory.duration)
    return Reference(name, time, trajectory.at(time).position)


def trial_of_record(record: Record, name: str) -> Trial:
    """Return a recorded flight with its setpoints as reference; time 0 at the first of its path."""
    begin, end = reference_span(record)
    poses = record.poses
    if math.isnan(begin):
        return Trial(name, poses.time - record.start, poses.position, poses.quaternion, None, record.header.fence)
    wanted = reference_times(record.setpoints)
    along = (wanted >= begin) & (wanted <= end)
    reference = Reference(record.header.name, wanted[along] - begin, planned_positions(record)[along])
    return Trial(name, poses.time - begin, poses.position, poses.quaternion, reference, record.header.fence)


def subject_of_record(record: Record, name: str) -> LoggedSubject:
    """Return a recorded flight as motion capture saw it."""
    poses = record.poses
    return LoggedSubject(name, poses.time - record.start, poses.position, poses.quaternion)


def trial_of_subject(subject: LoggedSubject, reference: Reference | None = None, offset: float = 0.0) -> Trial:
    """Return a subject of a log as a trial; time 0 at `offset` of its clock."""
    return Trial(subject.name, subject.time - offset, subject.position, subject.quaternion, reference)


def align(subject: LoggedSubject, reference: Reference) -> Alignment:
    """Find by correlation where in the log the plan was flown.

    At this time the difference of log and plan has the least variance, so neither the laboratory's origin nor motion
    before and after matters. Parts of the plan that were not seen count with the plan's own variance. A constant delay
    of the vehicle is compensated too: a log alone cannot distinguish the two.

    Raises InputError if the subject has too few poses.
    """
    time, position = subject.time[subject.seen], subject.position[subject.seen]
    if len(time) < 2 or time[-1] - time[0] < 2 * STEP:
        raise InputError(
            "seen for too short a time to be aligned with a plan",
            where=subject.name,
            hint="choose another subject with --subject, or leave out the plan",
        )
    guess, left_over = _on_grid(time, position, reference)
    offset = _refined_time(guess, time, position, reference)
    difference = position - reference.at(time - offset)
    difference = difference[np.isfinite(difference[:, 0])]
    if len(difference) == 0:
        raise InputError(
            "not seen while the plan was flown",
            where=subject.name,
            hint="choose another subject with --subject, or another plan",
        )
    distance = np.linalg.norm(difference, axis=1)
    x, y, z = (float(value) for value in difference.mean(axis=0))
    return Alignment(
        offset=offset,
        covered=float(np.mean(_near(reference.time + offset, time))),
        aside=(x, y, z),
        max_deviation=float(distance.max()),
        rms_deviation=float(np.sqrt(np.mean(distance**2))),
        alike=left_over <= _MAX_UNEXPLAINED,
    )


def _on_grid(time: NDArray, position: NDArray, reference: Reference) -> tuple[float, float]:
    """Return the best offset in steps of STEP, and the fraction of the plan's variance left between log and plan."""
    centre = reference.position.mean(axis=0)
    plan_grid = np.arange(0.0, reference.time[-1] + STEP / 2, STEP)
    plan = np.stack([np.interp(plan_grid, reference.time, axis) for axis in (reference.position - centre).T], axis=1)
    spread = float(np.sum(np.var(plan, axis=0)))
    log, weight = _resampled(np.arange(time[0], time[-1], STEP), time, position - centre)

    # Sums over the plan's samples for every shift: of weights, of both, of their squares and of their product.
    ones = np.ones(len(plan))
    count = _correlated(weight, ones)
    sums = [_correlated(weight * axis, ones) for axis in log.T]
    plan_sums = [_correlated(weight, axis) for axis in plan.T]
    squares = _correlated(weight * np.sum(log**2, axis=1), ones)
    plan_squares = _correlated(weight, np.sum(plan**2, axis=1))
    products = sum(_correlated(weight * a, b) for a, b in zip(log.T, plan.T, strict=True))
    seen = np.maximum(count, 1.0)
    mean = [(a - b) / seen for a, b in zip(sums, plan_sums, strict=True)]
    variance = (squares - 2 * products + plan_squares) / seen - sum(axis**2 for axis in mean)
    covered = np.clip(count / len(plan), 0, 1)
    cost = covered * variance + (1 - covered) * spread
    best = int(np.argmin(cost))
    left_over = float(cost[best]) / spread if spread > 0 else np.inf
    return float(time[0] + (best - (len(plan) - 1)) * STEP), left_over


def _correlated(log: NDArray, plan: NDArray) -> NDArray:
    """Return the sum over the plan of log times plan for every shift: block by block, as logs may last for hours."""
    return oaconvolve(log, plan[::-1])


def _refined_time(guess: float, time: NDArray, position: NDArray, reference: Reference) -> float:
    """Return the offset near a guess at which the difference of log and plan varies least.

    The seen part of the plan changes with the offset, which biases the guess by a few steps: here that part is fixed.
    """
    moments = reference.time + guess
    fixed = _near(moments - NEARBY, time) & _near(moments + NEARBY, time)
    if np.count_nonzero(fixed) < 3:
        return guess

    def varies(offset: float) -> float:
        at = np.stack([np.interp(reference.time[fixed] + offset, time, axis) for axis in position.T], axis=1)
        return float(np.sum(np.var(at - reference.position[fixed], axis=0)))

    nearest = min(guess + np.arange(-NEARBY, NEARBY, STEP), key=varies)
    bounds = (nearest - STEP, nearest + STEP)
    return float(minimize_scalar(varies, bounds=bounds, method="bounded", options={"xatol": 1e-7}).x)


def _resampled(grid: NDArray, time: NDArray, position: NDArray) -> tuple[NDArray, NDArray]:
    """Return positions at the grid's times (N, 3), 0 in gaps, and weights (N,) that are 0 there."""
    at = np.stack([np.interp(grid, time, axis) for axis in position.T], axis=1)
    weight = _near(grid, time).astype(float)
    return at * weight[:, None], weight


def _near(moments: NDArray, time: NDArray) -> NDArray:
    """Return (N,) whether the subject was seen shortly before and after each moment."""
    after = np.clip(np.searchsorted(time, moments), 1, len(time) - 1)
    gap = max(_LONGEST_GAP, 3 * float(np.median(np.diff(time))))
    return (moments >= time[0]) & (moments <= time[-1]) & (time[after] - time[after - 1] <= gap)


def rooms(trials: Sequence[Trial]) -> list[tuple[Triple, Triple]]:
    """Return each room in which a trial was flown, once."""
    return list(dict.fromkeys(trial.room for trial in trials if trial.room is not None))


def extent(trials: Sequence[Trial]) -> tuple[NDArray, NDArray]:
    """Return the lower and upper corner of all that is drawn, (3,) m each."""
    points = [trial.position[np.isfinite(trial.position).all(axis=1)] for trial in trials]
    points += [trial.reference.position for trial in trials if trial.reference is not None]
    points += [np.array(room) for room in rooms(trials)]
    everything = np.concatenate([*points, np.zeros((0, 3))])
    if len(everything) == 0:
        return np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.0, 1.0])
    return everything.min(axis=0), everything.max(axis=0)
