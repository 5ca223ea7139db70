"""Trajectory: a speed profile along a path as motion in time, the full state at any time."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cfplan.errors import NotCertifiedError
from cfplan.geometry.path import Path
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.motion import STATE_ROWS, STATES, states_at
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.timing import Timing, measure

_SAME_S = 1e-9  # ends of path and profile nearer than this are the same


@dataclass(frozen=True, slots=True)
class FullState:
    """The full state of the vehicle at N times. For a scalar time the leading axis is absent."""

    time: NDArray  # (N,) s from the start
    s: NDArray  # (N,) where on the path
    position: NDArray  # (N, 3) m
    velocity: NDArray  # (N, 3) m/s
    acceleration: NDArray  # (N, 3) m/s², without gravity
    jerk: NDArray  # (N, 3) m/s³
    snap: NDArray  # (N, 3) m/s⁴
    quaternion: NDArray  # (N, 4) body→world, x y z w, continuous
    yaw: NDArray  # (N,) rad, of the Hopf fibration, not wrapped
    body_rate: NDArray  # (N, 3) rad/s, body axes
    angular_acceleration: NDArray  # (N, 3) rad/s², body axes
    torque: NDArray  # (N, 3) N m, body axes
    specific_thrust: NDArray  # (N,) m/s², collective thrust over mass
    thrust_axis: NDArray  # (N, 3) body z in the world
    motor_thrust: NDArray  # (N, 4) N, motors 1 to 4

    def rows(self, which: int | slice) -> "FullState":
        """Return one or several of the states."""
        return FullState(*(getattr(self, name)[which] for name in FullState.__slots__))


@dataclass(frozen=True, slots=True)
class Trajectory:
    """The flight of one profile. Before its start and after its end it hovers level at that end of the path.

    Raises NotCertifiedError unless h is finite and positive everywhere, also between the grid points.
    """

    path: Path
    profile: SpeedProfile
    airframe: Airframe
    timing: Timing = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "timing", measure(self.profile))
        start, end = float(self.profile.s[0]), float(self.profile.s[-1])
        if abs(start) > _SAME_S or abs(end - self.path.end) > _SAME_S * (1.0 + self.path.end):
            raise NotCertifiedError(
                f"the speed profile goes from s = {start:g} to {end:g}, the path to {self.path.end:g}",
                where="the speed profile",
                hint="plan along this path anew",
            )

    @property
    def duration(self) -> float:
        """Return the duration, s."""
        return float(self.timing.time[-1])

    def time_at(self, s: ArrayLike) -> NDArray:
        """Return the time, s, at which the vehicle is at s, (N,); within 1e-9 s. s is clipped to the path."""
        return self.timing.time_at(s)

    def s_at(self, time: ArrayLike) -> NDArray:
        """Return s at each time, (N,); within 1e-9. Time is clipped to the flight."""
        return self.timing.s_at(time)

    def at(self, time: ArrayLike) -> FullState:
        """Return the full state at each time, s from the start."""
        times = np.asarray(time, dtype=float)
        flat = times.reshape(-1)
        s = self.s_at(flat)
        curve, interval = self.path.derivatives(s), self.profile.interval(s)
        rows = states_at(self.airframe, curve, self.timing.nodes, s, interval)
        outside = ~((flat >= 0.0) & (flat <= self.duration))
        if outside.any():
            rows[:, outside] = self._hover(rows[STATES["yaw"], outside])
        state = state_of(flat, s, curve, rows)
        return state if times.ndim else state.rows(0)

    def _hover(self, yaw: NDArray) -> NDArray:
        """Return the full states of a level hover at each yaw, (N,) rad, as states_at() has them."""
        rows, zero = np.zeros((STATE_ROWS, len(yaw))), np.zeros(len(yaw))
        rows[STATES["thrust_axis"]] = np.array([[0.0], [0.0], [1.0]])
        rows[STATES["motor_thrust"]] = self.airframe.hover_thrust
        rows[STATES["quaternion"]] = zero, zero, np.sin(yaw / 2.0), np.cos(yaw / 2.0)
        rows[STATES["yaw"]], rows[STATES["specific_thrust"]] = yaw, GRAVITY
        return rows


def state_of(time: NDArray, s: NDArray, curve: NDArray, rows: NDArray) -> FullState:
    """Return full states, by name, from the result of states_at() at s, (N,), on a curve, (5, 3, N)."""
    return FullState(time=time, s=s, position=curve[0].T, **{name: rows[where].T for name, where in STATES.items()})
