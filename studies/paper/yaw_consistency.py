"""The paper's figure of yaw consistency (appendix): TOPPQuad on pairs of paths whose first waypoint differs a little.

Without the penalty on angular acceleration many yaws are as good as each other where the speed limit binds, and a
small change of the path may choose another.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from cfplan.errors import CfplanError, InputError
from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.path import Path
from cfplan.geometry.random_paths import random_waypoints
from cfplan.planners.baselines.toppquad import plan_toppquad
from cfplan.planners.baselines.toppquad_nlp import PENALTY
from cfplan.planners.expert.expert import plan_expert
from cfplan.planners.task import Planner
from cfplan.safety.limit_sets import BOXES, PAPER
from studies.runner.items import HERE, Progress, Running, work_table, work_through
from studies.paper.networks import WAYPOINTS
from studies.paper.trials import profile_by
from studies.runner.result import Column, StudyResult, Table, detail_table
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.timing import duration_of

PAPERS = 100  # pairs
MOVED = (0.1, 0.0, 0.0)  # m, the first waypoint
PLAIN, PENALISED, EXPERT = "TOPPQuad, λ = 0", f"TOPPQuad, λ = {PENALTY:g}", "expert"
WAYS: dict[str, Planner] = {
    PLAIN: partial(plan_toppquad, penalty=0.0),
    PENALISED: plan_toppquad,
    EXPERT: plan_expert,
}
EDGES = (0.0, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 4.0)  # rad, of the histogram of yaw


@dataclass(frozen=True, slots=True)
class Pair:
    """One path and the same with its first waypoint moved. NaN where there was nothing to measure."""

    planner: str
    seed: int
    reason: str = ""  # why there is no pair
    travel_time: float = np.nan  # s, of the path as it is
    h: float = np.nan  # largest difference at a node
    h_relative: float = np.nan  # the same, relative
    time: float = np.nan  # s, difference of travel times, absolute
    yaw: float = np.nan  # rad, largest difference at a node


def yaw_consistency(
    *,
    pairs: int = PAPERS,
    first_seed: int = 50_000,
    running: Running = HERE,
    progress: Progress = lambda done, total: None,
) -> StudyResult:
    """Solve `pairs` pairs of paths in each way.

    Raises:
        InputError: no pair.
    """
    if pairs < 1:
        raise InputError("pairs must be at least 1", where="pairs", hint="give --pairs 100, as in the paper")
    settings = {"pairs": pairs, "first_seed": first_seed, "moved": MOVED, "quick": pairs < PAPERS}
    seeds = {str(seed): seed for seed in range(first_seed, first_seed + pairs)}
    work = work_through("yaw-consistency", settings, _pairs, seeds, running, progress)
    found = [Pair(**pair) for value in work.values for pair in value]
    tables = (differences_table(found), histogram_table(found))
    details = (detail_table("pairs", found), work_table({"pair": (len(work.values), work.seconds)}))
    return StudyResult("yaw-consistency", settings, tables, details, work.interrupted)


def _pairs(seed: int) -> list[Pair]:
    """Return the pair of paths of that seed, planned in each way."""
    half = np.array(BOXES["10x10x10"]) / 2
    waypoints = random_waypoints(seed, np.array([-half, half]), (WAYPOINTS, WAYPOINTS))
    moved = waypoints + np.array([MOVED] + [(0.0, 0.0, 0.0)] * (WAYPOINTS - 1))
    return [_pair(name, seed, planner, min_snap(waypoints), min_snap(moved)) for name, planner in WAYS.items()]


def _pair(name: str, seed: int, planner: Planner, path: Path, moved: Path) -> Pair:
    profiles: list[SpeedProfile] = []
    for each in (path, moved):
        try:
            each.check()
            profiles.append(profile_by(planner)(each))
        except CfplanError as error:
            return Pair(name, seed, str(error))
    first, second = profiles
    times = [duration_of(each) for each in profiles]
    return Pair(
        name, seed,
        travel_time=times[0],
        h=float(np.abs(first.h - second.h).max()),
        h_relative=float(np.abs(second.h / first.h - 1.0).max()),
        time=abs(times[1] - times[0]),
        yaw=float(np.abs(first.yaw - second.yaw).max()),
    )  # fmt: skip


def differences_table(pairs: Sequence[Pair]) -> Table:
    """Return how far the two of a pair differ, in the median and at worst."""
    columns = (
        Column("planner", "planner"),
        Column("pairs"),
        Column("solved", "pairs solved", of="pairs"),
        Column("travel_time", "travel time, mean", "s", ".3f"),
        Column("h_median", "Δh, median", "", ".2f", meaning="largest at a node; h is large where γ' is small"),
        Column("h_relative_median", "Δh/h, median", "%", ".1f"),
        Column("time_median", "Δtime, median", "s", ".3f"),
        Column("time_p90", "p90", "s", ".3f"),
        Column("yaw_median", "Δyaw, median", "rad", ".3f"),
        Column("yaw_p90", "p90", "rad", ".3f"),
        Column("yaw_max", "largest", "rad", ".2f"),
    )  # fmt: skip
    rows = []
    for name in WAYS:
        own = [pair for pair in pairs if pair.planner == name]
        solved = [pair for pair in own if not pair.reason]
        rows.append({
            "planner": name, "pairs": len(own), "solved": len(solved),
            "travel_time": _quantile(solved, "travel_time", None),
            "h_median": _quantile(solved, "h", 0.5), "h_relative_median": _quantile(solved, "h_relative", 0.5),
            "time_median": _quantile(solved, "time", 0.5), "time_p90": _quantile(solved, "time", 0.9),
            "yaw_median": _quantile(solved, "yaw", 0.5), "yaw_p90": _quantile(solved, "yaw", 0.9),
            "yaw_max": _quantile(solved, "yaw", 1.0),
        })  # fmt: skip
    title = f"Pairs of paths, first waypoint moved by {MOVED[0]:g} m, {PAPER.limits.speed:g} m/s, yaw from [0, π/2]"
    return Table("differences", title, columns, tuple(rows))


def histogram_table(pairs: Sequence[Pair]) -> Table:
    """Return how many pairs differ in yaw by how much."""
    names = [*(f"{low:g} to {high:g}" for low, high in pairwise(EDGES)), f"above {EDGES[-1]:g}"]
    columns = (Column("planner", "Δyaw, rad"), *(Column(name, name) for name in names))
    rows: list[dict[str, Any]] = []
    for planner in WAYS:
        yaws = [pair.yaw for pair in pairs if pair.planner == planner and not pair.reason]
        counts = np.histogram(yaws, [*EDGES, np.inf])[0]
        rows.append({"planner": planner} | {name: int(count) for name, count in zip(names, counts, strict=True)})
    return Table("yaw-histogram", "Pairs by their largest difference of yaw", columns, tuple(rows))


def _quantile(pairs: Sequence[Pair], name: str, level: float | None) -> float:
    values = [getattr(pair, name) for pair in pairs]
    if not values:
        return float("nan")
    return float(np.mean(values) if level is None else np.quantile(values, level))
