"""Compare the planners on the same paths: time to plan, time of flight, the certificate's verdict, the proven bound.

Every path is given to every planner before the next path is drawn, so that other load on the machine meets all alike.
Every other path meets them in the opposite order, so that processor caches do too.
Each planner first solves one path that does not count: compiling and building are not planning time.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from cfplan.errors import InputError
from cfplan.geometry.yaw import YawMode
from cfplan.safety.limit_sets import BOXES, LIMIT_SETS, LimitSet
from studies.runner.result import Column, StudyResult, Table, collect, detail_table, quantile_columns
from studies.trials import (
    BAD_PATH,
    Candidate,
    PlannerTrial,
    find_box,
    find_candidate,
    find_limit_set,
    path_trials,
    quantile_values,
    random_path,
    run_trial,
)

PLANNERS = ("learned, refined", "expert, refined", "toppquad", "convex", "convex, refined", "minsnap")
REFERENCE = "toppquad"  # whose solver's time, alone, the others' whole time is compared with
EXPERT = "expert, refined"  # with whose flights the others' are compared
TIME_COLUMNS = (
    Column("planner", "planner"),
    Column("paths"),
    *quantile_columns("plan_seconds", "plan", "ms", ".1f", meaning="the planner's call"),
    *quantile_columns("solve_seconds", "", "ms", ".1f", shown=()),
    *quantile_columns("repair_seconds", "", "ms", ".1f", shown=()),
    *quantile_columns(
        "whole_seconds", "to certificate", "ms", ".1f", shown=("median", "p90", "p99"),
        meaning="from the path to the certified trajectory",
    ),
    Column(
        "speed_up_median", "speed-up, median", "×", ".1f",
        meaning="time of TOPPQuad's solver alone over this planner's time to the certificate",
    ),
    Column("speed_up_p99", "speed-up, p99", "×", ".1f"),
)  # fmt: skip
FLIGHT_COLUMNS = (
    Column("planner", "planner"),
    Column("paths"),
    Column("certified", "certified", of="paths", meaning="after repair"),
    Column("unslowed", "as planned", of="paths", meaning="passed the dense certificate without repair"),
    Column("refined", "not slowed", of="paths", meaning="passed as planned or refined, not slowed as a whole"),
    Column("flight", "flight, median", "s", ".3f", meaning="certified travel time"),
    Column("against_expert_mean", "against expert, mean", "%", "+.2f", meaning="of the certified travel time"),
    Column("against_expert_p95", "against expert, p95", "%", "+.2f"),
    Column("against_reference"),
    Column(
        "worst_share_median", "worst share, median", "", ".2f", meaning="of any limit on the dense grid, before repair"
    ),
    Column("worst_share_max", "worst share, max", "", ".2f"),
    *quantile_columns("lost", "", "%", ".2f", shown=()),
    *quantile_columns(
        "gap", "gap", "%", ".2f", shown=("median", "p90"), meaning="certified travel time over the proven bound"
    ),
)


def bench(
    *,
    paths: int = 100,
    boxes: Sequence[str] = tuple(BOXES),
    limit_sets: Sequence[str] = tuple(LIMIT_SETS),
    planners: Sequence[str] = PLANNERS,
    nodes: int = 100,
    yaw: YawMode = YawMode.FREE,
    first_seed: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> StudyResult:
    """Run it. An interrupt ends it early with what is measured by then.

    Raises:
        InputError: an unknown planner, box or limit set, or no path at all.
    """
    if paths < 1:
        raise InputError("paths must be at least 1", where="paths", hint="give --paths 30, as is usual")
    for box in boxes:
        find_box(box)
    chosen = [find_limit_set(name) for name in limit_sets]
    candidates = {name: find_candidate(name) for name in planners}

    def measure() -> Iterator[list[PlannerTrial]]:
        done, total = 0, len(boxes) * len(chosen) * paths
        for limit_set in chosen:
            _warm_up(candidates, limit_set, nodes, yaw, first_seed)
            for box in boxes:
                for seed in range(first_seed, first_seed + paths):
                    yield path_trials(candidates, seed, box, limit_set, nodes=nodes, yaw=yaw)
                    done += 1
                    progress(done, total)

    measured, interrupted = collect(measure())
    trials = [trial for of_path in measured for trial in of_path]
    settings = {"nodes": nodes, "yaw": yaw.value, "first_seed": first_seed, "paths": paths, "planners": list(planners)}
    return StudyResult(
        "bench", settings, bench_tables(trials, settings), (detail_table("trials", trials),), interrupted
    )


def bench_tables(trials: Sequence[PlannerTrial], settings: Mapping[str, Any]) -> tuple[Table, ...]:
    """Return two tables for each box and limit set: time to plan, and the flights that were planned."""
    tables = []
    for box, limits in dict.fromkeys((trial.box, trial.limits) for trial in trials):
        group = [trial for trial in trials if (trial.box, trial.limits) == (box, limits)]
        rows = tuple(_row(name, group) for name in settings["planners"])
        of = f"box {box} m, {limits} limits, N = {settings['nodes']}, yaw {settings['yaw']}"
        tables += [
            Table(f"time-{box}-{limits}", f"Time to plan: {of}", TIME_COLUMNS, rows),
            Table(f"flight-{box}-{limits}", f"Planned flights: {of}", FLIGHT_COLUMNS, rows),
        ]
    return tuple(tables)


def _warm_up(candidates: Mapping[str, Candidate], chosen: LimitSet, nodes: int, yaw: YawMode, seed: int) -> None:
    box = next(iter(BOXES))
    path = random_path(seed, box)
    for name, candidate in candidates.items():
        run_trial(name, candidate, path, seed, box, chosen, nodes=nodes, yaw=yaw, bound=1.0)


def _row(name: str, group: Sequence[PlannerTrial]) -> dict[str, Any]:
    """Return one planner's figures. Times in s, shares and gaps as fractions."""
    mine = [trial for trial in group if trial.planner == name and trial.status != BAD_PATH]
    reference = {trial.seed: trial for trial in group if trial.planner == REFERENCE}
    expert = {trial.seed: trial for trial in group if trial.planner == EXPERT}
    whole = quantile_values("whole_seconds", [trial.whole_seconds for trial in mine])
    theirs = quantile_values("solve_seconds", [trial.solve_seconds for trial in reference.values()])
    ratios = [trial.certified_time / reference[trial.seed].certified_time for trial in mine if trial.seed in reference]
    slower = [trial.certified_time / expert[trial.seed].certified_time - 1 for trial in mine if trial.seed in expert]
    slower = [value for value in slower if np.isfinite(value)]
    shares = [trial.worst_share for trial in mine if np.isfinite(trial.worst_share)]
    return {
        "planner": name,
        "paths": len(mine),
        "certified": sum(trial.certified for trial in mine),
        "unslowed": sum(trial.unslowed for trial in mine),
        "refined": sum(trial.speed_factor == 1.0 for trial in mine),
        **quantile_values("plan_seconds", [trial.plan_seconds for trial in mine]),
        **quantile_values("solve_seconds", [trial.solve_seconds for trial in mine]),
        **quantile_values("repair_seconds", [trial.repair_seconds for trial in mine]),
        **whole,
        "speed_up_median": theirs["solve_seconds_median"] / whole["whole_seconds_median"],
        "speed_up_p99": theirs["solve_seconds_p99"] / whole["whole_seconds_p99"],
        "flight": quantile_values("flight", [trial.certified_time for trial in mine])["flight_median"],
        "worst_share_median": float(np.median(shares)) if shares else np.nan,
        "worst_share_max": max(shares, default=np.nan),
        **quantile_values("lost", [trial.lost for trial in mine if not trial.unslowed]),
        **quantile_values("gap", [trial.gap for trial in mine]),
        "against_reference": quantile_values("ratio", ratios)["ratio_median"] - 1.0,
        "against_expert_mean": float(np.mean(slower)) if slower else np.nan,
        "against_expert_p95": float(np.quantile(slower, 0.95)) if slower else np.nan,
    }
