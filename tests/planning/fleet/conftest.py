"""Vehicles that fly through points."""

import numpy as np
import pytest

from cfplan.geometry.min_snap import min_snap
from cfplan.planning.fleet.members import FleetMember
from cfplan.planning.plan import plan


@pytest.fixture(scope="package")
def member(limits):
    """Make a vehicle that flies through points, without looking at link loss."""

    def make(name, *points):
        planned = plan(min_snap(np.array(points, dtype=float)), limits.airframe, limits, planner="expert")
        return FleetMember(name, planned)

    return make
