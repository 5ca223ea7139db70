"""All planners on the same paths in one run: time to plan, time of flight, the certificate's word, the proven bound.

Every path is given to every planner before the next path is drawn, so that what else the machine does meets all alike.
Each planner first solves one path that does not count: compiling and building are no planning time.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from cfplan.errors import InputError
from cfplan.geometry.yaw import YawMode
from cfplan.safety.limit_sets import BOXES, LIMIT_SETS, LimitSet
from cfplan.studies.machine import Machine, this_machine
from cfplan.studies.trials import (
    BAD_PATH,
    Candidate,
    Trial,
    find_box,
    find_candidate,
    find_limit_set,
    path_trials,
    quantiles,
    random_path,
    run_trial,
)

PLANNERS = ("learned, refined", "expert, refined", "toppquad", "convex", "convex, refined", "minsnap")
REFERENCE = "toppquad"
# whose solver's time, alone, the others' whole time is compared with
EXPERT = "expert, refined"
# with whose flights the others' are compared
COLUMNS = (
    "planner", "certified", "as planned", "not slowed", "plan median", "p99", "to certificate median", "p90", "p99 ",
    "speed-up median", "p99  ", "flight median", "against expert mean", "p95", "worst share median", "max",
    "gap median", "p90 ",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Row:
    """One planner in one box with one limit set. Times in seconds, shares and gaps as fractions."""

    box: str
    limits: str
    planner: str
    paths: int
    certified: int
    # after repair
    unslowed: int
    # as planned
    repaired: int
    # not slowed as a whole: as planned, or refined
    plan_seconds: tuple[float, float, float]
    # median, p90, p99 of the planner's call
    solve_seconds: tuple[float, float, float]
    # the same of its solver alone
    repair_seconds: tuple[float, float, float]
    whole_seconds: tuple[float, float, float]
    # from path to certified trajectory
    speed_up: tuple[float, float]
    # the reference's solver time over this one's whole time, at the median and at p99
    flight: float
    # s, median certified travel time
    worst_share: tuple[float, float]
    # median and largest, before repair
    lost: tuple[float, float, float]
    # share of time that repair cost, where it had to slow; median, p90, p99
    gap: tuple[float, float, float]
    # certified travel time over the bound; median, p90, p99
    against_reference: float
    # median of certified travel time over the reference's on the same path, less 1
    against_expert: tuple[float, float]
    # mean and p95 of certified travel time over the expert's on the same path, less 1

    def texts(self) -> list[str]:
        """As COLUMNS has it."""
        return [
            self.planner, *(f"{count}/{self.paths}" for count in (self.certified, self.unslowed, self.repaired)),
            *(f"{1e3 * value:.1f} ms" for value in (self.plan_seconds[0], self.plan_seconds[2], *self.whole_seconds)),
            *(f"{value:.1f}×" for value in self.speed_up), f"{self.flight:.3f} s",
            *(f"{100 * value:+.2f} %" for value in self.against_expert),
            *(f"{value:.2f}" for value in self.worst_share),
            f"{100 * self.gap[0]:.2f} %", f"{100 * self.gap[1]:.2f} %",
        ]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Bench:
    """A whole run."""

    command: str
    machine: Machine
    nodes: int
    yaw: str
    first_seed: int
    paths: int
    # asked for in each box with each limit set
    interrupted: bool
    seconds: float
    rows: tuple[Row, ...]
    trials: tuple[dict[str, Any], ...]
    # of each, with its box and limit set

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)

    def tables(self) -> list[tuple[str, list[str], list[list[str]]]]:
        """Title, columns and rows of a table for each box and limit set."""
        groups = dict.fromkeys((row.box, row.limits) for row in self.rows)
        return [
            (
                f"box {box} m, {limits} limits, N = {self.nodes}, yaw {self.yaw}",
                list(COLUMNS),
                [row.texts() for row in self.rows if (row.box, row.limits) == (box, limits)],
            )
            for box, limits in groups
        ]


def bench(
    *,
    paths: int = 100,
    boxes: Sequence[str] = tuple(BOXES),
    limit_sets: Sequence[str] = tuple(LIMIT_SETS),
    planners: Sequence[str] = PLANNERS,
    nodes: int = 100,
    yaw: YawMode = YawMode.FREE,
    first_seed: int = 0,
    command: str = "",
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Bench:
    """Run it. An interrupt ends it early with what is measured by then.

    Raises:
        InputError: an unknown planner, box or limit set, or no path at all.
    """
    if paths < 1:
        raise InputError(f"{paths} paths are none", where="paths")
    for box in boxes:
        find_box(box)
    chosen = [find_limit_set(name) for name in limit_sets]
    found = {name: find_candidate(name) for name in planners}
    begun, done, total = time.perf_counter(), 0, len(boxes) * len(chosen) * paths
    measured: dict[tuple[str, str], list[Trial]] = {}
    interrupted = False
    try:
        for limit_set in chosen:
            _warm_up(found, limit_set, nodes, yaw, first_seed)
            for box in boxes:
                trials = measured.setdefault((box, limit_set.name), [])
                for seed in range(first_seed, first_seed + paths):
                    trials += path_trials(found, seed, box, limit_set, nodes=nodes, yaw=yaw)
                    done += 1
                    progress(done, total)
    except KeyboardInterrupt:
        interrupted = True
    rows = [
        _row(box, limits, name, trials)
        for (box, limits), trials in measured.items()
        for name in planners
        if any(trial.planner == name for trial in trials)
    ]
    return Bench(
        command=command,
        machine=this_machine(),
        nodes=nodes,
        yaw=yaw.value,
        first_seed=first_seed,
        paths=paths,
        interrupted=interrupted,
        seconds=time.perf_counter() - begun,
        rows=tuple(rows),
        trials=tuple(
            {"box": box, "limits": limits, **asdict(trial)}
            for (box, limits), trials in measured.items()
            for trial in trials
        ),
    )


def _warm_up(candidates: dict[str, Candidate], chosen: LimitSet, nodes: int, yaw: YawMode, seed: int) -> None:
    path = random_path(seed, next(iter(BOXES)))
    for name, candidate in candidates.items():
        run_trial(name, candidate, path, seed, chosen, nodes=nodes, yaw=yaw, bound=1.0)


def _row(box: str, limits: str, name: str, trials: Iterable[Trial]) -> Row:
    every = list(trials)
    mine = [trial for trial in every if trial.planner == name and trial.status != BAD_PATH]
    reference = {trial.seed: trial for trial in every if trial.planner == REFERENCE}
    expert = {trial.seed: trial for trial in every if trial.planner == EXPERT}
    plan = quantiles([trial.plan_seconds for trial in mine])
    whole = quantiles([trial.whole_seconds for trial in mine])
    theirs = quantiles([trial.solve_seconds for trial in reference.values()])
    ratios = [trial.certified_time / reference[trial.seed].certified_time for trial in mine if trial.seed in reference]
    slower = [trial.certified_time / expert[trial.seed].certified_time - 1 for trial in mine if trial.seed in expert]
    slower = [value for value in slower if np.isfinite(value)]
    shares = [trial.worst_share for trial in mine if np.isfinite(trial.worst_share)]
    return Row(
        box=box,
        limits=limits,
        planner=name,
        paths=len(mine),
        certified=sum(trial.certified for trial in mine),
        unslowed=sum(trial.unslowed for trial in mine),
        repaired=sum(trial.speed_factor == 1.0 for trial in mine),
        plan_seconds=plan,
        solve_seconds=quantiles([trial.solve_seconds for trial in mine]),
        repair_seconds=quantiles([trial.repair_seconds for trial in mine]),
        whole_seconds=whole,
        speed_up=(theirs[0] / whole[0], theirs[2] / whole[2]),
        flight=quantiles([trial.certified_time for trial in mine])[0],
        worst_share=(float(np.median(shares)), max(shares)) if shares else (float("nan"),) * 2,
        lost=quantiles([trial.lost for trial in mine if not trial.unslowed]),
        gap=quantiles([trial.gap for trial in mine]),
        against_reference=quantiles(ratios)[0] - 1.0,
        against_expert=(float(np.mean(slower)), float(np.quantile(slower, 0.95))) if slower else (float("nan"),) * 2,
    )
