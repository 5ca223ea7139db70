"""The firmware's on-board collision avoidance: how it changes the setpoints of a vehicle without neighbours.

Zhou, Wang, Bandyopadhyay and Schwager, "Fast, on-line collision avoidance for dynamic vehicles using buffered Voronoi
cells" (2017). Without neighbours the cell is a box about the vehicle: as far as it may go at `maxSpeed` within
`horizon`, cut by the bounding box. Place and velocity of a setpoint are moved into that cell; acceleration and body
rates stay as they were sent.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cfplan.simulation.engine.mellinger import ABSOLUTE, MODE_X, VELOCITY_MODE
from cfplan.simulation.virtual_crazyflie.setpoints import POSITION, VELOCITY, Setpoint

FARTHEST = float(np.finfo(np.float32).max)  # m, of a bounding box that is not set
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(slots=True)
class CollisionAvoidance:
    """The parameters of the group colAv that matter without neighbours, with the firmware's defaults."""

    enable: bool = False
    horizon: float = 1.0  # s
    max_speed: float = 0.5  # m/s
    sidestep: float = 0.25  # m
    tolerance: float = 1e-5
    low: NDArray = field(default_factory=lambda: np.full(3, -FARTHEST))  # (3,) m
    high: NDArray = field(default_factory=lambda: np.full(3, FARTHEST))  # (3,) m
    _feasible: NDArray | None = None  # the last place that could be flown to

    def rewrite(self, setpoint: Setpoint, here: NDArray) -> Setpoint:
        """Return the setpoint that the controller receives, with the vehicle estimated to be at `here`, (3,) m."""
        mode = setpoint.mode[MODE_X]
        if not self.enable or mode not in (ABSOLUTE, VELOCITY_MODE):
            return setpoint
        reach = self.horizon * self.max_speed
        cell = np.maximum(-reach, self.low - here), np.minimum(reach, self.high - here)
        values = setpoint.values.copy()
        if mode == VELOCITY_MODE:
            values[VELOCITY] = self._velocity(values[VELOCITY], cell)
            self._feasible = here.copy()
        else:
            values[POSITION], values[VELOCITY] = self._place(values[POSITION], values[VELOCITY], here, cell)
            self._feasible = values[POSITION].copy()
        return Setpoint(values, setpoint.mode, setpoint.velocity_in_body, setpoint.tick)

    def _velocity(self, velocity: NDArray, cell: tuple[NDArray, NDArray]) -> NDArray:
        if not self._inside(np.zeros(3), cell):
            nearest = np.clip(0.0, *cell)
            speed = float(np.sqrt(nearest @ nearest))
            return nearest * min(1.0, self.max_speed / speed) if self._inside(nearest, cell) else np.zeros(3)
        goal = self._around_neighbour(self.horizon * velocity, cell, always=True)
        return goal / self.horizon if self._inside(goal, cell) else np.zeros(3)

    def _place(
        self, place: NDArray, velocity: NDArray, here: NDArray, cell: tuple[NDArray, NDArray]
    ) -> tuple[NDArray, NDArray]:
        wanted = place - here
        goal = self._around_neighbour(wanted, cell, always=False)
        if not self._inside(goal, cell):
            return (here if self._feasible is None else self._feasible), np.zeros(3)
        if not np.any(velocity):
            return here + goal, velocity
        if np.any(goal != wanted):
            return here + goal, np.zeros(3)
        return place, velocity * min(1.0, _along(wanted, velocity, cell))

    def _around_neighbour(self, goal: NDArray, cell: tuple[NDArray, NDArray], *, always: bool) -> NDArray:
        share = _along(np.zeros(3), goal, cell)
        if share >= 1.0 and not always:
            return goal
        to_wall = share * float(np.sqrt(goal @ goal))
        if to_wall <= self.sidestep:
            goal = goal + (1.0 - to_wall / self.sidestep) ** 2 * np.cross(goal, _UP)
        return np.clip(goal, *cell)

    def _inside(self, place: NDArray, cell: tuple[NDArray, NDArray]) -> bool:
        slack = 10.0 * self.tolerance
        return bool(np.all(place >= cell[0] - slack) and np.all(place <= cell[1] + slack))


def _along(origin: NDArray, direction: NDArray, cell: tuple[NDArray, NDArray]) -> float:
    """Return how many times `direction` fits between `origin` and the wall of the cell; inf if it does not move."""
    walls = np.where(direction > 0.0, cell[1], cell[0])
    moving = direction != 0.0
    return float(np.min((walls - origin)[moving] / direction[moving], initial=np.inf))
