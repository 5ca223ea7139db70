"""A vehicle of a fleet: its certified plan, and its start on the common clock."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.planning.plan_result import Plan
from cfplan.vehicle.trajectory import Trajectory


@dataclass(frozen=True, slots=True)
class FleetMember:
    """One vehicle's flight. Before its start it hovers there; after its end it hovers there, lands and stays."""

    name: str
    plan: Plan
    delay: float = 0.0  # s after the fleet's start at which it begins

    @property
    def end(self) -> float:
        """Return when it reaches the end of its path, s after the fleet's start."""
        return self.delay + self.plan.trajectory.duration

    def columns(self, times: NDArray) -> NDArray:
        """Return x and y at each time after the fleet's start, (N,) s, as (N, 2) m."""
        return places(self.plan.trajectory, times - self.delay)


def places(trajectory: Trajectory, times: NDArray) -> NDArray:
    """Return x and y at each time of a trajectory, (N,) s, as (N, 2) m; at rest before its start and after its end."""
    return np.ascontiguousarray(trajectory.path(trajectory.s_at(times))[:, :2])
