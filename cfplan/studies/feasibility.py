"""Do the expert's solutions hold between the grid points too? Counted over many random paths.

Each path is planned, certified as it is, then slowed where it must be. Failures are kept with their seed and reason.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from cfplan.errors import InputError
from cfplan.geometry.yaw import YawMode
from cfplan.planners.task import PlanningTask
from cfplan.safety.limit_sets import BOXES, LIMIT_SETS
from cfplan.studies.machine import Machine, this_machine
from cfplan.studies.trials import (
    BAD_PATH,
    Trial,
    find_box,
    find_candidate,
    find_limit_set,
    path_trials,
    quantiles,
    random_path,
)

COLUMNS = (
    "box", "limits", "paths", "solved", "certified as planned", "after slowing", "worst share", "time lost: mean",
    "p99", "gap to bound: median", "solve median", "p99 ",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Group:
    """One box with one limit set."""

    box: str
    limits: str
    paths: int
    bad_paths: int
    # random paths with a cusp, drawn and not counted
    solved: int
    unslowed: int
    certified: int
    worst_share: float
    # the largest before slowing
    mean_lost: float
    # share of flight time that slowing cost, over all paths
    lost: tuple[float, float, float]
    # over the slowed ones: median, p90, p99
    gap: tuple[float, float, float]
    plan_seconds: tuple[float, float, float]

    def texts(self) -> list[str]:
        """As COLUMNS has it."""
        return [
            self.box, self.limits, f"{self.paths}", f"{self.solved}",
            f"{self.unslowed} ({self._percent(self.unslowed)})",
            f"{self.certified} ({self._percent(self.certified)})", f"{self.worst_share:.3f}",
            f"{100 * self.mean_lost:.4f} %", f"{100 * self.lost[2]:.2f} %", f"{100 * self.gap[0]:.2f} %",
            f"{1e3 * self.plan_seconds[0]:.1f} ms", f"{1e3 * self.plan_seconds[2]:.1f} ms",
        ]  # fmt: skip

    def _percent(self, count: int) -> str:
        return f"{100 * count / max(self.paths, 1):.1f} %"


@dataclass(frozen=True, slots=True)
class Feasibility:
    """A whole run."""

    command: str
    machine: Machine
    planner: str
    nodes: int
    yaw: str
    first_seed: int
    interrupted: bool
    seconds: float
    groups: tuple[Group, ...]
    failures: tuple[dict[str, Any], ...]
    # trials that were not certified as planned, with box and limit set

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)

    def tables(self) -> list[tuple[str, list[str], list[list[str]]]]:
        """Title, columns and rows of the one table."""
        title = f"{self.planner}, N = {self.nodes}, yaw {self.yaw}: dense feasibility"
        return [(title, list(COLUMNS), [group.texts() for group in self.groups])]


def dense_feasibility(
    *,
    paths: int = 1000,
    boxes: Sequence[str] = tuple(BOXES),
    limit_sets: Sequence[str] = tuple(LIMIT_SETS),
    planner: str = "expert",
    nodes: int = 100,
    yaw: YawMode = YawMode.FREE,
    first_seed: int = 10_000,
    command: str = "",
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Feasibility:
    """`paths` random paths, shared out evenly over the boxes and limit sets. An interrupt ends it early.

    Raises:
        InputError: an unknown planner, box or limit set, or fewer paths than groups.
    """
    pairs = [(box, find_limit_set(name)) for box in boxes for name in limit_sets]
    for box in boxes:
        find_box(box)
    if paths < len(pairs):
        raise InputError(f"{paths} paths do not fill {len(pairs)} groups", where="paths")
    found = find_candidate(planner)
    each, begun, interrupted = paths // len(pairs), time.perf_counter(), False
    measured: dict[tuple[str, str], list[Trial]] = {}
    try:
        for number, (box, chosen) in enumerate(pairs):
            warm = random_path(first_seed, box)
            found.plan(PlanningTask(warm, chosen.airframe, chosen.limits, nodes, yaw))
            trials = measured.setdefault((box, chosen.name), [])
            for count in range(each):
                seed = first_seed + count
                trials += path_trials({planner: found}, seed, box, chosen, nodes=nodes, yaw=yaw)
                progress(number * each + count + 1, each * len(pairs))
    except KeyboardInterrupt:
        interrupted = True
    return Feasibility(
        command=command,
        machine=this_machine(),
        planner=planner,
        nodes=nodes,
        yaw=yaw.value,
        first_seed=first_seed,
        interrupted=interrupted,
        seconds=time.perf_counter() - begun,
        groups=tuple(_group(box, limits, trials) for (box, limits), trials in measured.items()),
        failures=tuple(
            {"box": box, "limits": limits, **asdict(trial)}
            for (box, limits), trials in measured.items()
            for trial in trials
            if not trial.unslowed
        ),
    )


def _group(box: str, limits: str, trials: list[Trial]) -> Group:
    counted = [trial for trial in trials if trial.status != BAD_PATH]
    certified = [trial for trial in counted if trial.certified]
    shares = [trial.worst_share for trial in certified]
    return Group(
        box=box,
        limits=limits,
        paths=len(counted),
        bad_paths=len(trials) - len(counted),
        solved=sum(trial.status == "SOLVED" for trial in counted),
        unslowed=sum(trial.unslowed for trial in counted),
        certified=len(certified),
        worst_share=max(shares, default=float("nan")),
        mean_lost=sum(trial.lost for trial in certified) / max(len(certified), 1),
        lost=quantiles([trial.lost for trial in certified if not trial.unslowed]),
        gap=quantiles([trial.gap for trial in certified]),
        plan_seconds=quantiles([trial.plan_seconds for trial in counted]),
    )
