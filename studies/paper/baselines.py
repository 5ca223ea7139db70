"""The paper's Table 3: planners of other kinds on the same waypoints, each flown by the geometric controller.

TOPPQuad, the paper's networks, the planner that ships and convex TOPP time the min-snap path, and scaled min-snap flies
it at one factor on its timing. MFBOTrajectory's kind searches for other times of the min-snap segments. A learned time
allocation flies a path of its own through the corridor about it, as AllocNet does.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path as FilePath
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import CfplanError, InputError
from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.path import Path
from cfplan.geometry.random_paths import random_waypoints
from cfplan.learning.paper.bayesian_times import Budget, require_library
from cfplan.learning.paper.sequences import MAX_LENGTH
from cfplan.learning.paper.time_allocation import TimeNetwork, allotted_times, time_label, train_times
from cfplan.learning.paper.training import SequenceOptions
from cfplan.planners.baselines.convex import plan_convex
from cfplan.planners.baselines.corridors import (
    ACCELERATION,
    SPEED,
    box_corners,
    corridor_about,
    min_jerk,
    timed_path,
)
from cfplan.planners.baselines.min_snap import plan_min_snap
from cfplan.planners.baselines.toppquad import plan_toppquad
from cfplan.planners.expert.expert import plan_expert
from cfplan.safety.limit_sets import PAPER
from cfplan.simulation.geometric_flight import LOST, fly_geometric, thrust_violation
from studies.runner.items import HERE, Progress, Running, work_table, work_through
from studies.paper.architectures import training_steps
from studies.paper.networks import (
    DATA,
    NETWORKS,
    WAYPOINTS,
    TrainedNetwork,
    identities,
    paper_data,
    trained_networks,
)
from studies.paper.printed import BASELINES
from studies.paper.segment_times import QUICK_BUDGET, bayesian_motion, timed_trajectory
from studies.paper.trials import (
    EXPERT,
    FLOWN,
    PAPER_LAG,
    SAMPLE,
    TOPPQUAD,
    Plan,
    finite_mean,
    network_plan,
    profile_by,
    shipped_profile,
    trajectory_by,
)
from studies.runner.result import Column, StudyResult, Table, detail_table
from cfplan.vehicle.trajectory import Trajectory

BOX = np.array([10.0, 10.0, 5.0])  # m, where waypoints are drawn
NOISES = (0.0, 0.1)  # m, of the LSTMs of the table
CORRIDORS, QUICK_CORRIDORS = 2000, 6  # that the time allocation learns from
SHIPPED, ALLOCATION, CONVEX, MIN_SNAP = "the shipped planner", "AllocNet's kind", "convex TOPP", "scaled min-snap"
BAYESIAN = "MFBOTrajectory's kind"
DRAWN, DRAWN_PATHS, DRAWN_POINTS = (SHIPPED, BAYESIAN, ALLOCATION), 3, 121  # of the figure


class Course(NamedTuple):
    """What planners are asked: waypoints, and the min-snap path through them."""

    waypoints: NDArray  # (K, 3) m
    path: Path
    seed: int


_WARM: set[str] = set()  # planners that this process has asked before
Ask = Callable[[Course], Trajectory]  # raises CfplanError where there is none


@dataclass(frozen=True, slots=True)
class BaselineTrial:
    """One path, planned and flown. NaN where there was nothing to measure."""

    planner: str
    seed: int
    reason: str = ""  # why there is no flight
    seconds: float = np.nan  # of the processor, to plan
    travel_time: float = np.nan  # s
    length: float = np.nan  # m, of the path that is flown
    deviation: float = np.nan  # m, LOST where it failed
    thrust_least: float = np.nan  # N, planned, of a motor
    thrust_most: float = np.nan  # N
    violation: float = np.nan  # N, planned beyond a motor's range, mean over time
    top_speed: float = np.nan  # m/s, planned

    @property
    def failed(self) -> bool:
        """Return whether there was no flight, or one that crashed or was LOST."""
        return not self.deviation < LOST


def baselines(
    *,
    paths: int = 50,
    corridors: int = CORRIDORS,
    first_seed: int = 60_000,
    data: FilePath = DATA,
    networks: FilePath = NETWORKS,
    epochs: int | None = None,
    quick: bool = False,
    running: Running = HERE,
    progress: Progress = lambda done, total: None,
) -> StudyResult:
    """Plan and fly `paths` random paths by each planner; networks are trained if need be.

    The time allocation learns from `corridors` corridors about other paths.

    Raises:
        InputError: no path or corridor, no such dataset, or no scikit-learn.
    """
    if paths < 1:
        raise InputError("paths must be at least 1", where="paths", hint="give --paths 50, as in the paper")
    require_library()
    wanted = [SequenceOptions(epsilon=epsilon) for epsilon in NOISES]
    budget = QUICK_BUDGET if quick else Budget()
    corridors = QUICK_CORRIDORS if quick else corridors
    settings = {
        "paths": paths, "first_seed": first_seed, "corridors": corridors, "motor_lag": PAPER_LAG, "quick": quick,
    }  # fmt: skip
    with paper_data(data, networks, 1, epochs=epochs, quick=quick) as material:
        trained = trained_networks(material, wanted, progress)
        labels = work_through(
            "baselines, corridors", settings, _label, {str(k): 10 * first_seed + k for k in range(corridors)},
            running.beside("corridors"), progress,
        )  # fmt: skip
        begun = time.process_time()
        allocation = _time_network(10 * first_seed, labels.values)
        training = labels.seconds + time.process_time() - begun
        asked = Asked(tuple(trained), allocation, budget)
        seeds = {str(seed): seed for seed in range(first_seed, first_seed + paths)}
        known = settings | {"networks": identities(trained)}
        work = work_through("baselines", known, partial(_flown_on, asked, first_seed), seeds, running, progress)
    retraining = {each.name: each.training_seconds for each in trained} | {ALLOCATION: training}
    trials = [BaselineTrial(**trial) for value in work.values for trial in value["trials"]]
    drawn = [row for value in work.values for row in value["drawn"]]
    table = baselines_table(trials, list(asked.planners()), retraining)
    steps = training_steps(trained, len(material.learned_from.rows)) | {
        "corridor": (corridors, training), "path": (len(work.values), work.seconds),
    }  # fmt: skip
    details = (detail_table("trials", trials), detail_table("drawn", drawn), work_table(steps))
    return StudyResult("baselines", settings, (table,), details, work.interrupted)


@dataclass(frozen=True, slots=True)
class Asked:
    """What the planners of the table are made of."""

    networks: tuple[TrainedNetwork, ...]
    allocation: TimeNetwork
    budget: Budget

    def planners(self) -> dict[str, Ask]:
        """Return the planners by name, in the order of the table."""
        on_the_path = {
            TOPPQUAD: profile_by(plan_toppquad), EXPERT: profile_by(plan_expert),
            **{each.name: network_plan(each) for each in self.networks}, SHIPPED: shipped_profile,
        }  # fmt: skip
        return {name: _on_the_path(plan) for name, plan in on_the_path.items()} | {
            ALLOCATION: lambda course: _allotted(course.path, self.allocation),
            BAYESIAN: lambda course: bayesian_motion(course.waypoints, budget=self.budget, seed=course.seed),
            CONVEX: _on_the_path(profile_by(plan_convex)),
            MIN_SNAP: _on_the_path(profile_by(plan_min_snap)),
        }


def random_course(seed: int) -> Course:
    """Return the waypoints and path of that seed; one that leaves the box by far is drawn anew, as for training."""
    attempt = 0
    while True:
        drawn = np.random.SeedSequence(seed, spawn_key=(attempt,))
        waypoints = random_waypoints(drawn, np.array([-BOX / 2, BOX / 2]), (WAYPOINTS, WAYPOINTS))
        path = min_snap(waypoints)
        with suppress(InputError):
            path.check()
            if path.length <= MAX_LENGTH:
                return Course(waypoints, path, seed)
        attempt += 1


def _label(seed: int) -> list[float] | None:
    """Return the label of the corridor about a path, which is none of those that are flown."""
    label = time_label(corridor_about(random_course(seed).path))
    return None if label is None else label.tolist()


def _time_network(first: int, labels: Sequence[list[float] | None]) -> TimeNetwork:
    corridors = [corridor_about(random_course(first + k).path) for k in range(len(labels))]
    return train_times(corridors, [None if label is None else np.array(label) for label in labels])


def _on_the_path(plan: Plan) -> Ask:
    timed = trajectory_by(plan)
    return lambda course: timed(course.path)


def _allotted(path: Path, network: TimeNetwork) -> Trajectory:
    corridor = corridor_about(path)
    times = allotted_times(network, corridor)
    return timed_trajectory(timed_path(min_jerk(corridor, times), times))


Flown = tuple[BaselineTrial, Trajectory | None]


def _flown_on(asked: Asked, first_seed: int, seed: int) -> dict[str, Any]:
    """Plan and fly one path by each planner; of the first paths, keep what the figure shows."""
    course, flown = random_course(seed), []
    for name, ask in asked.planners().items():
        if name not in _WARM:
            quickly = replace(asked, budget=QUICK_BUDGET).planners()[name]
            with suppress(CfplanError):
                quickly(course)  # loads and compiles
            _WARM.add(name)
        flown.append(_flown(ask, course, BaselineTrial(name, seed)))
    drawn = list(_drawn(flown, course)) if seed < first_seed + DRAWN_PATHS else []
    return {"trials": [trial for trial, _ in flown], "drawn": drawn}


def _flown(ask: Ask, course: Course, trial: BaselineTrial) -> Flown:
    begun = time.process_time()
    try:
        trajectory = ask(course)
    except CfplanError as error:
        return replace(trial, reason=str(error)), None
    seconds = time.process_time() - begun
    return _judged(trajectory, replace(trial, seconds=seconds)), trajectory


def _judged(trajectory: Trajectory, trial: BaselineTrial) -> BaselineTrial:
    state = trajectory.at(np.arange(0.0, trajectory.duration, SAMPLE))
    return replace(
        trial,
        travel_time=trajectory.duration,
        length=trajectory.path.length,
        deviation=fly_geometric(trajectory, FLOWN).deviation,
        thrust_least=float(state.motor_thrust.min()),
        thrust_most=float(state.motor_thrust.max()),
        violation=thrust_violation(state.motor_thrust, PAPER.airframe),
        top_speed=float(np.linalg.norm(state.velocity, axis=1).max()),
    )


def _drawn(trials: Sequence[Flown], course: Course) -> Iterator[dict[str, Any]]:
    """Yield what the figure shows of a path: the motions of DRAWN, and AllocNet's boxes by their corners."""
    own = {trial.planner: trajectory for trial, trajectory in trials if not trial.failed}
    if not own:
        return
    yield {"seed": course.seed, "what": "waypoints", "points": _millimetres(course.waypoints)}
    for name in DRAWN:
        trajectory = own.get(name)
        if trajectory is not None:
            path = trajectory.path
            points = _millimetres(path(np.linspace(0.0, path.end, DRAWN_POINTS)))
            yield {"seed": course.seed, "what": name, "points": points}
    for corners in box_corners(corridor_about(course.path)):
        yield {"seed": course.seed, "what": "box", "points": _millimetres(corners)}


