"""The learned planner on unseen paths: the network alone, repaired, flown in the dry run, and how long that takes.

Every path is also planned by the expert, whose certified flight is what travel times are compared with.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from cfplan.errors import CfplanError, InputError, NotCertifiedError
from cfplan.flight.setpoints.encoding import encode_checked
from cfplan.geometry.path import Path
from cfplan.learning.learned import plan_learned
from cfplan.planners.baselines.convex import plan_convex
from cfplan.planners.expert.expert import plan_expert
from cfplan.planners.task import PlanningTask
from cfplan.planning.repair import repair, slow
from cfplan.safety.certificate import certify
from cfplan.safety.limit_sets import BOXES, LIMIT_SETS, LimitSet
from cfplan.safety.limits import FlightLimits, Ladder
from cfplan.simulation.dry_run import dry_run
from cfplan.studies.machine import Machine, this_machine
from cfplan.studies.trials import find_box, find_limit_set, random_path
from cfplan.vehicle.trajectory import Trajectory

NODES = 100
MOST_TOLD = 100
# flights out of the ordinary in the JSON
PAPER_LAG = 0.005
# s, time constant of the motors in the paper's simulations
LOST = 1.0
# m off its place: a dry run that gets there has failed
FEW_METRES = (17.0, 23.0)
# paths of about 20 m, whose planning time is told apart
CONVEX_EVERY = 10
# paths, of which one is planned by the convex planner too
COLUMNS = ("figure", "goal")
# then a column for each box and limit set


@dataclass(frozen=True, slots=True)
class Flight:
    """One path. Times of flight in s; NaN where there was nothing to measure."""

    box: str
    limits: str
    seed: int
    length: float
    # m
    reason: str
    # why there is no certified flight, empty where there is
    expert_planned: float
    # before repair
    expert: float
    network: float
    # before repair
    worst_share: float
    # of a limit, before repair
    learned: float
    speed_factor: float  # on the whole; 1: not slowed
    seconds: tuple[float, float, float]
    # to plan, to repair and certify, to encode and certify the bytes
    bytes_refused: str
    # why its setpoints would not be sent, empty where they would
    deviation: float
    # m, in the dry run
    dry_run: str
    # why it failed, empty where it passed or could not be flown
    deviation_at_paper_lag: float
    # the same with the motors' time constant of the paper's simulations
    dry_run_at_paper_lag: str
    convex_refined: float
    convex_slowed: float
    # the convex planner's, of one path in CONVEX_EVERY


@dataclass(frozen=True, slots=True)
class LearnedStudy:
    """A whole run."""

    command: str
    machine: Machine
    first_seed: int
    interrupted: bool
    seconds: float
    flights: tuple[Flight, ...]

    def to_dict(self) -> dict[str, Any]:
        """For JSON: the table, and each flight that is out of the ordinary."""
        rest = {name: value for name, value in asdict(self).items() if name != "flights"}
        odd = [asdict(f) for f in self.flights if f.reason or f.bytes_refused or f.dry_run or f.speed_factor < 1.0]
        ((_, columns, rows),) = self.tables()
        table = [dict(zip(columns, row, strict=True)) for row in rows]
        return rest | {"table": table, "flights": odd[:MOST_TOLD]}

    def tables(self) -> list[tuple[str, list[str], list[list[str]]]]:
        """Title, columns and rows of the one table: figures down, groups across."""
        names = dict.fromkeys((f.box, f.limits) for f in self.flights)
        groups = [_figures([f for f in self.flights if (f.box, f.limits) == name]) for name in names]
        rows = [[what, goal, *(group[what] for group in groups)] for what, goal in GOALS.items()] if groups else []
        columns = [*COLUMNS, *(f"{box} m, {limits}" for box, limits in names)]
        return [(f"the learned planner on unseen paths, N = {NODES}, yaw fixed", columns, rows)]


GOALS = MappingProxyType(
    {
        "paths": "1000",
        "network against expert: mean": "±0.4 %",
        "network against expert: p95 of the absolute": "1.5 %",
        "certified": "all",
        "certified as the network has it": "",
        "certified when refined": "",
        "certified when slowed": "",
        "certified against expert: mean": "+0.5 %; simulation +1 %",
        "certified against expert: p95": "+1.5 %; simulation +4 %",
        "certified against expert: max": "",
        "expert repaired: mean": "+0.3 %",
        "expert repaired: max": "+3 %",
        "convex, refined, against learned: median": "simulation +5 %",
        "convex, slowed, against learned: median": "",
        "bytes refused": "0",
        "dry run: failed": "0",
        "dry run: median deviation": "hardware 6 cm",
        "dry run: largest deviation": "",
        "motor lag of 5 ms: failed": "",
        "motor lag of 5 ms: median deviation": "",
        "motor lag of 5 ms: largest deviation": "",
        "path to bytes: median": "",
        "path to bytes: p99": "",
        "path to bytes, about 20 m: paths": "",
        "path to bytes, about 20 m: median": "10 ms",
        "path to bytes, about 20 m: p99": "25 ms",
    }
)
# what each figure should not exceed; convex should be that much slower at least


def _figures(flights: list[Flight]) -> dict[str, str]:
    """Of one group, by the names of GOALS."""
    done = [f for f in flights if not f.reason]
    certified = [f for f in done if np.isfinite(f.learned)]
    network = _numbers(f.network / f.expert_planned - 1 for f in certified)
    against = _numbers(f.learned / f.expert - 1 for f in certified)
    repair_cost = _numbers(f.expert / f.expert_planned - 1 for f in done)
    flown = [f for f in certified if np.isfinite(f.deviation) or f.dry_run]
    passed = sum(f.worst_share <= 1.0 for f in certified)
    slowed = sum(f.speed_factor < 1.0 for f in certified)
    few = [f for f in flown if FEW_METRES[0] <= f.length <= FEW_METRES[1]]
    convex = [
        _numbers(time / f.learned - 1 for f in certified if np.isfinite(time := getattr(f, name)))
        for name in ("convex_refined", "convex_slowed")
    ]
    deviation, quick = _numbers(f.deviation for f in flown), _numbers(f.deviation_at_paper_lag for f in flown)
    times = [1e3 * _numbers(sum(f.seconds) for f in part) for part in (flown, few)]
    texts = [
        f"{len(flights)}", _percent(np.mean(network)), _percent(np.quantile(np.abs(network), 0.95)),
        f"{len(certified)}", f"{passed}", f"{len(certified) - passed - slowed}", f"{slowed}",
        _percent(np.mean(against)), _percent(np.quantile(against, 0.95)), _percent(np.max(against)),
        _percent(np.mean(repair_cost)), _percent(np.max(repair_cost)),
        *(_percent(np.median(share)) for share in convex),
        f"{sum(bool(f.bytes_refused) for f in done)}",
        f"{sum(bool(f.dry_run) for f in flown)} of {len(flown)}",
        *(f"{100 * of(deviation):.1f} cm" for of in (np.median, np.max)),
        f"{sum(bool(f.dry_run_at_paper_lag) for f in flown)} of {len(flown)}",
        *(f"{100 * of(quick):.1f} cm" for of in (np.median, np.max)),
        *(_milliseconds(np.quantile(times[0], level)) for level in (0.5, 0.99)),
        f"{len(few)}", *(_milliseconds(np.quantile(times[1], level)) for level in (0.5, 0.99)),
    ]  # fmt: skip
    return dict(zip(GOALS, texts, strict=True))


def _numbers(values: Iterable[float]) -> np.ndarray:
    """As an array that is never empty."""
    array = np.array(list(values), dtype=float)
    return array if len(array) else np.array([np.nan])


def _percent(value: Any) -> str:
    return f"{100 * float(value):+.2f} %" if np.isfinite(value) else "–"


def _milliseconds(value: Any) -> str:
    return f"{float(value):.1f} ms" if np.isfinite(value) else "–"


def learned_study(
    *,
    paths: int = 1000,
    boxes: Sequence[str] = tuple(BOXES),
    limit_sets: Sequence[str] = tuple(LIMIT_SETS),
    first_seed: int = 20_000,
    command: str = "",
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> LearnedStudy:
    """`paths` random paths from each box with each limit set. An interrupt ends it early with what is measured.

    Raises:
        InputError: an unknown box or limit set, no path at all, or no model for a limit set.
    """
    if paths < 1:
        raise InputError(f"{paths} paths are none", where="paths")
    for box in boxes:
        find_box(box)
    pairs = [(box, find_limit_set(name)) for name in limit_sets for box in boxes]
    begun, interrupted, flights = time.perf_counter(), False, []
    try:
        for number, (box, chosen) in enumerate(pairs):
            for seed in range(first_seed - 1, first_seed + paths):
                flight = _fly(random_path(seed, box), box, seed, chosen)
                if seed >= first_seed:  # the first one compiles and loads
                    flights.append(flight)
                    progress(number * paths + seed - first_seed + 1, len(pairs) * paths)
    except KeyboardInterrupt:
        interrupted = True
    seconds = time.perf_counter() - begun
    return LearnedStudy(command, this_machine(), first_seed, interrupted, seconds, tuple(flights))


def _fly(path: Path, box: str, seed: int, chosen: LimitSet) -> Flight:
    airframe, limits = chosen.airframe, chosen.limits
    values: dict[str, Any] = dict.fromkeys(("expert_planned", "expert", "network", "worst_share", "learned"), np.nan)
    values |= dict.fromkeys(
        ("speed_factor", "deviation", "deviation_at_paper_lag", "convex_refined", "convex_slowed"), np.nan
    ) | {"seconds": (np.nan,) * 3}
    values |= dict.fromkeys(("reason", "bytes_refused", "dry_run", "dry_run_at_paper_lag"), "")
    values |= {"box": box, "limits": chosen.name, "seed": seed, "length": path.length}
    try:
        path.check()
        task = PlanningTask(path, airframe, limits, NODES)
        expert = plan_expert(task)
        if expert.profile is None:
            return Flight(**values | {"reason": f"expert: {expert.reason or expert.status}"})
        best = repair(task, expert.profile)
        values |= {"expert_planned": best.before, "expert": best.trajectory.duration}

        begun = time.perf_counter()
        solution = plan_learned(task)
        planned = time.perf_counter()
        if solution.profile is None:
            return Flight(**values | {"reason": f"learned: {solution.reason or solution.status}"})
        found = repair(task, solution.profile)
        repaired = time.perf_counter()
        values |= {"network": found.before, "learned": found.trajectory.duration, "speed_factor": found.speed_factor}
        raw = certify(Trajectory(path, solution.profile, airframe), limits)
        values["worst_share"] = raw.worst.share
        if seed % CONVEX_EVERY == 0:
            values |= _convex(task)

        encoding = time.perf_counter()
        encoded = encode_checked(found.trajectory, limits)
        values["seconds"] = planned - begun, repaired - planned, time.perf_counter() - encoding
        run = dry_run(encoded, found.trajectory, airframe, _lost_alone())
        values |= {"deviation": run.deviation, "dry_run": run.reason}
        quick = dry_run(encoded, found.trajectory, replace(airframe, motor_time_constant=PAPER_LAG), _lost_alone())
        values |= {"deviation_at_paper_lag": quick.deviation, "dry_run_at_paper_lag": quick.reason}
        return Flight(**values)
    except NotCertifiedError as error:  # the bytes: a place too far out for a packet
        return Flight(**values | {"bytes_refused": str(error)})
    except CfplanError as error:
        return Flight(**values | {"reason": str(error)})


def _convex(task: PlanningTask) -> dict[str, float]:
    """Times of flight of the convex planner's profile, repaired in either way; none where it has no profile."""
    profile = plan_convex(task).profile
    if profile is None:
        return {}
    refined, slowed = repair(task, profile), slow(task, profile)
    return {"convex_refined": refined.trajectory.duration, "convex_slowed": slowed.trajectory.duration}


def _lost_alone() -> FlightLimits:
    never = Ladder(np.inf, np.inf, np.inf)
    return FlightLimits(
        deviation=Ladder(LOST, LOST, LOST), fence=never, speed=never, acceleration=never, angular_velocity=never,
        patience=1.0,
    )  # fmt: skip
