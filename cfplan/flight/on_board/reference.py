"""Reference of on-board polynomials: a plan, slowed if necessary, with a lead that makes the vehicle fly the plan.

The acceleration of a streamed setpoint compensates for drag. That of a polynomial follows from its positions, so the
vehicle would lag by drag over stiffness, 7 cm at 2 m/s. For a known controller the reference that makes it fly the plan
is known too: with a lead e, and F = m a + kp e + kd e' + ki ∫e the controller's command,

    m e'' + kd e' + kp e + ki ∫e = (drag) v + L m a'

where L, along z only, is for the lag of the motors. e is zero before the flight and fades out after it, as the
controller's integral takes ten seconds to decay.

This assumes that attitude is as commanded. The remaining deviation is learned in a dry run, see correction.py.
"""

from dataclasses import dataclass, field
from math import comb

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray
from scipy.signal import bilinear, lfilter

from cfplan.flight.firmware import gains_for
from cfplan.flight.on_board.correction import Correction
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.trajectory import Trajectory

TAIL = 1.0  # s after the plan, in which the lead fades out
HALF_TICK = 0.005  # s, mean delay of the commander's goals, as each is held for 10 ms
LIFT_LAG = 0.5  # times the motors' time constant, for L; in the simulator more slows flights without gain
_STEP = 1e-3  # s


@dataclass(frozen=True, slots=True)
class PolynomialReference:
    """The motion to which polynomials are fitted, at any time."""

    trajectory: Trajectory
    slowing: float = 1.0  # times the plan's duration
    leads: bool = False  # whether it leads the plan, for the firmware's Mellinger controller
    correction: Correction | None = None  # of the deviation that remains with the lead
    _ahead: NDArray = field(init=False, repr=False)  # (N, 5, 3): e and its derivatives, every _STEP

    def __post_init__(self) -> None:
        object.__setattr__(self, "_ahead", self._find_lead() if self.leads else np.zeros((0, 5, 3)))

    @property
    def duration(self) -> float:
        """Return the time, s, from rest to rest."""
        return self.trajectory.duration * self.slowing + (TAIL if self.leads else 0.0)

    def plan_at(self, times: NDArray) -> NDArray:
        """Return position and yaw of the plan as slowed, and four derivatives by time, (N, 5, 4)."""
        own = times / self.slowing
        state = self.trajectory.at(own)
        out = np.zeros((len(times), 5, 4))
        moved = (state.position, state.velocity, state.acceleration, state.jerk, state.snap)
        out[:, :, :3] = np.stack(moved, axis=1)
        profile = self.trajectory.profile.at(state.s)
        flying = (own >= 0.0) & (own <= self.trajectory.duration)
        out[:, 0, 3] = state.yaw
        out[flying, 1, 3] = (np.sqrt(profile.h) * profile.dyaw)[flying]
        out[flying, 2, 3] = (profile.h * profile.ddyaw + 0.5 * profile.dh * profile.dyaw)[flying]
        return np.asarray(out / self.slowing ** np.arange(5)[:, None])

    def at(self, times: NDArray) -> NDArray:
        """Return the motion to fit, (N, 5, 4) like plan_at(); yaw's third and fourth derivatives are 0."""
        if not self.leads:
            return self.plan_at(times)
        out = self.plan_at(times + HALF_TICK)
        place = np.clip((times / _STEP).astype(int), 0, len(self._ahead) - 1)
        by = (times - place * _STEP)[:, None]
        e = self._ahead[place]
        for order in range(5):
            more, term = np.zeros((len(times), 3)), np.ones((len(times), 1))
            for k in range(order, 5):
                more += e[:, k] * term
                term = term * by / (k - order + 1)
            out[:, order, :3] += more
        if self.correction is not None:
            out[:, :, :3] += self.correction.at(times, self.duration)
        return out

    def ends(self) -> NDArray:
        """Return position and yaw of start and end, (2, 4)."""
        first, last = (self.trajectory.at(time) for time in (0.0, self.trajectory.duration))
        return np.array([[*first.position, first.yaw], [*last.position, last.yaw]])

    def _find_lead(self) -> NDArray:
        """Return e and four derivatives, (N, 5, 3), by the transfer functions from the disturbing forces."""
        airframe = self.trajectory.airframe
        plan = self.plan_at(np.arange(int(np.ceil(self.duration / _STEP)) + 2) * _STEP + HALF_TICK)[:, :, :3]
        out = np.zeros_like(plan)
        drag = np.array([airframe.drag[0], airframe.drag[0], airframe.drag[1]])
        lag = np.array([0.0, 0.0, LIFT_LAG * airframe.motor_time_constant * airframe.mass])
        pull, pull_dt = drag * plan[:, 1] + lag * plan[:, 3], drag * plan[:, 2] + lag * plan[:, 4]
        for axis in range(3):
            mass, kd, kp, ki = _stiffness(airframe, axis)
            for order in range(3):
                numerator = np.zeros(order + 2)
                numerator[0] = 1.0  # s^(order + 1)
                out[:, order, axis] = lfilter(*bilinear(numerator, [mass, kd, kp, ki], 1.0 / _STEP), pull[:, axis])
            e = out[:, :, axis]
            e[:, 3] = (pull_dt[:, axis] - kd * e[:, 2] - kp * e[:, 1] - ki * e[:, 0]) / mass
            e[:, 4] = np.gradient(e[:, 3], _STEP)
        fading = _fading(np.clip(np.arange(len(out)) * _STEP - (self.duration - TAIL), 0.0, TAIL) / TAIL)
        scale = TAIL ** -np.arange(5.0)
        faded = [
            sum(comb(order, k) * scale[k] * fading[k][:, None] * out[:, order - k] for k in range(order + 1))
            for order in range(5)
        ]
        return np.stack(faded, axis=1)


def _fading(place: NDArray) -> list[NDArray]:
    """Return a blend from 1 at place 0 to 0 at place 1, and four derivatives, which are 0 at both ends."""
    fall = Polynomial([1.0, 0, 0, 0, 0, -126.0, 420.0, -540.0, 315.0, -70.0])
    return [fall.deriv(order)(place) if order else fall(place) for order in range(5)]


def _stiffness(airframe: Airframe, axis: int) -> tuple[float, float, float, float]:
    """Return mass, kd, kp and ki, along an axis."""
    gains = gains_for(airframe)
    if axis < 2:
        return gains.mass, gains.kd_xy, gains.kp_xy, gains.ki_xy
    return gains.mass, gains.kd_z, gains.kp_z, gains.ki_z
