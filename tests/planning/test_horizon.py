"""What it costs to know only the next three waypoints, against planning through all of them at once."""

from dataclasses import replace

import numpy as np
import pytest

from cfplan.errors import InfeasibleError
from cfplan.geometry.path_file import path_through
from cfplan.geometry.random_paths import random_waypoints
from cfplan.planning.continuation import continue_plan, plan_from_rest
from cfplan.planning.path.choice import fastest_path
from cfplan.safety.space import Space

BOX = [[-1.6, -3.2, 0.5], [1.6, 3.2, 1.5]]
KNOWN, WAYPOINTS = 3, 20
MOMENTS = np.arange(0.02, 0.3, 0.05)  # s after a waypoint is passed, at which a plan through the next is tried


@pytest.fixture(scope="module")
def wide(limits):
    """No walls, which would end some of the paths, and a battery that lasts."""
    space = Space((-6.0, -8.0, -3.0), (6.0, 8.0, 6.0), 0.1)
    return replace(limits, space=space, battery=replace(limits.battery, endurance=1e4))


def flown_in(points, limits) -> float:
    """Return the time, s, through points of which each becomes known where the third before it is passed.

    Where no plan leads on, the vehicle flies to the end of what it has, and goes on from rest.
    """
    made = plan_from_rest(points[: KNOWN + 1], limits)
    clock, known = 0.0, KNOWN + 1
    while known < len(points):
        trajectory, reached = made.plan.trajectory, made.reached
        passed = float(trajectory.time_at(reached[0]))
        ahead = points[known - len(reached) + 1 : known + 1]
        for leave in passed + MOMENTS:
            try:
                made = continue_plan(trajectory, leave, ahead, limits, reached=reached[1:])
            except InfeasibleError:
                continue
            clock += leave
            known += 1
            break
        else:
            clock += trajectory.duration
            rest = points[known - 1 : known - 1 + KNOWN + 1]
            made = plan_from_rest(rest, limits)
            known += len(rest) - 1
    return clock + made.plan.trajectory.duration


def costs(seeds, limits) -> np.ndarray:
    """Return (N, 2): s of flight through all waypoints at once, and with three known."""
    paths = [random_waypoints(seed, BOX, (WAYPOINTS, WAYPOINTS)) for seed in seeds]
    return np.array(
        [(fastest_path(path_through(points), limits).duration, flown_in(points, limits)) for points in paths]
    )


def test_knowing_three_waypoints_costs_little(wide):
    at_once, known = costs(range(3), wide).sum(axis=0)
    assert known < 1.05 * at_once


@pytest.mark.slow
def test_knowing_three_waypoints_of_a_hundred_paths_costs_at_most_three_per_cent(wide):
    found = costs(range(100), wide)
    share = found[:, 1] / found[:, 0] - 1.0
    print(
        f"\nin all {found[:, 1].sum() / found[:, 0].sum() - 1:+.2%}, mean {share.mean():+.2%}, "
        f"median {np.median(share):+.2%}, 90 % within {np.quantile(share, 0.9):+.2%}, most {share.max():+.2%}"
    )
    assert share.mean() < 0.03
