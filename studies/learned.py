"""Try the learned planner on unseen paths: the network alone, repaired, flown in the dry run, and how long that takes.

Every path is also planned by the expert, whose certified flight is what travel times are compared with.
"""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cfplan.errors import CfplanError, InputError, NotCertifiedError
from cfplan.flight.setpoints.encoding import check_bytes, encode_trajectory
from cfplan.geometry.path import Path
from cfplan.learning.learned import plan_learned
from cfplan.planners.baselines.convex import plan_convex
from cfplan.planners.expert.expert import plan_expert
from cfplan.planners.task import PlanningTask
from cfplan.planning.repair import refine, repair, slow
from cfplan.safety.certificate import certify
from cfplan.safety.limit_sets import BOXES, LIMIT_SETS, LimitSet
from cfplan.safety.limits import FlightLimits, Ladder
from cfplan.simulation.dry_run import dry_run
from studies.runner.result import Column, StudyResult, Table, collect, detail_table
from studies.trials import find_box, find_limit_set, random_path
from cfplan.vehicle.trajectory import Trajectory

NODES = 100
MOST_LISTED = 100  # flights out of the ordinary in the JSON
PAPER_LAG = 0.005  # s, time constant of the motors in the paper's simulations
LOST = 1.0  # m from its place: a dry run that gets there has failed
FEW_METRES = (17.0, 23.0)  # paths of about 20 m, whose planning time is listed apart
CONVEX_EVERY = 10  # paths, of which one is planned by the convex planner too


@dataclass(frozen=True, slots=True)
class UnseenFlight:
    """One path that the network was not trained on. Times of flight in s; NaN where there was nothing to measure."""

    box: str
    limits: str
    seed: int
    length: float  # m
    reason: str = ""  # why there is no certified flight, empty where there is
    expert_planned: float = np.nan  # before repair
    expert: float = np.nan
    network: float = np.nan  # before repair
    worst_share: float = np.nan  # of a limit, before repair
    learned: float = np.nan
    speed_factor: float = np.nan  # on the whole; 1: not slowed
    seconds: tuple[float, float, float] = (np.nan,) * 3
    """To plan, to refine and certify, to encode and certify the bytes; of the processor."""
    expert_seconds: float = np.nan  # to plan and certify
    bytes_refused: str = ""  # why its setpoints would not be sent, empty where they would
    deviation: float = np.nan  # m, in the dry run
    dry_run: str = ""  # why it failed, empty where it passed or could not be flown
    deviation_at_paper_lag: float = np.nan  # m, with the motors' time constant of the paper's simulations
    dry_run_at_paper_lag: str = ""
    convex_refined: float = np.nan  # the convex planner's, of one path in CONVEX_EVERY
    convex_slowed: float = np.nan


FIGURES = (
    Column("group", "figure"),
    Column("paths", "paths", goal="1000"),
    Column(
        "network_mean", "network against expert: mean", "%", "+.2f", goal="±0.4 %",
        meaning="travel times before repair",
    ),
    Column("network_p95", "network against expert: p95 of the absolute", "%", "+.2f", goal="1.5 %"),
    Column("certified", "certified", goal="all"),
    Column("as_planned", "certified as the network has it"),
    Column("refined", "certified when refined"),
    Column("slowed", "certified when slowed"),
    Column(
        "against_mean", "certified against expert: mean", "%", "+.3f", goal="+0.05 %", meaning="travel times after it"
    ),
    Column("against_p95", "certified against expert: p95", "%", "+.3f", goal="+0.2 %"),
    Column("against_max", "certified against expert: max", "%", "+.3f", goal="+0.5 %"),
    Column("expert_mean", "expert repaired: mean", "%", "+.2f", goal="+0.3 %", meaning="over its time before repair"),
    Column("expert_max", "expert repaired: max", "%", "+.2f", goal="+3 %"),
    Column(
        "convex_refined", "convex, refined, against learned: median", "%", "+.2f", goal="simulation +5 %",
        meaning=f"one path in {CONVEX_EVERY}; the goal is how much slower it should be at least",
    ),
    Column("convex_slowed", "convex, slowed, against learned: median", "%", "+.2f"),
    Column(
        "bytes_refused", "bytes refused", goal="0", meaning="beyond 32.7 m, or a thrust that leans too far"
    ),
    Column("flown"),
    Column(
        "failed", "dry run: failed", of="flown", goal="0",
        meaning=f"{LOST:g} m from its place, or did not arrive",
    ),
    Column("deviation_median", "dry run: median deviation", "cm", ".1f", goal="hardware 6 cm"),
    Column("deviation_max", "dry run: largest deviation", "cm", ".1f"),
    Column("paper_failed", "motor lag of 5 ms: failed", of="flown", meaning="as in the paper's simulations"),
    Column("paper_deviation_median", "motor lag of 5 ms: median deviation", "cm", ".1f"),
    Column("paper_deviation_max", "motor lag of 5 ms: largest deviation", "cm", ".1f"),
    Column(
        "certified_median", "path to certificate: median", "ms", ".1f", meaning="plan, refine, certify; processor time"
    ),
    Column("certified_p99", "path to certificate: p99", "ms", ".1f"),
    Column("expert_median", "path to certificate: the expert's median", "ms", ".1f"),
    Column(
        "speed_up", "path to certificate: expert's time over learned, median", "×", ".2f", goal="4×, at least",
        meaning="path by path",
    ),
    Column("seconds_median", "path to bytes: median", "ms", ".1f", meaning="the same and encoding, certified"),
    Column("seconds_p99", "path to bytes: p99", "ms", ".1f"),
    Column("few", "path to bytes, about 20 m: paths"),
    Column("few_seconds_median", "path to bytes, about 20 m: median", "ms", ".1f", goal="4 ms"),
    Column("few_seconds_p99", "path to bytes, about 20 m: p99", "ms", ".1f", goal="9 ms"),
)  # fmt: skip


