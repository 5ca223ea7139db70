"""Plan adversarial paths under limits from a hundredth to ten times the usual: each within its budget, or refused.

Every path is planned in a process of its own, whose time and memory are measured. Every few paths the expert plans as
well, with all the time that it wants.
"""

import multiprocessing
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from cfplan.deadline import NEVER, Deadline
from cfplan.errors import CfplanError
from cfplan.planning.plan import default_budget, plan
from cfplan.safety.limits import Limits
from cfplan.safety.limits_file import load_limits
from cfplan.safety.space import Space
from studies.adversarial_paths import FAMILIES, AdversarialPath, adversarial_path
from studies.runner.machine import process_memory
from studies.runner.result import Column, StudyResult, Table, collect, detail_table

PATIENCE = 5.0  # budgets after which a path counts as hanging
ENDURANCE = 1e6  # s that the battery lasts, in so high a room
ROOM = 3000.0  # m to each side
GOAL_MEGABYTES, GOAL_EXCESS = 1000.0, 0.3
CERTIFIED, REFUSED, HANGS, CRASHED = "certified", "refused", "hangs", "crashed"
COLUMNS = (
    Column("family", "paths"),
    Column("paths"),
    Column("certified", "certified", of="paths"),
    Column("refused", "refused", of="paths", meaning="with a reason and a hint: a cusp, an hour of flight"),
    Column("failed", "neither", of="paths", meaning="an error that is no answer, or no end"),
    Column("late", "over budget", of="paths", meaning="5 s and 20 ms a metre, of processor time"),
    Column("unfinished", "budget spent", of="paths", meaning="answered in time with something left out"),
    Column("slowed", "slowed as a whole", of="paths", meaning="by more than 1 %"),
    Column("seconds_median", "median", "s", ".2f", meaning="processor time of planning"),
    Column("seconds_max", "most", "s", ".2f"),
    Column("memory_max", "memory", "MB", ".0f", meaning="of the whole process at its peak, at most"),
    Column("compared", "compared", meaning="with the expert"),
    Column("excess_median", "over the expert, median", "%", "+.2f", meaning="of the flight's time"),
    Column("excess_max", "most", "%", "+.1f"),
)


@dataclass(frozen=True, slots=True)
class HardPlan:
    """One path, planned. NaN where there was nothing to measure."""

    seed: int
    family: str
    factor: float  # on the limits
    yaw: str
    points: int
    status: str = CRASHED
    reason: str = ""  # why there is no certified flight
    length: float = np.nan  # m
    budget: float = np.nan  # s
    seconds: float = np.nan  # of the processor
    memory: float = np.nan  # MB of the process at its peak
    planner: str = ""
    nodes: int = 0
    flight: float = np.nan  # s
    speed_factor: float = np.nan  # on the whole; 1: not slowed
    left_out: str = ""
    expert_flight: float = np.nan  # s, planned without a budget


