"""What the learned planner needs for paths of any length: time, memory, and flight time against the expert's.

Times are the processor's: planning is one thread, and a ratio of its times holds while others use the machine too.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path as File
from typing import Any

import numpy as np

from cfplan.errors import CfplanError, InputError
from cfplan.flight.setpoints.encoding import encode_checked
from cfplan.geometry.path import Path
from cfplan.learning.learned import plan_learned
from cfplan.planners.expert.expert import plan_expert
from cfplan.planners.task import PlanningTask
from cfplan.planning.plan import default_nodes
from cfplan.planning.repair import Repaired, repair
from cfplan.safety.limit_sets import LimitSet
from cfplan.studies.machine import Machine, this_machine
from cfplan.studies.scaling import path_of_length
from cfplan.studies.trials import find_box, find_limit_set
from cfplan.vehicle.trajectory import Trajectory

LENGTHS = (20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)
# m
GOAL_RATIO, GOAL_MEGABYTES, GOAL_EXCESS = 60.0, 50.0, 0.01
# at 1 km: over the time of the first, memory, and flight time over the expert's
COLUMNS = (
    "length", "nodes", "certified", "network", "certificate", "bytes", "in all", "against the first", "worst share",
    "flight", "against expert", "memory kept", "at the peak",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Walk:
    """One path. NaN where there was nothing to measure."""

    seed: int
    length: float
    # m
    nodes: int
    reason: str
    # why there are no bytes to send, empty where there are
    speed_factor: float  # on the whole; 1: not slowed
    worst_share: float
    # of a limit, by the certificate, anywhere along the path
    seconds: tuple[float, float, float]
    # of the processor, to plan, to repair and certify, to encode and certify the bytes; the quickest of the repeats
    flight: float
    # s
    expert_flight: float
    # s, solved on the whole path
    kept: float
    # MB by which memory had grown when the first of the repeats was done, its result still held
    peak: float
    # MB by which it had at most

    @property
    def certified(self) -> bool:
        """As planned and refined: not slowed as a whole."""
        return not self.reason and self.speed_factor == 1.0


@dataclass(frozen=True, slots=True)
class LongPaths:
    """A whole run."""

    command: str
    machine: Machine
    box: str
    limits: str
    interrupted: bool
    walks: tuple[tuple[Walk, ...], ...]
    # of each length

    def to_dict(self) -> dict[str, Any]:
        """For JSON: the table and each path."""
        document = {name: value for name, value in asdict(self).items() if name != "walks"}
        walks = [asdict(walk) for group in self.walks for walk in group]
        return document | {"table": [dict(zip(COLUMNS, row, strict=True)) for row in self._rows()], "walks": walks}

    def tables(self) -> list[tuple[str, list[str], list[list[str]]]]:
        """Title, columns and rows of the one table."""
        goal = f"{GOAL_RATIO:g}× the first at 1 km, {GOAL_EXCESS:+.0%}, {GOAL_MEGABYTES:g} MB"
        title = f"the learned planner on long paths, box {self.box} m, {self.limits} limits; at most: {goal}"
        return [(title, list(COLUMNS), self._rows())]

    def _rows(self) -> list[list[str]]:
        return [_texts(group, self.walks[0]) for group in self.walks]


def _texts(walks: Sequence[Walk], first: Sequence[Walk]) -> list[str]:
    seconds = np.median([walk.seconds for walk in walks], axis=0)
    ratio = seconds.sum() / np.median([walk.seconds for walk in first], axis=0).sum()
    excess = max(walk.flight / walk.expert_flight - 1.0 for walk in walks)
    flight = np.mean([walk.flight for walk in walks])
    return [
        f"{np.mean([walk.length for walk in walks]):.0f} m", f"{np.mean([walk.nodes for walk in walks]):.0f}",
        f"{sum(walk.certified for walk in walks)}/{len(walks)}",
        *(f"{1e3 * part:.1f} ms" for part in (*seconds, seconds.sum())), f"{ratio:.1f}×",
        f"{max(walk.worst_share for walk in walks):.3f}", f"{flight:.2f} s",
        f"{100 * excess:+.2f} %" if np.isfinite(excess) else "–",
        *(f"{max(values):.1f} MB" for values in ([w.kept for w in walks], [w.peak for w in walks])),
    ]  # fmt: skip


def long_paths(
    *,
    lengths: Sequence[float] = LENGTHS,
    paths: int = 3,
    repeats: int = 3,
    box: str = "10x10x10",
    limits: str = "hardware",
    first_seed: int = 20_000,
    command: str = "",
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> LongPaths:
    """`paths` random paths of each length, each planned `repeats` times. An interrupt keeps the lengths done by then.

    Raises:
        InputError: an unknown box or limit set, no path or length at all, or no model for the limit set.
    """
    if paths < 1 or repeats < 1 or not lengths or not min(lengths) > 0 or not np.isfinite(max(lengths)):
        raise InputError("long paths need a length above 0 m, one path of it and one repeat at least", where="lengths")
    find_box(box)
    chosen, seeds = find_limit_set(limits), range(first_seed, first_seed + paths)
    total, made, interrupted = len(lengths) * paths * repeats, 0, False
    done: list[list[Walk]] = []
    try:
        _planned(path_of_length(lengths[0], box, first_seed), chosen)  # loads and compiles
        for length in lengths:
            walks = []
            for seed in seeds:
                walks.append(_walk(path_of_length(length, box, seed), seed, chosen))
                progress(made := made + 1, total)
            done.append(walks)
        for _ in range(repeats - 1):  # by turns, so that a computer that changes its pace does so for all lengths
            for length, walks in zip(lengths, done, strict=True):
                for k, seed in enumerate(seeds):
                    walks[k] = _repeated(walks[k], path_of_length(length, box, seed), chosen)
                    progress(made := made + 1, total)
    except KeyboardInterrupt:
        interrupted = True
    return LongPaths(command, this_machine(), box, limits, interrupted, tuple(tuple(walks) for walks in done))


def _walk(path: Path, seed: int, chosen: LimitSet) -> Walk:
    nodes = default_nodes(path, "learned")
    values: dict[str, Any] = {"seed": seed, "length": path.length, "nodes": nodes, "reason": "", "speed_factor": np.nan}
    values |= dict.fromkeys(("worst_share", "flight", "expert_flight", "kept", "peak"), np.nan)
    values["seconds"] = (np.nan,) * 3
    try:
        path.check()
        _forget_peak()
        before = _memory("VmRSS")
        found, values["seconds"] = _planned(path, chosen)
        values |= {"kept": _memory("VmRSS") - before, "peak": _memory("VmHWM") - before}
        values |= {"speed_factor": found.speed_factor, "flight": found.trajectory.duration}
        values["worst_share"] = found.certificate.worst.share
        expert = plan_expert(PlanningTask(path, chosen.airframe, chosen.limits, nodes), windows=False)
        if expert.profile is not None:
            values["expert_flight"] = Trajectory(path, expert.profile, chosen.airframe).duration
    except InputError:
        raise
    except CfplanError as error:
        values["reason"] = str(error)
    return Walk(**values)


def _repeated(walk: Walk, path: Path, chosen: LimitSet) -> Walk:
    """With the shorter of its time and that of planning again."""
    return walk if walk.reason else replace(walk, seconds=min(walk.seconds, _planned(path, chosen)[1], key=sum))


def _planned(path: Path, chosen: LimitSet) -> tuple[Repaired, tuple[float, float, float]]:
    """From the path to certified bytes, and the seconds of each part."""
    begun = time.process_time()
    task = PlanningTask(path, chosen.airframe, chosen.limits, default_nodes(path, "learned"))
    solution = plan_learned(task)
    planned = time.process_time()
    if solution.profile is None:
        raise CfplanError(solution.reason or str(solution.status))
    found = repair(task, solution.profile)
    repaired = time.process_time()
    encode_checked(found.trajectory, chosen.limits)
    return found, (planned - begun, repaired - planned, time.process_time() - repaired)


def _memory(name: str) -> float:
    """MB of this process as Linux counts them; NaN elsewhere."""
    try:
        status = File("/proc/self/status").read_text()
    except OSError:
        return np.nan
    return next((1e-3 * int(line.split()[1]) * 1.024 for line in status.splitlines() if line.startswith(name)), np.nan)


def _forget_peak() -> None:
    """So that VmHWM tells of what comes."""
    try:
        File("/proc/self/clear_refs").write_text("5")
    except OSError:
        return
