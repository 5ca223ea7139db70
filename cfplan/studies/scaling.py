"""What a planner costs as paths and grids grow together, at the same number of grid intervals a metre."""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from cfplan.errors import InputError
from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.path import Path
from cfplan.geometry.random_paths import random_waypoints
from cfplan.geometry.yaw import YawMode
from cfplan.planners.task import Planner, PlanningTask
from cfplan.planning.planners import find_planner
from cfplan.studies.machine import Machine, this_machine
from cfplan.studies.trials import find_box, find_limit_set, quantiles

SIZES = (100, 200, 500, 1000, 2000, 3000)
NODES_PER_METRE = 5  # as 100 intervals on a path of 20 m, the paper's mean length
LENGTH_ERROR = 0.05
_ATTEMPTS = 1000
COLUMNS = ("intervals", "length", "solved", "solve median", "per interval", "against the first", "per iteration")


@dataclass(frozen=True, slots=True)
class Size:
    """All repeats at one number of intervals."""

    nodes: int
    length: float
    # m, mean
    repeats: int
    solved: int
    first_seconds: float
    # of the first call at this size, with whatever is built for it
    plan_seconds: tuple[float, float, float]
    # median, p90, p99
    per_node: float
    # s, median
    per_node_iteration: float
    # s, median; NaN where the planner counts no iterations
    against_first: float
    # per node, over that of the first size

    def texts(self) -> list[str]:
        """As COLUMNS has it."""
        return [
            f"{self.nodes}", f"{self.length:.0f} m", f"{self.solved}/{self.repeats}",
            f"{1e3 * self.plan_seconds[0]:.1f} ms", f"{1e6 * self.per_node:.1f} µs", f"{self.against_first:.2f}×",
            f"{1e6 * self.per_node_iteration:.2f} µs",
        ]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Scaling:
    """A whole run."""

    command: str
    machine: Machine
    planner: str
    box: str
    limits: str
    yaw: str
    interrupted: bool
    sizes: tuple[Size, ...]

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)

    def tables(self) -> list[tuple[str, list[str], list[list[str]]]]:
        """Title, columns and rows of the one table."""
        title = f"{self.planner}, box {self.box} m, {self.limits} limits, yaw {self.yaw}: cost as the grid grows"
        return [(title, list(COLUMNS), [size.texts() for size in self.sizes])]


def scaling(
    *,
    sizes: Sequence[int] = SIZES,
    repeats: int = 5,
    planner: str = "expert",
    box: str = "10x10x10",
    limits: str = "hardware",
    yaw: YawMode = YawMode.FREE,
    first_seed: int = 20_000,
    command: str = "",
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Scaling:
    """Solve `repeats` random paths at each size. An interrupt ends it with the sizes done by then.

    Raises:
        InputError: an unknown planner, box or limit set, no repeats, or a size below 10.
    """
    if repeats < 1 or not sizes or min(sizes) < 10:
        raise InputError("scaling needs one repeat and sizes of ten intervals at least", where="sizes")
    find_box(box)
    chosen, found = find_limit_set(limits), find_planner(planner)
    done: list[Size] = []
    interrupted = False
    try:
        for number, nodes in enumerate(sizes):
            paths = [path_of_length(nodes / NODES_PER_METRE, box, first_seed + repeat) for repeat in range(repeats)]

            def solve(planner: Planner, path: Path, nodes: int = nodes) -> tuple[float, int, bool]:
                begun = time.perf_counter()
                solution = planner(PlanningTask(path, chosen.airframe, chosen.limits, nodes, yaw))
                seconds = time.perf_counter() - begun
                return seconds, int(solution.stats.get("iterations", 0)), solution.profile is not None

            first = solve(found, paths[0])[0]
            runs = []
            for repeat, path in enumerate(paths):
                runs.append(solve(found, path))
                progress(number * repeats + repeat + 1, len(sizes) * repeats)
            done.append(_size(nodes, paths, first, runs, done))
    except KeyboardInterrupt:
        interrupted = True
    return Scaling(command, this_machine(), planner, box, limits, yaw.value, interrupted, tuple(done))


def path_of_length(length: float, box: str, seed: int) -> Path:
    """A min-snap path through random waypoints in the box, of that length, m, to within LENGTH_ERROR."""
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
    raise InputError(f"no random path of {length:g} m was found in the box {box}", where="length")


def _size(nodes: int, paths: list[Path], first: float, runs: list[tuple[float, int, bool]], before: list[Size]) -> Size:
    seconds = quantiles([run[0] for run in runs])
    per_node = seconds[0] / nodes
    return Size(
        nodes=nodes,
        length=float(np.mean([path.length for path in paths])),
        repeats=len(runs),
        solved=sum(run[2] for run in runs),
        first_seconds=first,
        plan_seconds=seconds,
        per_node=per_node,
        per_node_iteration=quantiles([run[0] / nodes / run[1] for run in runs if run[1]])[0],
        against_first=per_node / before[0].per_node if before else 1.0,
    )