def hard_paths(
    safety_file: FilePath,
    *,
    paths: int = 1000,
    first_seed: int = 0,
    compare_every: int = 7,
    jobs: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> StudyResult:
    """Plan that many paths, whose families take turns, under multiples of the file's limits; on `jobs` processes.

    Every `compare_every`-th is planned by the expert too. An interrupt keeps what is done. Raises what reading limits
    raises.
    """
    limits = _roomy(load_limits(safety_file))
    _plan(adversarial_path(0, limits.plan), limits)  # loads and compiles, before processes branch off

    def trials() -> Iterator[HardPlan]:
        seeds = range(first_seed, first_seed + paths)
        with multiprocessing.get_context("fork").Pool(jobs, maxtasksperchild=1) as pool:
            run = partial(_trial, limits=limits, compare_every=compare_every)
            for done, trial in enumerate(pool.imap(run, seeds, chunksize=1)):
                progress(done + 1, paths)
                yield trial

    done, interrupted = collect(trials())
    settings = {"paths": paths, "first_seed": first_seed, "compare_every": compare_every}
    return StudyResult("hard-paths", settings, (families_table(done),), (detail_table("plans", done),), interrupted)


def families_table(plans: Sequence[HardPlan]) -> Table:
    """Return the figures of each family, and of all."""
    groups = [(family, [each for each in plans if each.family == family]) for family in FAMILIES]
    rows = tuple(_row(name, group) for name, group in [*groups, ("all", list(plans))] if group)
    title = (
        "Adversarial paths, limits from a hundredth to ten times those of safety.yaml; "
        f"at most: {GOAL_MEGABYTES:g} MB, {GOAL_EXCESS:+.0%}"
    )
    return Table("families", title, COLUMNS, rows)


def _row(name: str, plans: Sequence[HardPlan]) -> dict[str, Any]:
    seconds = [each.seconds for each in plans if np.isfinite(each.seconds)]
    memory = [each.memory for each in plans if np.isfinite(each.memory)]
    excess = [each.flight / each.expert_flight - 1.0 for each in plans if np.isfinite(each.flight / each.expert_flight)]
    return {
        "family": name,
        "paths": len(plans),
        "certified": sum(each.status == CERTIFIED for each in plans),
        "refused": sum(each.status == REFUSED for each in plans),
        "failed": sum(each.status in (HANGS, CRASHED) for each in plans),
        "late": sum(each.seconds > each.budget for each in plans),
        "unfinished": sum(bool(each.left_out) for each in plans),
        "slowed": sum(each.speed_factor < 0.99 for each in plans),
        "seconds_median": np.median(seconds) if seconds else np.nan,
        "seconds_max": max(seconds, default=np.nan),
        "memory_max": max(memory, default=np.nan),
        "compared": len(excess),
        "excess_median": np.median(excess) if excess else np.nan,
        "excess_max": max(excess, default=np.nan),
    }


def _roomy(limits: Limits) -> Limits:
    """Return the limits with room and battery for every path."""
    space = Space((-ROOM,) * 3, (ROOM,) * 3, 0.0)
    return replace(limits, space=space, battery=replace(limits.battery, endurance=ENDURANCE))


class _HangsError(Exception):
    """A path took many times its budget."""


def _trial(seed: int, limits: Limits, compare_every: int) -> HardPlan:
    """Plan one path in this process, which does nothing else before or after."""

    def hang(*_: Any) -> None:
        raise _HangsError

    drawn = adversarial_path(seed, limits.plan)
    trial = HardPlan(seed, drawn.family, drawn.factor, str(drawn.yaw), len(drawn.points))
    signal.signal(signal.SIGPROF, hang)
    begun = time.process_time()
    try:
        trial = replace(trial, length=drawn.path.length, budget=default_budget(drawn.path))
        signal.setitimer(signal.ITIMER_PROF, PATIENCE * trial.budget)
        begun = time.process_time()
        trial = replace(trial, **_plan(drawn, limits, Deadline.after(trial.budget, time.process_time)))
    except CfplanError as error:
        trial = replace(trial, status=REFUSED if error.hint else CRASHED, reason=str(error))
    except _HangsError:
        trial = replace(trial, status=HANGS)
    except Exception as error:
        trial = replace(trial, reason=repr(error))
    trial = replace(trial, seconds=time.process_time() - begun, memory=process_memory("VmHWM"))
    if trial.status == CERTIFIED and compare_every and seed % compare_every == 0:
        signal.setitimer(signal.ITIMER_PROF, 20 * PATIENCE * trial.budget)
        with suppress(CfplanError, _HangsError):
            trial = replace(trial, expert_flight=_plan(drawn, limits, planner="expert")["flight"])
    signal.setitimer(signal.ITIMER_PROF, 0.0)
    return trial


def _plan(drawn: AdversarialPath, limits: Limits, deadline: Deadline = NEVER, planner: str = "auto") -> dict[str, Any]:
    """Return fields of a HardPlan. Raises CfplanError."""
    mine = replace(limits, plan=drawn.limits)
    made = plan(drawn.path, mine.airframe, mine, planner=planner, yaw=drawn.yaw, deadline=deadline)
    return {
        "status": CERTIFIED if made.certificate.passed else CRASHED,
        "planner": made.planner,
        "nodes": made.nodes,
        "flight": made.trajectory.duration,
        "speed_factor": made.repair_speed_factor,
        "left_out": made.left_out,
    }
