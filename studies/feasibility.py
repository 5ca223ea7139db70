"""Count over random paths whether a planner's solutions keep every limit between the grid points too.

Each path is planned, certified as it is, then slowed where it must be. Failures are kept with their seed and reason.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from cfplan.errors import InputError
from cfplan.geometry.yaw import YawMode
from cfplan.planners.task import PlanningTask
from cfplan.safety.limit_sets import BOXES, LIMIT_SETS
from studies.runner.result import Column, StudyResult, Table, collect, detail_table, quantile_columns
from studies.trials import (
    BAD_PATH,
    PlannerTrial,
    find_box,
    find_candidate,
    find_limit_set,
    path_trials,
    quantile_values,
    random_path,
)

COLUMNS = (
    Column("box", "box"),
    Column("limits", "limits"),
    Column("paths", "paths"),
    Column("bad_paths", meaning="random paths with a cusp, drawn and not counted"),
    Column("solved", "solved", of="paths"),
    Column("unslowed", "certified as planned", of="paths"),
    Column("certified", "after slowing", of="paths"),
    Column("worst_share", "worst share", "", ".3f", meaning="of any limit, before slowing"),
    Column(
        "mean_lost", "time lost, mean", "%", ".4f", meaning="share of flight time that slowing cost, over all paths"
    ),
    *quantile_columns("lost", "time lost", "%", ".2f", shown=("p99",), meaning="over the slowed paths"),
    *quantile_columns(
        "gap", "gap", "%", ".2f", shown=("median",), meaning="certified travel time over the proven bound"
    ),
    *quantile_columns("plan_seconds", "plan", "ms", ".1f", meaning="the planner's call"),
)


def dense_feasibility(
    *,
    paths: int = 1000,
    boxes: Sequence[str] = tuple(BOXES),
    limit_sets: Sequence[str] = tuple(LIMIT_SETS),
    planner: str = "expert",
    nodes: int = 100,
    yaw: YawMode = YawMode.FREE,
    first_seed: int = 10_000,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> StudyResult:
    """Plan `paths` random paths, shared out evenly over the boxes and limit sets. An interrupt ends it early.

    Raises:
        InputError: an unknown planner, box or limit set, or fewer paths than groups.
    """
    pairs = [(box, find_limit_set(name)) for box in boxes for name in limit_sets]
    for box in boxes:
        find_box(box)
    if paths < len(pairs):
        raise InputError(
            f"paths must be at least {len(pairs)}, one for each box and limit set",
            where="paths",
            hint="give more paths, or fewer boxes and limit sets",
        )
    candidate, each = find_candidate(planner), paths // len(pairs)

    def measure() -> Iterator[PlannerTrial]:
        for number, (box, chosen) in enumerate(pairs):
            candidate.plan(PlanningTask(random_path(first_seed, box), chosen.airframe, chosen.limits, nodes, yaw))
            for count in range(each):
                yield from path_trials({planner: candidate}, first_seed + count, box, chosen, nodes=nodes, yaw=yaw)
                progress(number * each + count + 1, each * len(pairs))

    trials, interrupted = collect(measure())
    return StudyResult(
        "feasibility",
        {"planner": planner, "nodes": nodes, "yaw": yaw.value, "first_seed": first_seed, "paths": each * len(pairs)},
        (_table(trials, f"{planner}, N = {nodes}, yaw {yaw.value}: dense feasibility"),),
        (detail_table("failures", [trial for trial in trials if not trial.unslowed]),),
        interrupted,
    )


def _table(trials: Sequence[PlannerTrial], title: str) -> Table:
    groups = dict.fromkeys((trial.box, trial.limits) for trial in trials)
    rows = [_row(box, limits, [t for t in trials if (t.box, t.limits) == (box, limits)]) for box, limits in groups]
    return Table("groups", title, COLUMNS, tuple(rows))


def _row(box: str, limits: str, trials: Sequence[PlannerTrial]) -> dict[str, Any]:
    counted = [trial for trial in trials if trial.status != BAD_PATH]
    certified = [trial for trial in counted if trial.certified]
    return {
        "box": box,
        "limits": limits,
        "paths": len(counted),
        "bad_paths": len(trials) - len(counted),
        "solved": sum(trial.status == "SOLVED" for trial in counted),
        "unslowed": sum(trial.unslowed for trial in counted),
        "certified": len(certified),
        "worst_share": max((trial.worst_share for trial in certified), default=float("nan")),
        "mean_lost": sum(trial.lost for trial in certified) / max(len(certified), 1),
        **quantile_values("lost", [trial.lost for trial in certified if not trial.unslowed]),
        **quantile_values("gap", [trial.gap for trial in certified]),
        **quantile_values("plan_seconds", [trial.plan_seconds for trial in counted]),
    }
