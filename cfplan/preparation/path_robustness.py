"""Measure how a plan changes with its path: perturb the path, plan it again, and fly it in the dry run.

A slightly different path should give nearly the same flight. The paper tests its networks for this; here any planner
can be tested.
"""

import pathlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cfplan.errors import CfplanError, InputError
from cfplan.flight.setpoints.byte_check import check_bytes
from cfplan.flight.setpoints.encoding import encode_trajectory
from cfplan.geometry.path import Path
from cfplan.geometry.path_file import PathFile
from cfplan.geometry.random_paths import perturbed
from cfplan.planning.path.choice import chosen_path
from cfplan.planning.plan import plan
from cfplan.planning.plan_result import Plan
from cfplan.planning.planners import AUTO
from cfplan.safety.limits import Limits
from cfplan.simulation.dry_run import dry_run

SCALES = (0.001, 0.01, 0.1)  # m
SAMPLES = 500  # points along the path at which speed and yaw are compared


@dataclass(frozen=True, slots=True)
class PerturbedPlan:
    """One perturbed path, planned and rehearsed; NaN for missing values."""

    epsilon: float  # m
    draw: int
    reason: str = ""  # why planning, setpoints or dry run failed
    flight: float = np.nan  # s
    longer: float = np.nan  # relative change of the time of flight
    faster: float = np.nan  # m/s, largest change of speed at a fraction of the path, either way
    turned: float = np.nan  # rad, likewise of yaw
    deviation: float = np.nan  # m, in the dry run


@dataclass(frozen=True, slots=True)
class ScaleSummary:
    """All plans with perturbations of the same size; NaN for missing values."""

    epsilon: float  # m
    plans: int
    certified: int
    flown: int  # plans that passed the dry run
    longer: float  # relative change of the time of flight, mean
    longer_most: float  # the one farthest from 0
    faster: float  # m/s, mean over the draws of the largest change of speed
    turned: float  # rad, likewise of yaw
    deviation: float  # m, mean
    deviation_most: float  # m


@dataclass(frozen=True, slots=True)
class PathRobustness:
    """The results for a path, unperturbed and perturbed."""

    path: str
    length: float  # m
    flight: float  # s, of the unperturbed path
    interrupted: bool  # by the user: holds the results so far
    scales: tuple[ScaleSummary, ...]
    plans: tuple[PerturbedPlan, ...]


def path_robustness(
    path_file: PathFile,
    limits: Limits,
    *,
    scales: Sequence[float] = SCALES,
    draws: int = 10,
    seed: int = 0,
    planner: str = AUTO,
    models: tuple[pathlib.Path, ...] = (),
) -> PathRobustness:
    """Perturb a path `draws` times by at most each of `scales`, m; an interrupt returns the results so far.

    Raises:
        InputError: `draws` is below 1, or a scale is not a positive length.
        InfeasibleError: the unperturbed path cannot be planned.
    """
    if draws < 1 or not scales or not all(0.0 < scale < np.inf for scale in scales):
        raise InputError(
            "draws must be at least 1 and scales above 0 m", where="robustness", hint="leave them out for the defaults"
        )

    path_file, _ = chosen_path(path_file, limits, models=models)

    def planned(path: Path) -> Plan:
        factor, yaw = path_file.speed, path_file.yaw
        return plan(
            path, limits.airframe, limits, planner=planner, yaw=yaw, yaw_angle=path_file.yaw_angle,
            speed_factor=factor, models=models,
        )  # fmt: skip

    clean, done, interrupted = planned(path_file.path), [], False
    try:
        for k, scale in enumerate(scales):
            for draw in range(draws):
                moved = perturbed(path_file.path, scale, np.random.SeedSequence(seed, spawn_key=(k, draw)))
                done.append(_trial(scale, draw, moved, clean, planned))
    except KeyboardInterrupt:
        interrupted = True
    duration, length = clean.trajectory.duration, path_file.path.length
    return PathRobustness(path_file.name, length, duration, interrupted, tuple(_summaries(done)), tuple(done))


def _trial(scale: float, draw: int, path: Path, clean: Plan, planned: Callable[[Path], Plan]) -> PerturbedPlan:
    known: dict[str, Any] = {"epsilon": scale, "draw": draw}
    try:
        found = planned(path)
        before, after = _along(clean), _along(found)
        known |= {
            "flight": found.trajectory.duration,
            "longer": found.trajectory.duration / clean.trajectory.duration - 1.0,
            "faster": float(np.abs(after[0] - before[0]).max()),
            "turned": float(np.abs(after[1] - before[1]).max()),
        }
        encoded = encode_trajectory(found.trajectory)
        check_bytes(encoded, found.trajectory, found.limits.plan)
        run = dry_run(encoded, found.trajectory, found.limits)
        return PerturbedPlan(**known, reason=run.reason, deviation=run.deviation)
    except CfplanError as error:
        return PerturbedPlan(**known, reason=str(error))


def _along(found: Plan) -> tuple[np.ndarray, np.ndarray]:
    """Return speed, m/s, and yaw, rad, at the same fractions of the path, (SAMPLES,) each."""
    places = np.linspace(0.0, found.path.end, SAMPLES)
    state = found.trajectory.at(found.trajectory.time_at(places))
    return np.linalg.norm(state.velocity, axis=1), state.yaw


def _summaries(done: Sequence[PerturbedPlan]) -> Iterator[ScaleSummary]:
    for scale in dict.fromkeys(trial.epsilon for trial in done):
        own = [trial for trial in done if trial.epsilon == scale]
        longer, deviation = _finite(trial.longer for trial in own), _finite(trial.deviation for trial in own)
        yield ScaleSummary(
            scale,
            plans=len(own),
            certified=sum(bool(np.isfinite(trial.flight)) for trial in own),
            flown=sum(not trial.reason for trial in own),
            longer=float(longer.mean()),
            longer_most=float(longer[np.argmax(np.abs(longer))]),
            faster=float(_finite(trial.faster for trial in own).mean()),
            turned=float(_finite(trial.turned for trial in own).mean()),
            deviation=float(deviation.mean()),
            deviation_most=float(deviation.max()),
        )


def _finite(values: Iterable[float]) -> np.ndarray:
    """Return the finite values as an array, or [NaN] if there are none."""
    return np.array([value for value in values if np.isfinite(value)] or [np.nan])
