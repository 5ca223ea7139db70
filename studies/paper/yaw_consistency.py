"""Make the paper's figure of yaw consistency: TOPPQuad on pairs of paths whose first waypoint is 0.1 m apart.

Without the penalty on angular acceleration, many yaw profiles are equally good where the speed limit binds, and a small
change of the path may select another one. The expert plans the same pairs.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np

from cfplan.errors import CfplanError
from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.path import Path
from cfplan.geometry.random_paths import random_waypoints
from cfplan.planners.baselines.toppquad import plan_toppquad
from cfplan.planners.baselines.toppquad_nlp import PENALTY
from cfplan.planners.expert.expert import plan_expert
from cfplan.planners.task import Planner
from cfplan.safety.limit_sets import BOXES, PAPER
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.timing import duration_of
from studies.paper.trained import WAYPOINTS
from studies.paper.trials import profile_by
from studies.runner.options import option
from studies.runner.reductions import among, count, largest, mean, median, quantile
from studies.runner.result import Column, Table, table
from studies.runner.study import Run, Study, Work

MOVED = (0.1, 0.0, 0.0)  # m, displacement of the first waypoint
PLAIN, PENALISED, EXPERT = "TOPPQuad, λ = 0", f"TOPPQuad, λ = {PENALTY:g}", "expert"
WAYS: dict[str, Planner] = {
    PLAIN: partial(plan_toppquad, penalty=0.0),
    PENALISED: plan_toppquad,
    EXPERT: plan_expert,
}
EDGES = (0.0, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 4.0, np.inf)  # rad, bin edges of the yaw histogram


@dataclass(frozen=True, slots=True)
class Settings:
    """The pairs to plan."""

    pairs: int = option(100, "Pairs of random paths.", least=1)
    seed: int = option(50_000, "Seed of the first pair.", least=0)


@dataclass(frozen=True, slots=True)
class Pair:
    """A path, and the same path with its first waypoint moved. NaN where there was nothing to measure."""

    planner: str
    seed: int
    reason: str = ""  # why the pair was not planned; empty if it was
    travel_time: float = np.nan  # s, of the unmoved path
    h: float = np.nan  # largest difference at a node
    h_relative: float = np.nan  # the same, relative
    time: float = np.nan  # s, absolute difference of travel times
    yaw: float = np.nan  # rad, largest difference at a node

    @property
    def solved(self) -> bool:
        """Return whether both paths were planned."""
        return not self.reason


COLUMNS = (
    Column("planner", "planner"),
    Column("pairs", value=count()),
    Column("solved", "pairs solved", of="pairs", value=count("solved")),
    Column("travel_time", "travel time, mean", "s", ".3f", value=mean("travel_time")),
    Column("h_median", "Δh, median", "", ".2f", meaning="largest at a node; h is large where γ' is small",
           value=median("h")),
    Column("h_relative_median", "Δh/h, median", "%", ".1f", value=median("h_relative")),
    Column("time_median", "Δtime, median", "s", ".3f", value=median("time")),
    Column("time_p90", "p90", "s", ".3f", value=quantile("time", 0.9)),
    Column("yaw_median", "Δyaw, median", "rad", ".3f", value=median("yaw")),
    Column("yaw_p90", "p90", "rad", ".3f", value=quantile("yaw", 0.9)),
    Column("yaw_max", "largest", "rad", ".2f", value=largest("yaw")),
)  # fmt: skip


def _bin_column(low: float, high: float) -> Column:
    name = f"{low:g} to {high:g}" if np.isfinite(high) else f"above {low:g}"
    return Column(name, name, value=among("solved", count(lambda pair: low <= pair.yaw < high)))


HISTOGRAM = (Column("planner", "Δyaw, rad"), *(_bin_column(*edges) for edges in pairwise(EDGES)))


def work(settings: Settings, run: Run) -> Work:
    """Return one case per pair."""
    seeds = range(settings.seed, settings.seed + settings.pairs)
    return Work({str(seed): seed for seed in seeds}, measure, Pair)


def measure(seed: int) -> list[Pair]:
    """Plan the pair of paths of a seed in each of WAYS."""
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


def tables(settings: Settings, rows: list[Pair]) -> Iterator[Table]:
    """Yield the median and largest differences within pairs, and a histogram of the differences of yaw."""
    title = f"Pairs of paths, first waypoint moved by {MOVED[0]:g} m, {PAPER.limits.speed:g} m/s, yaw from [0, π/2]"
    yield table("differences", title, COLUMNS, rows, by=("planner",))
    yield table("yaw-histogram", "Pairs by their largest difference of yaw", HISTOGRAM, rows, by=("planner",))


STUDY = Study(Settings, work, tables, "-o results/yaw-consistency.json")
