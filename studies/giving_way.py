"""Simulate link loss at every setpoint of each PATH and of random paths, before and after plans give way.

Each path is planned at the full speed that the limits allow. For every setpoint and several motor lags, the study
simulates where the vehicle comes down if no setpoint follows: with body rates sent as planned, with body rates traded
for turns of the attitude, and after the plan has given way. The last two differ only for plans that give way.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import count as count_from
from itertools import islice
from pathlib import Path as FilePath

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import CfplanError, InfeasibleError
from cfplan.flight.setpoints.encoding import EncodedFlight, encode_trajectory
from cfplan.flight.setpoints.rate_trade import gains_under
from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.path import Path
from cfplan.geometry.path_file import load_path_file
from cfplan.geometry.random_paths import random_waypoints
from cfplan.geometry.yaw import YawMode
from cfplan.planning.path.choice import chosen_path
from cfplan.planning.plan import plan
from cfplan.planning.plan_result import Plan
from cfplan.preparation.plan_flight import give_way
from cfplan.safety.limits import Limits
from cfplan.safety.space import Space, check_space, inside
from cfplan.simulation.link_loss import link_loss_at_every_setpoint
from studies.drawn_paths import WAYPOINTS
from studies.dry_runs import LAGS
from studies.link_loss import with_rates
from studies.runner.limits import limits_for
from studies.runner.options import argument, option
from studies.runner.reductions import among, count, largest, quantile
from studies.runner.result import Column, Table, table
from studies.runner.study import Run, Study, Work

WALL_DISTANCE = 0.05  # m that random waypoints keep from the margin, as paths swing out between them
RANDOM = "random paths"


@dataclass(frozen=True, slots=True)
class Settings:
    """The paths to fly."""

    path_files: tuple[FilePath, ...] = argument()
    random: int = option(200, "Number of additional random paths.", least=0)
    seed: int = option(0, "Seed of the first random path.", least=0)


@dataclass(frozen=True, slots=True)
class SlowedFlight:
    """One path, and how far beyond the walls the vehicle comes down at the worst setpoint and lag; negative inside."""

    path: str  # its name, or RANDOM
    flight: str
    duration: float  # s, before giving way
    lost: float  # fraction of the time lost by giving way
    refused: str  # why it is not flown; empty if it is
    reasons: str  # for giving way
    rates_beyond: float  # m, with body rates sent as planned
    before_beyond: float  # m, with body rates sent as turns of the attitude
    after_beyond: float  # m, after giving way

    @property
    def flown(self) -> bool:
        """Return whether the flight was accepted."""
        return not self.refused


COLUMNS = (
    Column("path", "path"),
    Column("paths", "paths", value=count()),
    Column("rates_beyond", "rates as planned", "m", ".2f", meaning="beyond the walls, worst setpoint and lag",
           value=largest("rates_beyond")),
    Column("before_beyond", "rates as turns", "m", ".2f", meaning="likewise; negative inside",
           value=largest("before_beyond")),
    Column("after_beyond", "after giving way", "m", ".2f", meaning="likewise",
           value=among("flown", largest("after_beyond"))),
    Column("outside_before", "outside before", of="paths", meaning="flights that end outside from some setpoint",
           value=count(lambda row: not inside(row.before_beyond))),
    Column("outside_after", "after", of="paths", value=among("flown", count(lambda row: not inside(row.after_beyond)))),
    Column("refused", "refused", of="paths", meaning="as slowness did not help", value=count("refused")),
    Column("lost_median", "time lost, median", "%", ".2f", meaning="by giving way, over all paths",
           value=among("flown", quantile("lost", 0.5))),
    Column("lost_p90", "p90", "%", ".2f", value=among("flown", quantile("lost", 0.9))),
    Column("lost_max", "most", "%", ".2f", value=among("flown", largest("lost"))),
)  # fmt: skip


def work(settings: Settings, run: Run) -> Work:
    """Return one case per path: its table row, name, path and yaw. Raises what reading a path file raises."""
    limits = limits_for(settings.path_files[0])
    files = [chosen_path(load_path_file(file), limits)[0] for file in settings.path_files]
    cases = [(each.name, each.name, each.path, each.yaw, each.yaw_angle) for each in files]
    for seed, path in random_paths(limits, settings.seed, settings.random):
        cases.append((RANDOM, f"random {seed}", path, YawMode.FIXED, 0.0))
    return Work({case[1]: case for case in cases}, partial(measure, limits=limits), SlowedFlight)


def random_paths(limits: Limits, first_seed: int, number: int) -> list[tuple[int, Path]]:
    """Return `number` random paths that keep the margin to the walls, with their seeds."""
    return list(islice(_within(limits.space, first_seed), number))


def _within(space: Space, first_seed: int) -> Iterator[tuple[int, Path]]:
    distance = space.margin + WALL_DISTANCE
    box = np.array([space.low, space.high]) + np.array([[distance], [-distance]])
    for seed in count_from(first_seed):
        with suppress(CfplanError):  # the path leaves the space between its waypoints, or has a cusp
            path = min_snap(random_waypoints(seed, box, WAYPOINTS))
            check_space(path, space)
            yield seed, path


def measure(case: tuple[str, str, Path, YawMode, float], limits: Limits) -> SlowedFlight:
    """Simulate link loss at every setpoint of a path. Raises what planning it raises."""
    line, name, path, yaw, yaw_angle = case
    planned = plan(path, limits.airframe, limits, yaw=yaw, yaw_angle=yaw_angle)
    before, slowed, refused = _encoded(planned, limits), planned, ""
    try:
        slowed, _ = give_way(planned)
    except InfeasibleError as error:
        refused = str(error)
    before_beyond = _beyond(before.payloads, limits)
    return SlowedFlight(
        line, name, planned.trajectory.duration, slowed.time_lost, refused,
        reasons="; ".join(slowed.slowing.reasons) if slowed.slowing else "",
        rates_beyond=_beyond(with_rates(before.motion), limits),
        before_beyond=before_beyond,
        after_beyond=before_beyond if slowed is planned else _beyond(_encoded(slowed, limits).payloads, limits),
    )  # fmt: skip


def _encoded(planned: Plan, limits: Limits) -> EncodedFlight:
    return encode_trajectory(planned.trajectory, gains=gains_under(limits), space=limits.space)


def _beyond(payloads: NDArray, limits: Limits) -> float:
    """Return the distance beyond the walls where the vehicle comes down, m, for the worst setpoint and lag."""
    with_lags = replace(limits, link_loss=replace(limits.link_loss, motor_lags=LAGS))
    return float(link_loss_at_every_setpoint(payloads, with_lags).beyond.max())


def tables(settings: Settings, rows: list[SlowedFlight]) -> Iterator[Table]:
    """Yield a table with one row per path file and one for all random paths."""
    title = f"Link loss at every setpoint, motor lags of {', '.join(f'{lag:g}' for lag in LAGS)} s"
    yield table("giving-way", title, COLUMNS, rows, by=("path",))


STUDY = Study(Settings, work, tables, "flights/line.yaml flights/scan.yaml --random 20 -o results/giving-way.json")