def learned_study(
    *,
    paths: int = 1000,
    boxes: Sequence[str] = tuple(BOXES),
    limit_sets: Sequence[str] = tuple(LIMIT_SETS),
    first_seed: int = 20_000,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> StudyResult:
    """Fly `paths` random paths from each box with each limit set. An interrupt ends it early with what is measured.

    Raises:
        InputError: an unknown box or limit set, no path at all, or no model for a limit set.
    """
    if paths < 1:
        raise InputError("paths must be at least 1", where="paths", hint="give --paths 30, as is usual")
    for box in boxes:
        find_box(box)
    pairs = [(box, find_limit_set(name)) for name in limit_sets for box in boxes]
    flights, interrupted = collect(fly_unseen(pairs, range(first_seed, first_seed + paths), progress))
    odd = [f for f in flights if f.reason or f.bytes_refused or f.dry_run or f.speed_factor < 1.0]
    return StudyResult(
        "learned",
        {"first_seed": first_seed, "paths": paths, "nodes": NODES, "yaw": "fixed"},
        (figures_table(flights),),
        (detail_table("out-of-the-ordinary", odd[:MOST_LISTED]),),
        interrupted,
    )


def figures_table(flights: Sequence[UnseenFlight]) -> Table:
    """Return the figures of each box with each limit set."""
    groups = dict.fromkeys((f.box, f.limits) for f in flights)
    rows = [
        {"group": f"{box} m, {limits}"} | _figures([f for f in flights if (f.box, f.limits) == (box, limits)])
        for box, limits in groups
    ]
    title = f"The learned planner on unseen paths, N = {NODES}, yaw fixed"
    return Table("figures", title, FIGURES, tuple(rows), across=True)


def _figures(flights: Sequence[UnseenFlight]) -> dict[str, float]:
    """Return the figures of one group, by the keys of FIGURES."""
    done = [f for f in flights if not f.reason]
    certified = [f for f in done if np.isfinite(f.learned)]
    network = _numbers(f.network / f.expert_planned - 1 for f in certified)
    against = _numbers(f.learned / f.expert - 1 for f in certified)
    repaired = _numbers(f.expert / f.expert_planned - 1 for f in done)
    flown = [f for f in certified if np.isfinite(f.deviation) or f.dry_run]
    passed = sum(f.worst_share <= 1.0 for f in certified)
    slowed = sum(f.speed_factor < 1.0 for f in certified)
    few = [f for f in flown if FEW_METRES[0] <= f.length <= FEW_METRES[1]]
    convex = [f for f in certified if np.isfinite(f.convex_refined)]
    deviation, quick = _numbers(f.deviation for f in flown), _numbers(f.deviation_at_paper_lag for f in flown)
    seconds, few_seconds = (_numbers(sum(f.seconds) for f in part) for part in (flown, few))
    to_certificate = _numbers(sum(f.seconds[:2]) for f in certified)
    return {
        "paths": len(flights),
        "network_mean": network.mean(),
        "network_p95": np.quantile(np.abs(network), 0.95),
        "certified": len(certified),
        "as_planned": passed,
        "refined": len(certified) - passed - slowed,
        "slowed": slowed,
        "against_mean": against.mean(),
        "against_p95": np.quantile(against, 0.95),
        "against_max": against.max(),
        "expert_mean": repaired.mean(),
        "expert_max": repaired.max(),
        "convex_refined": np.median(_numbers(f.convex_refined / f.learned - 1 for f in convex)),
        "convex_slowed": np.median(_numbers(f.convex_slowed / f.learned - 1 for f in convex)),
        "bytes_refused": sum(bool(f.bytes_refused) for f in done),
        "flown": len(flown),
        "failed": sum(bool(f.dry_run) for f in flown),
        "deviation_median": np.median(deviation),
        "deviation_max": deviation.max(),
        "paper_failed": sum(bool(f.dry_run_at_paper_lag) for f in flown),
        "paper_deviation_median": np.median(quick),
        "paper_deviation_max": quick.max(),
        "certified_median": np.quantile(to_certificate, 0.5),
        "certified_p99": np.quantile(to_certificate, 0.99),
        "expert_median": np.median(_numbers(f.expert_seconds for f in certified)),
        "speed_up": np.median(_numbers(f.expert_seconds / sum(f.seconds[:2]) for f in certified)),
        "seconds_median": np.quantile(seconds, 0.5),
        "seconds_p99": np.quantile(seconds, 0.99),
        "few": len(few),
        "few_seconds_median": np.quantile(few_seconds, 0.5),
        "few_seconds_p99": np.quantile(few_seconds, 0.99),
    }


def _numbers(values: Iterable[float]) -> np.ndarray:
    """Return them as an array that is never empty."""
    array = np.array(list(values), dtype=float)
    return array if len(array) else np.array([np.nan])


def fly_unseen(
    pairs: Sequence[tuple[str, LimitSet]],
    seeds: Sequence[int],
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Iterator[UnseenFlight]:
    """Plan and dry-run the random path of each seed in each box with each limit set."""
    for number, (box, chosen) in enumerate(pairs):
        _fly(random_path(seeds[0] - 1, box), box, seeds[0] - 1, chosen)  # compiles and loads
        for count, seed in enumerate(seeds):
            yield _fly(random_path(seed, box), box, seed, chosen)
            progress(number * len(seeds) + count + 1, len(pairs) * len(seeds))


def _fly(path: Path, box: str, seed: int, chosen: LimitSet) -> UnseenFlight:
    airframe, limits = chosen.airframe, chosen.limits
    values: dict[str, Any] = {"box": box, "limits": chosen.name, "seed": seed, "length": path.length}
    try:
        path.check()
        task = PlanningTask(path, airframe, limits, NODES)
        begun = time.process_time()
        expert = plan_expert(task)
        if expert.profile is None:
            return UnseenFlight(**values | {"reason": f"expert: {expert.reason or expert.status}"})
        best = repair(task, expert.profile)
        values |= {"expert_planned": best.before, "expert": best.trajectory.duration}
        values["expert_seconds"] = time.process_time() - begun

        begun = time.process_time()
        solution = plan_learned(task)
        planned = time.process_time()
        if solution.profile is None:
            return UnseenFlight(**values | {"reason": f"learned: {solution.reason or solution.status}"})
        found = refine(task, solution.profile)
        repaired = time.process_time()
        values |= {"network": found.before, "learned": found.trajectory.duration, "speed_factor": found.speed_factor}
        raw = certify(Trajectory(path, solution.profile, airframe), limits)
        values["worst_share"] = raw.worst.share
        if seed % CONVEX_EVERY == 0:
            values |= _convex(task)

        values["seconds"] = planned - begun, repaired - planned, np.nan
        encoding = time.process_time()
        encoded = encode_trajectory(found.trajectory)
        check_bytes(encoded, found.trajectory, limits)
        values["seconds"] = planned - begun, repaired - planned, time.process_time() - encoding
        run = dry_run(encoded, found.trajectory, airframe, _lost_alone())
        values |= {"deviation": run.deviation, "dry_run": run.reason}
        quick = dry_run(encoded, found.trajectory, replace(airframe, motor_time_constant=PAPER_LAG), _lost_alone())
        values |= {"deviation_at_paper_lag": quick.deviation, "dry_run_at_paper_lag": quick.reason}
        return UnseenFlight(**values)
    except NotCertifiedError as error:  # the bytes: a place too far out for a packet
        return UnseenFlight(**values | {"bytes_refused": str(error)})
    except CfplanError as error:
        return UnseenFlight(**values | {"reason": str(error)})


def _convex(task: PlanningTask) -> dict[str, float]:
    """Return the times of flight of the convex planner's profile, repaired in either way; none without a profile."""
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
