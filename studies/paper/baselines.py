"""Make the paper's Table 3: TOPPQuad, networks and the shipped planner compared with planners of other kinds.

TOPPQuad, the paper's networks, the shipped planner and convex TOPP time the min-snap path; scaled min-snap scales the
path's original timing by one factor. The shipped planner also flies the path that it chooses itself. A method like
MFBOTrajectory optimises the times of the min-snap segments. A learned time allocation, like AllocNet, flies a different
path through a corridor around the min-snap path. All plans are flown by the geometric controller.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path as FilePath
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import CfplanError, InputError
from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.path import Path
from cfplan.geometry.path_file import path_through
from cfplan.geometry.random_paths import random_waypoints
from cfplan.learning.workers import pool
from cfplan.planners.baselines.convex import plan_convex
from cfplan.planners.baselines.min_snap import plan_min_snap
from cfplan.planners.baselines.toppquad import plan_toppquad
from cfplan.planners.expert.expert import plan_expert
from cfplan.planning.path.choice import fastest_path
from cfplan.safety.limit_sets import PAPER
from cfplan.simulation.geometric_flight import fly_geometric, thrust_violation
from cfplan.vehicle.trajectory import Trajectory
from studies.paper.bayesian_times import Budget, require_library
from studies.paper.corridors import ACCELERATION, SPEED, corridor_about, min_jerk, timed_path
from studies.paper.printed import BASELINES, paper_column
from studies.paper.segment_times import QUICK_BUDGET, bayesian_motion, timed_trajectory
from studies.paper.sequences import MAX_LENGTH
from studies.paper.time_allocation import TimeNetwork, allotted_times, time_label, train_times
from studies.paper.trained import WAYPOINTS, NetworkSettings, TrainedNetwork, paper_data
from studies.paper.training import SequenceOptions
from studies.paper.trials import (
    EXPERT,
    FAILED,
    FLOWN,
    PAPER_LAG,
    SAMPLE,
    TOPPQUAD,
    Plan,
    flown,
    network_plan,
    profile_by,
    shipped_profile,
    trajectory_by,
    warm_up,
)
from studies.runner.limits import limits_for
from studies.runner.options import option
from studies.runner.reductions import among, count, mean
from studies.runner.result import Column, Table, table
from studies.runner.study import Run, Study, Work

BOX = np.array([10.0, 10.0, 5.0])  # m, sides of the box in which waypoints are drawn
ENDLESS = 50.0  # m from the middle to walls that no path meets
NOISES = (0.0, 0.1)  # m, noise injected in training the table's LSTMs
QUICK_CORRIDORS = 6  # corridors for a quick training of the time allocation
CHOSEN = "the shipped planner, path chosen"
SHIPPED, ALLOCATION, CONVEX, MIN_SNAP = "the shipped planner", "AllocNet's kind", "convex TOPP", "scaled min-snap"
BAYESIAN = "MFBOTrajectory's kind"
DRAWN, DRAWN_PATHS, DRAWN_POINTS = (SHIPPED, BAYESIAN, ALLOCATION), 3, 121  # the figure's


class Course(NamedTuple):
    """The input of all planners: waypoints, and the min-snap path through them."""

    waypoints: NDArray  # (K, 3) m
    path: Path
    seed: int


Ask = Callable[[Course], Trajectory]  # raises CfplanError if there is no plan


@dataclass(frozen=True, slots=True)
class Settings(NetworkSettings):
    """The paths to plan, and the training of the time allocation."""

    paths: int = option(50, "Random paths.", least=1)
    corridors: int = option(2000, "Corridors that the time allocation learns from.", least=2)
    seed: int = option(60_000, "Seed of the first path.", least=0)


@dataclass(frozen=True, slots=True)
class BaselineTrial:
    """One path, planned and flown. NaN where there was nothing to measure."""

    planner: str
    seed: int
    reason: str = ""  # why there is no flight; empty if there is one
    seconds: float = np.nan  # s of processor time to plan
    travel_time: float = np.nan  # s
    length: float = np.nan  # m, of the flown path
    deviation: float = np.nan  # m, LOST where it failed
    thrust_least: float = np.nan  # N, least planned thrust of a motor
    thrust_most: float = np.nan  # N
    violation: float = np.nan  # N, planned beyond a motor's range, mean over time
    top_speed: float = np.nan  # m/s, planned
    retraining: float | None = None  # s of processor time, once per vehicle and limits
    points: list[list[float]] = field(default_factory=list)  # m, along the motion, if it appears in the figure

    @property
    def speed(self) -> float:
        """Return the mean speed, m/s."""
        return self.length / self.travel_time


def work(settings: Settings, run: Run) -> Work:
    """Return one case per path; networks and the time allocation are trained if necessary.

    Raises InputError if scikit-learn is not installed, and as `paper_data`.
    """
    require_library()
    data = paper_data(settings, run, [SequenceOptions(epsilon=epsilon) for epsilon in NOISES], paths=1)
    first = 10 * settings.seed  # seed of the corridors' paths, which differ from the flown ones
    corridors = range(first, first + (QUICK_CORRIDORS if settings.quick else settings.corridors))
    labels, training = dict[int, NDArray | None](), 0.0
    with pool(run.workers, run.scheduler) as measured:
        for seed, label, seconds in measured(_label, corridors):
            labels[seed], training = label, training + seconds
            run.progress(len(labels), len(corridors))
    begun = time.process_time()
    own = [corridor_about(random_course(seed).path) for seed in corridors]
    allocation = train_times(own, [labels[seed] for seed in corridors])
    training += time.process_time() - begun
    retraining = {each.name: each.trained.seconds for each in data.networks} | {ALLOCATION: training}
    asked, budget = partial(planners, data.networks, allocation), QUICK_BUDGET if settings.quick else Budget()
    seeds = {str(seed): seed for seed in range(settings.seed, settings.seed + settings.paths)}
    drawn = range(settings.seed, settings.seed + DRAWN_PATHS)
    return Work(seeds, partial(measure, asked, budget, retraining, drawn), BaselineTrial, data.identity)


def _label(seed: int) -> tuple[int, NDArray | None, float]:
    """Return the seed of a path, the label of the corridor around it, and the processor time, s."""
    begun = time.process_time()
    label = time_label(corridor_about(random_course(seed).path))
    return seed, label, time.process_time() - begun


def planners(networks: Sequence[TrainedNetwork], allocation: TimeNetwork, budget: Budget) -> dict[str, Ask]:
    """Return the planners by name, in the order of the table."""
    on_the_path = {
        TOPPQUAD: profile_by(plan_toppquad), EXPERT: profile_by(plan_expert),
        **{each.name: network_plan(each) for each in networks}, SHIPPED: shipped_profile,
    }  # fmt: skip
    return {name: _on_the_path(plan) for name, plan in on_the_path.items()} | {
        CHOSEN: along_chosen_path,
        ALLOCATION: lambda course: _allotted(course.path, allocation),
        BAYESIAN: lambda course: bayesian_motion(course.waypoints, budget=budget, seed=course.seed),
        CONVEX: _on_the_path(profile_by(plan_convex)),
        MIN_SNAP: _on_the_path(profile_by(plan_min_snap)),
    }


def random_course(seed: int) -> Course:
    """Return the waypoints and path of a seed; paths longer than MAX_LENGTH are drawn again, as for training."""
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


def _on_the_path(plan: Plan) -> Ask:
    timed = trajectory_by(plan)
    return lambda course: timed(course.path)


def along_chosen_path(course: Course) -> Trajectory:
    """Return the shipped planner's flight along the path that it chooses through the waypoints."""
    limits = limits_for(FilePath())
    endless = replace(limits.space, low=(-ENDLESS,) * 3, high=(ENDLESS,) * 3)
    of_paper = replace(limits, airframe=PAPER.airframe, plan=PAPER.limits, space=endless)
    chosen = fastest_path(path_through(course.waypoints), of_paper).path
    return trajectory_by(shipped_profile)(chosen)


