"""Measure what a planner costs as paths and grids grow together, at the same number of grid intervals a metre."""

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from cfplan.errors import InputError
from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.path import Path
from cfplan.geometry.random_paths import random_waypoints
from cfplan.geometry.yaw import YawMode
from cfplan.planners.task import PlanningTask
from cfplan.planning.planners import find_planner
from studies.runner.result import Column, StudyResult, Table, collect, quantile_columns
from studies.trials import find_box, find_limit_set, quantile_values, quantiles

SIZES = (100, 200, 500, 1000, 2000, 3000)
NODES_PER_METRE = 5  # as 100 intervals on a path of 20 m, the paper's mean length
LENGTH_ERROR = 0.05
_ATTEMPTS = 1000
COLUMNS = (
    Column("nodes", "intervals"),
    Column("length", "length", "m", ".0f", meaning="mean of the paths"),
    Column("repeats"),
    Column("solved", "solved", of="repeats"),
    Column("first_seconds", meaning="of the first call at this size, with all that is built for it"),
    *quantile_columns(
        "plan_seconds", "plan", "ms", ".1f", shown=("median",), meaning="the planner's call, processor time"
    ),
    Column("per_node", "per interval", "µs", ".1f", meaning="median"),
    Column("against_first", "against the first", "×", ".2f", meaning="time per interval"),
    Column("per_node_iteration", "per interval and iteration", "µs", ".2f", meaning="median"),
)


class Solve(NamedTuple):
    """One call of the planner."""

    seconds: float
    iterations: int  # 0 where the planner counts none
    solved: bool


def scaling(
    *,
    sizes: Sequence[int] = SIZES,
    repeats: int = 5,
    planner: str = "expert",
    box: str = "10x10x10",
    limits: str = "hardware",
    yaw: YawMode = YawMode.FREE,
    first_seed: int = 20_000,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> StudyResult:
    """Solve `repeats` random paths at each size. An interrupt ends it with the sizes done by then.

    Raises:
        InputError: an unknown planner, box or limit set, no repeats, or a size below 10.
    """
    if repeats < 1 or not sizes or min(sizes) < 10:
        raise InputError(
            "repeats must be at least 1, and sizes at least 10 intervals",
            where="sizes",
            hint="leave them out for the usual ones",
        )
    find_box(box)
    chosen, found = find_limit_set(limits), find_planner(planner)

    def solve(path: Path, nodes: int) -> Solve:
        begun = time.process_time()
        solution = found(PlanningTask(path, chosen.airframe, chosen.limits, nodes, yaw))
        seconds = time.process_time() - begun
        return Solve(seconds, int(solution.stats.get("iterations", 0)), solution.profile is not None)

    def measure() -> Iterator[dict[str, Any]]:
        per_node = None
        for number, nodes in enumerate(sizes):
            paths = [path_of_length(nodes / NODES_PER_METRE, box, first_seed + repeat) for repeat in range(repeats)]
            first, solves = solve(paths[0], nodes), []
            for repeat, path in enumerate(paths):
                solves.append(solve(path, nodes))
                progress(number * repeats + repeat + 1, len(sizes) * repeats)
            row = _row(nodes, paths, first, solves)
            per_node = per_node or row["per_node"]
            yield row | {"against_first": row["per_node"] / per_node}

    rows, interrupted = collect(measure())
    title = f"{planner}, box {box} m, {limits} limits, yaw {yaw.value}: cost as the grid grows"
    settings = {"planner": planner, "box": box, "limits": limits, "yaw": yaw.value, "first_seed": first_seed}
    return StudyResult("scaling", settings, (Table("sizes", title, COLUMNS, tuple(rows)),), interrupted=interrupted)


def path_of_length(length: float, box: str, seed: int) -> Path:
    """Return a min-snap path through random waypoints in the box, of that length, m, to within LENGTH_ERROR."""
    size = np.array(find_box(box))
    corners = np.stack([np.zeros(3), size])
    most = 3 + int(np.ceil(length / (0.3 * size.max())))
    for attempt in range(_ATTEMPTS):
        points = random_waypoints(np.random.SeedSequence([seed, attempt]), corners, (most, most))
        # A min-snap path is a little longer than its legs; count legs first, then measure.
        count = 3
        path = min_snap(points[:count])
        while path.length < (1 - LENGTH_ERROR) * length and count < most:
            count = min(count + max(1, int((length - path.length) / size.max())), most)
            path = min_snap(points[:count])
        if abs(path.length - length) <= LENGTH_ERROR * length:
            return path
    raise InputError(
        f"no random path of {length:g} m was found in the box {box}",
        where="length",
        hint="choose a longer path, or a smaller box",
    )


def _row(nodes: int, paths: Sequence[Path], first: Solve, solves: Sequence[Solve]) -> dict[str, Any]:
    seconds = quantile_values("plan_seconds", [solve.seconds for solve in solves])
    return {
        "nodes": nodes,
        "length": float(np.mean([path.length for path in paths])),
        "repeats": len(solves),
        "solved": sum(solve.solved for solve in solves),
        "first_seconds": first.seconds,
        **seconds,
        "per_node": seconds["plan_seconds_median"] / nodes,
        "per_node_iteration": quantiles(
            [solve.seconds / nodes / solve.iterations for solve in solves if solve.iterations]
        )[0],
    }
