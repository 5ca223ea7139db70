"""Joint: the state at which one trajectory continues another without a jump; and joined trajectories.

The second trajectory begins with γ to γ'''' and the boundary state (h, h', h'', ψ, ψ') of the first, in its unit of s.
Position, velocity, acceleration, jerk, attitude and body rates are then continuous; only snap, and with it angular
acceleration and motor thrust, may jump, as h''' and ψ'' do at every grid point of a profile.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cfplan.errors import InputError
from cfplan.geometry.polynomials import ORDERS
from cfplan.vehicle.profile import BoundaryState
from cfplan.vehicle.trajectory import FullState, Trajectory


@dataclass(frozen=True, slots=True, eq=False)
class Joint:
    """The state of a trajectory at a moment, from which another continues."""

    time: float  # s, of the first trajectory
    s: float  # position on its path
    derivatives: NDArray  # (5, 3) γ to γ''''
    state: BoundaryState

    def timed(self, trajectory: Trajectory, rate: float) -> "Joint":
        """Return the same state with time as s, in `rate` units per second.

        Then h is the constant square of `rate`, and γ' to γ'''' are the vehicle's velocity to snap in these units.
        """
        moving = trajectory.at(self.time)
        derivatives = np.array([moving.position, moving.velocity, moving.acceleration, moving.jerk, moving.snap])
        derivatives /= rate ** np.arange(ORDERS)[:, None]
        derivatives.setflags(write=False)
        turning = self.state.dyaw * self.state.h**0.5
        return Joint(self.time, self.s, derivatives, BoundaryState(rate**2, 0.0, 0.0, self.state.yaw, turning / rate))


def joint_at(trajectory: Trajectory, time: float) -> Joint:
    """Return the joint at a time, s, while the trajectory moves. Raises InputError at other times."""
    if not 0.0 <= time <= trajectory.duration:
        raise InputError(
            f"the flight lasts from 0 to {trajectory.duration:.3f} s, so nothing moves at {time:.3f} s",
            where="joint",
            hint="plan from rest there",
        )
    s = float(trajectory.s_at(time))
    sample = trajectory.profile.at(np.array([s]))
    state = BoundaryState(*(float(each[0]) for each in (sample.h, sample.dh, sample.ddh, sample.yaw, sample.dyaw)))
    derivatives = trajectory.path.derivatives(np.array([s]))[..., 0]
    derivatives.setflags(write=False)
    return Joint(float(time), s, derivatives, state)


LOOK_BACK = 0.05  # s; setpoints use rates planned up to 0.03 s earlier (RATE_LEAD)


@dataclass(frozen=True, slots=True)
class JoinedTrajectory:
    """Trajectories on one clock, each flown until the start of the next, the last one to its end."""

    trajectories: tuple[Trajectory, ...]
    starts: tuple[float, ...]  # s, on the common clock, ascending

    def __post_init__(self) -> None:
        if not self.starts or len(self.starts) != len(self.trajectories):
            raise InputError(
                f"{len(self.trajectories)} trajectories and {len(self.starts)} starts",
                where="joined trajectory",
                hint="give as many starts as trajectories, at least one",
            )
        if not all(before < after for before, after in pairwise(self.starts)):
            raise InputError(
                f"starts do not ascend: {self.starts}", where="joined trajectory", hint="give them in order"
            )

    @property
    def duration(self) -> float:
        """Return when the last trajectory ends, s."""
        return self.starts[-1] + self.trajectories[-1].duration

    def at(self, time: ArrayLike) -> FullState:
        """Return the full state at each time, (N,) s; before the first start and after the end it hovers."""
        times = np.asarray(time, dtype=float)
        flat = times.reshape(-1)
        leg = np.maximum(np.searchsorted(self.starts, flat, side="right") - 1, 0)
        flown = {k: np.flatnonzero(leg == k) for k in np.unique(leg)}
        states = [self.trajectories[k].at(flat[rows] - self.starts[k]) for k, rows in flown.items()]
        order = np.argsort(np.concatenate(list(flown.values())))
        merged = {name: np.concatenate([getattr(each, name) for each in states])[order] for name in FullState.__slots__}
        state = FullState(**merged | {"time": flat})
        return state if times.ndim else state.rows(0)

    def since(self, time: float) -> "JoinedTrajectory":
        """Return the same flight on a clock that is 0 at `time`, s, without parts that ended LOOK_BACK before."""
        first = self._index_at(time)
        return JoinedTrajectory(self.trajectories[first:], tuple(start - time for start in self.starts[first:]))

    def kept_from(self, time: float) -> "JoinedTrajectory":
        """Return the same flight without the trajectories that since() leaves out at `time`, s; its clock stays."""
        first = self._index_at(time)
        return JoinedTrajectory(self.trajectories[first:], self.starts[first:])

    def _index_at(self, time: float) -> int:
        return max(int(np.searchsorted(self.starts, time - LOOK_BACK, side="right")) - 1, 0)

    def continued(self, time: float, trajectory: Trajectory) -> "JoinedTrajectory":
        """Return the flight that is this one until `time`, s, and then the trajectory."""
        kept = int(np.searchsorted(self.starts, time, side="left"))
        return JoinedTrajectory((*self.trajectories[:kept], trajectory), (*self.starts[:kept], time))