def _allotted(path: Path, network: TimeNetwork) -> Trajectory:
    corridor = corridor_about(path)
    times = allotted_times(network, corridor)
    return timed_trajectory(timed_path(min_jerk(corridor, times), times))


def measure(
    asked: Callable[[Budget], dict[str, Ask]], budget: Budget, retraining: Mapping[str, float], drawn: Sequence[int],
    seed: int,
) -> list[BaselineTrial]:  # fmt: skip
    """Plan and fly one path with each planner; keep the motions of paths whose seed is in `drawn`, for the figure."""
    course, trials, quick = random_course(seed), [], asked(QUICK_BUDGET)
    for name, ask in asked(budget).items():
        warm_up(name, partial(quick[name], course))
        begun = BaselineTrial(name, seed, retraining=retraining.get(name))
        trials.append(_flown(ask, course, begun, keep=name in DRAWN and seed in drawn))
    return trials


def _flown(ask: Ask, course: Course, trial: BaselineTrial, *, keep: bool) -> BaselineTrial:
    begun = time.process_time()
    try:
        trajectory = ask(course)
    except CfplanError as error:
        return replace(trial, reason=str(error))
    trial = _judged(trajectory, replace(trial, seconds=time.process_time() - begun))
    if keep and flown(trial):
        path = trajectory.path
        return replace(trial, points=np.round(path(np.linspace(0.0, path.end, DRAWN_POINTS)), 3).tolist())
    return trial


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


