"""Trajectory: a speed profile along a path as motion in time, the full state at any time."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cfplan.errors import NotCertifiedError
from cfplan.geometry.path import Path
from cfplan.machine_code import njit
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.dense import (
    STATES,
    SampleSource,
    accelerations_at,
    body_rates_at,
    flat_states,
    rest_outside,
    sample_source,
    thrusts_at,
)
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


@dataclass(frozen=True, slots=True)
class Trajectory:
    """The flight of one profile. Before its start and after its end it hovers level at that end of the path.

    Raises NotCertifiedError where h is not finite or not positive everywhere, also between the grid points.
    """

    path: Path
    profile: SpeedProfile
    airframe: Airframe
    timing: Timing = field(init=False, repr=False)
    source: SampleSource = field(init=False, repr=False, compare=False)  # what states are computed from

    def __post_init__(self) -> None:
        object.__setattr__(self, "timing", measure(self.profile))
        object.__setattr__(self, "source", sample_source(self.airframe, self.path, self.profile))
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
        """Return the time, s, at which the vehicle is at s, (N,); within 1e-9 s. s is held within the path."""
        return self.timing.time_at(s)

    def s_at(self, time: ArrayLike) -> NDArray:
        """Return where on the path the vehicle is at each time, (N,); within 1e-9. Time is held within the flight."""
        return self.timing.s_at(time)

    def at(self, time: ArrayLike) -> FullState:
        """Return the full state at each time, s from the start."""
        times = np.asarray(time, dtype=float)
        flat = times.reshape(-1)
        s = self.s_at(flat)
        table = flat_states(self.source, self.path.breaks, s)
        rest_outside(table, flat, self.duration, self.airframe.hover_thrust)
        state = _of_table(table, s, flat)
        return state if times.ndim else FullState(*(getattr(state, name)[0] for name in FullState.__slots__))

    def specific_thrust_at(self, times: NDArray) -> NDArray:
        """Return (N,) m/s²: what at() gives of it at each time, (N,) s, in a third of the time."""
        thrust = thrusts_at(self.source, self.path.breaks, self.s_at(times))
        _rest(thrust, times, self.duration, GRAVITY)
        return thrust[0]

    def body_rate_at(self, times: NDArray) -> NDArray:
        """Return (N, 3) rad/s likewise."""
        rate = body_rates_at(self.source, self.path.breaks, self.s_at(times))
        _rest(rate, times, self.duration, 0.0)
        return rate.T

    def acceleration_at(self, times: NDArray) -> NDArray:
        """Return (N, 3) m/s² likewise."""
        acceleration = accelerations_at(self.source, self.path.breaks, self.s_at(times))
        _rest(acceleration, times, self.duration, 0.0)
        return acceleration.T


@njit
def _rest(rows: NDArray, times: NDArray, duration: float, value: float) -> None:
    """Give rows, (K, N), the value that they have at rest at times before 0 and after the duration, s."""
    for n in range(len(times)):
        if not 0.0 <= times[n] <= duration:
            for row in range(len(rows)):
                rows[row, n] = value


def state_at(
    path: Path,
    profile: SpeedProfile,
    airframe: Airframe,
    s: NDArray,
    *,
    time: NDArray,
    interval: NDArray | None = None,
) -> FullState:
    """Return the full state at s, (N,), by the polynomials of `interval` where given (see SpeedProfile.at)."""
    return _of_table(flat_states(sample_source(airframe, path, profile), path.breaks, s, interval), s, time)


def _of_table(table: NDArray, s: NDArray, time: NDArray) -> FullState:
    return FullState(time=time, s=s, **{name: table[rows].T for name, rows in STATES.items()})