def _millimetres(points: NDArray) -> list[list[float]]:
    return [[round(float(value), 3) for value in point] for point in points]


def baselines_table(trials: Sequence[BaselineTrial], names: Sequence[str], retraining: Mapping[str, float]) -> Table:
    """Return the paper's Table 3 with the paper's numbers beside."""
    columns = (
        Column("planner", "planner"),
        Column("paths"),
        Column("deviation", "largest deviation", "m", ".3f", meaning="mean over flights that did not fail"),
        Column("paper_deviation", "paper", "m", ".3f"),
        Column("thrust_least", "least thrust", "N", ".2f", meaning="planned, of a motor; mean over paths"),
        Column("thrust_most", "greatest", "N", ".2f"),
        Column("paper_thrusts", "paper", meaning="least and greatest, N"),
        Column("violation", "thrust violation", "N", ".4f", meaning="planned beyond a motor's range, mean over time"),
        Column("paper_violation", "paper", "N", ".3f"),
        Column("travel_time", "time", "s", ".2f", meaning="mean, as are length and speed"),
        Column("paper_time", "paper", "s", ".2f"),
        Column("length", "length", "m", ".1f"),
        Column("paper_length", "paper", "m", ".1f"),
        Column("speed", "mean speed", "m/s", ".2f"),
        Column("paper_speed", "paper", "m/s", ".2f"),
        Column("failed", "failures", of="paths", meaning=f"no plan, a crash, or {LOST:g} m from its place"),
        Column("paper_failed", "paper", "%", ".0f"),
        Column("seconds", "compute", "ms", ".1f", meaning="mean of the processor's time, one thread"),
        Column("paper_seconds", "paper", "ms", ".0f"),
        Column("retraining", "training", "s", ".0f", meaning="of the processor, once for a vehicle and its limits"),
    )  # fmt: skip
    rows = [
        _row([trial for trial in trials if trial.planner == name]) | {"retraining": retraining.get(name)}
        for name in names
        if any(trial.planner == name for trial in trials)
    ]
    title = (
        f"Paths through {WAYPOINTS} random waypoints in {' × '.join(f'{side:g}' for side in BOX)} m, "
        f"{SPEED:g} m/s, motor lag {PAPER_LAG:g} s; {ALLOCATION}: {ACCELERATION:g} m/s²"
    )
    return Table("baselines", title, columns, tuple(rows))


