"""Simulate link loss at every setpoint of many flights: before and after plans are slowed where it ends outside.

Each path is planned at the full speed that the limits allow. For every setpoint and several motor lags it is simulated
where the vehicle comes down if that is the last one: with body rates sent as they are planned, with rates sent as turns
of the attitude, and after the plan has given way. The second and the third differ only where plans give way.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import count, islice
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from cfplan.errors import CfplanError, InfeasibleError
from cfplan.flight.setpoints.encoding import EncodedFlight, command_quaternion, encode_trajectory
from cfplan.flight.setpoints.packets import encode
from cfplan.flight.setpoints.rate_trade import gains_under
from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.path import Path
from cfplan.geometry.path_file import load_path_file
from cfplan.geometry.random_paths import random_waypoints
from cfplan.geometry.yaw import YawMode
from cfplan.planning.plan import plan
from cfplan.preparation.plan_flight import give_way
from cfplan.safety.limits import Limits
from cfplan.safety.limits_file import load_limits
from cfplan.safety.space import Space, check_space, inside
from cfplan.simulation.link_loss import link_loss_at_every_setpoint
from studies.runner.result import Column, StudyResult, Table, detail_table
from studies.trials import WAYPOINTS, quantile_values

LAGS = (0.07, 0.105, 0.13)  # s
WALL_DISTANCE = 0.05  # m beyond the margin, that random waypoints keep; paths swing out between them
COLUMNS = (
    Column("path", "path"),
    Column("paths", "paths"),
    Column("rates_beyond", "rates as planned", "m", ".2f", meaning="beyond the walls, worst setpoint and lag"),
    Column("before_beyond", "rates as turns", "m", ".2f", meaning="likewise; negative inside"),
    Column("after_beyond", "after giving way", "m", ".2f", meaning="likewise"),
    Column("outside_before", "outside before", of="paths", meaning="flights that end outside from some setpoint"),
    Column("outside_after", "after", of="paths"),
    Column("refused", "refused", of="paths", meaning="as slowness did not help"),
    Column("lost_median", "time lost, median", "%", ".2f", meaning="by giving way, over all paths"),
    Column("lost_p90", "p90", "%", ".2f"),
    Column("lost_max", "most", "%", ".2f"),
)


def giving_way(
    path_files: Sequence[FilePath],
    safety_file: FilePath,
    *,
    paths: int = 200,
    first_seed: int = 0,
    lags: Sequence[float] = LAGS,
    jobs: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> StudyResult:
    """Simulate link loss along each path file and along that many random paths, on `jobs` processes.

    Raises what reading and planning a path file raise.
    """
    from joblib import Parallel, delayed

    limits = load_limits(safety_file)
    files = [load_path_file(file) for file in path_files]
    flights = [(each.name, each.path, each.yaw, each.yaw_angle) for each in files]
    flights += [(f"random {seed}", path, YawMode.FIXED, 0.0) for seed, path in random_paths(limits, first_seed, paths)]
    trials = []
    work = Parallel(n_jobs=jobs, return_as="generator")(delayed(_trial)(*each, limits, lags) for each in flights)
    for done, trial in enumerate(work):
        progress(done + 1, len(flights))
        trials.append(trial)
    named, random = trials[: len(files)], trials[len(files) :]
    rows = [_row(trial["path"], [trial]) for trial in named] + ([_row("random paths", random)] if random else [])
    title = f"Link loss at every setpoint, motor lags of {', '.join(f'{lag:g}' for lag in lags)} s"
    settings = {"paths": [file.stem for file in path_files], "random": paths, "first_seed": first_seed, "lags": lags}
    return StudyResult(
        "giving-way", settings, (Table("giving-way", title, COLUMNS, tuple(rows)),), (detail_table("flights", trials),)
    )


def random_paths(limits: Limits, first_seed: int, number: int) -> list[tuple[int, Path]]:
    """Return random paths, with their seeds, that stay within the space and its margin."""
    return list(islice(_within(limits.space, first_seed), number))


def _within(space: Space, first_seed: int) -> Iterator[tuple[int, Path]]:
    distance = space.margin + WALL_DISTANCE
    box = np.array([space.low, space.high]) + np.array([[distance], [-distance]])
    for seed in count(first_seed):
        with suppress(CfplanError):  # between its waypoints it leaves the space, or has a cusp
            path = min_snap(random_waypoints(seed, box, WAYPOINTS))
            check_space(path, space)
            yield seed, path


def _trial(
    name: str, path: Path, yaw: YawMode, yaw_angle: float, limits: Limits, lags: Sequence[float]
) -> dict[str, Any]:
    planned = plan(path, limits.airframe, limits, yaw=yaw, yaw_angle=yaw_angle)
    before = encode_trajectory(planned.trajectory, gains=gains_under(limits), space=limits.space)
    refused, after = "", before
    slowed = planned
    try:
        slowed, _ = give_way(planned)
        after = encode_trajectory(slowed.trajectory, gains=gains_under(limits), space=limits.space)
    except InfeasibleError as error:
        refused = str(error)
    before_beyond = _beyond(before, limits, lags)
    return {
        "path": name,
        "duration": planned.trajectory.duration,
        "lost": slowed.time_lost,
        "refused": refused,
        "rates_beyond": _beyond(_rates_as_planned(before), limits, lags),
        "before_beyond": before_beyond,
        "after_beyond": before_beyond if after is before or slowed is planned else _beyond(after, limits, lags),
        "reasons": "; ".join(slowed.slowing.reasons) if slowed.slowing else "",
    }


def _rates_as_planned(encoded: EncodedFlight) -> EncodedFlight:
    motion = encoded.motion
    return replace(encoded, payloads=encode(replace(motion, quaternion=command_quaternion(motion.quaternion))))


def _beyond(encoded: EncodedFlight, limits: Limits, lags: Sequence[float]) -> float:
    """Return how far beyond the walls the vehicle comes down, m, from the worst setpoint and lag."""
    with_lags = replace(limits, link_loss=replace(limits.link_loss, motor_lags=tuple(lags)))
    return float(link_loss_at_every_setpoint(encoded.payloads, with_lags).beyond.max())


def _row(name: str, trials: Sequence[dict[str, Any]]) -> dict[str, Any]:
    flown = [trial for trial in trials if not trial["refused"]]
    return {
        "path": name,
        "paths": len(trials),
        "rates_beyond": max(trial["rates_beyond"] for trial in trials),
        "before_beyond": max(trial["before_beyond"] for trial in trials),
        "after_beyond": max((trial["after_beyond"] for trial in flown), default=None),
        "outside_before": sum(not inside(trial["before_beyond"]) for trial in trials),
        "outside_after": sum(not inside(trial["after_beyond"]) for trial in flown),
        "refused": len(trials) - len(flown),
        **quantile_values("lost", (trial["lost"] for trial in flown)),
        "lost_max": max((trial["lost"] for trial in flown), default=None),
    }
