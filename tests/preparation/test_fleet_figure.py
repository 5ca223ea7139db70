"""The figure of a fleet shows what the certificate of separation says."""

import numpy as np
import pytest

from cfplan.geometry.min_snap import min_snap
from cfplan.planning.fleet.members import FleetMember
from cfplan.planning.fleet.separation import separations
from cfplan.planning.plan import plan
from cfplan.preparation.fleet_figure import draw_fleet
from cfplan.preparation.plan_fleet import PlannedFleet

APART, SKEW = 0.3, 0.03


@pytest.fixture(scope="module")
def lines(limits):
    """Plans along x, across it, and along x 1 m aside."""

    def along(*points):
        return plan(min_snap(points), limits.airframe, limits, planner="minsnap", nodes=40)

    return {
        "along": along([-0.6, 0.0, 1.0], [0.6, 0.0, 1.0]),
        "across": along([0.0, -0.6, 1.0], [0.0, 0.6, 1.0]),
        "aside": along([-0.6, 1.0, 1.0], [0.6, 1.0, 1.0]),
    }


def fleet_of(plans, limits, delay):
    members = (FleetMember("a$x$", plans[0]), FleetMember("_b", plans[1], delay))
    return PlannedFleet("cross", APART, SKEW, members, separations(members, SKEW), (), members[0].end, limits)


def axes_of(figure, title):
    return next(axes for axes in figure.axes if title in axes.get_title(loc="left"))


@pytest.mark.parametrize("delay", [0.0, 0.8])
def test_drawn_distances_end_at_the_certified_least(lines, limits, delay):
    fleet = fleet_of((lines["along"], lines["across"]), limits, delay)
    drawn = axes_of(draw_fleet(fleet), "distance of each pair").lines[0]
    (pair,) = fleet.separations
    assert drawn.get_ydata().min() == pytest.approx(pair.distance, abs=0.03)
    assert drawn.get_xdata()[np.argmin(drawn.get_ydata())] == pytest.approx(pair.time, abs=0.1)


@pytest.mark.parametrize(("delay", "meets"), [(0.0, True), (0.8, False)])
def test_the_clocks_pass_beside_the_conflict_of_a_certified_fleet(lines, limits, delay, meets):
    fleet = fleet_of((lines["along"], lines["across"]), limits, delay)
    assert fleet.separations[0].keeps(APART) is not meets
    conflict = next(axes for axes in draw_fleet(fleet).axes if axes.get_ylabel() == "_b")
    filled = conflict.collections[0].get_paths()[0]
    assert filled.contains_points(conflict.lines[0].get_xydata()).any() == meets


def test_paths_that_nowhere_come_near_have_no_conflict_map(lines, limits):
    figure = draw_fleet(fleet_of((lines["along"], lines["aside"]), limits, 0.0))
    assert not [axes for axes in figure.axes if axes.get_ylabel() == "_b"]
    assert axes_of(figure, "from above")