def _row(own: Sequence[BaselineTrial]) -> dict[str, Any]:
    printed = BASELINES.get(own[0].planner)
    flown = [trial for trial in own if not trial.failed]
    return {
        "planner": own[0].planner,
        "paths": len(own),
        "deviation": finite_mean(trial.deviation for trial in flown),
        "thrust_least": finite_mean(trial.thrust_least for trial in own),
        "thrust_most": finite_mean(trial.thrust_most for trial in own),
        "violation": finite_mean(trial.violation for trial in own),
        "travel_time": finite_mean(trial.travel_time for trial in own),
        "length": finite_mean(trial.length for trial in own),
        "speed": finite_mean(trial.length / trial.travel_time for trial in own),
        "failed": sum(trial.failed for trial in own),
        "seconds": finite_mean(trial.seconds for trial in own),
        "paper_deviation": printed.deviation if printed else None,
        "paper_thrusts": f"{printed.thrust_least:g} / {printed.thrust_most:g}" if printed else None,
        "paper_violation": printed.violation if printed else None,
        "paper_time": printed.travel_time if printed else None,
        "paper_length": printed.length if printed else None,
        "paper_speed": printed.speed if printed else None,
        "paper_failed": printed.failures if printed else None,
        "paper_seconds": printed.seconds if printed else None,
    }