_paper = partial(paper_column, BASELINES, by=("planner",))
COLUMNS = (
    Column("planner", "planner"),
    Column("paths", value=count()),
    Column("deviation", "largest deviation", "m", ".3f", meaning="mean over flights that did not fail",
           value=among(flown, mean("deviation"))),
    _paper("deviation", unit="m", spec=".3f"),
    Column("thrust_least", "least thrust", "N", ".2f", meaning="planned, of a motor; mean over paths",
           value=mean("thrust_least")),
    Column("thrust_most", "greatest", "N", ".2f", value=mean("thrust_most")),
    _paper("thrusts", meaning="least and greatest, N"),
    Column("violation", "thrust violation", "N", ".4f", meaning="planned beyond a motor's range, mean over time",
           value=mean("violation")),
    _paper("violation", unit="N", spec=".3f"),
    Column("travel_time", "time", "s", ".2f", meaning="mean, as are length and speed", value=mean("travel_time")),
    _paper("time", unit="s", spec=".2f"),
    Column("length", "length", "m", ".1f", value=mean("length")),
    _paper("length", unit="m", spec=".1f"),
    Column("speed", "mean speed", "m/s", ".2f", value=mean("speed")),
    _paper("speed", unit="m/s", spec=".2f"),
    FAILED,
    _paper("failed", unit="%", spec=".0f"),
    Column("seconds", "compute", "ms", ".1f", meaning="mean of the processor's time, one thread",
           value=mean("seconds")),
    _paper("seconds", unit="ms", spec=".0f"),
    Column("retraining", "training", "s", ".0f", meaning="of the processor, once for a vehicle and its limits"),
)  # fmt: skip


def tables(settings: Settings, rows: list[BaselineTrial]) -> Iterator[Table]:
    """Yield the paper's Table 3 beside the paper's numbers."""
    title = (
        f"Paths through {WAYPOINTS} random waypoints in {' × '.join(f'{side:g}' for side in BOX)} m, "
        f"{SPEED:g} m/s, motor lag {PAPER_LAG:g} s; {ALLOCATION}: {ACCELERATION:g} m/s²"
    )
    yield table("baselines", title, COLUMNS, rows, by=("planner",))


STUDY = Study(Settings, work, tables, "-o results/baselines.json")
