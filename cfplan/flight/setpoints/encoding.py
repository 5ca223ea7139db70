"""Encoding: a trajectory as the packets that fly it.

    trajectory ─ motion_at() ─ motion to fly ─ trade_rates() ─ command_quaternion() ─ encode() ─ 29 bytes

1. Every 10 ms the trajectory gives position, velocity and attitude, its thrust is taken a little later, as motors give
   it late, and so are its body rates: the motion to fly.
2. Most of the roll and pitch rates is sent as a turn of that attitude, which makes the same torque and lets the vehicle
   level out where setpoints stop (rate_trade.py, level_out.py).
3. From the packet's quaternion the controller takes only the Euler yaw (ZYX) ψ, and builds its attitude from the thrust
   vector: z along it, y along z × [cos ψ, sin ψ, 0]. The planned attitude (Hopf) has another ψ at the same heading: the
   one with which the controller arrives at just that attitude is ψ = atan2(-y₁, y₂) of the planned body y axis. Sent is
   the quaternion with the planned thrust axis and that Euler yaw; at 30° of tilt it is up to 8° of yaw away from the
   planned attitude, and the controller, reading it, is not.
4. Values are rounded to thousandths and packed (packets.py).

byte_check.py then certifies the bytes against the trajectory, without what encoding computed.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.errors import NotCertifiedError
from cfplan.flight.setpoints.level_out import BRAKE_LEAD
from cfplan.flight.setpoints.packets import FullStateSetpoints, decode, encode
from cfplan.flight.setpoints.rate_trade import FIRMWARE_GAINS, AttitudeGains, trade_rates
from cfplan.machine_code import njit
from cfplan.safety.space import Space
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.joint import JoinedTrajectory
from cfplan.vehicle.rotations import Matrix, Vector, direction, heading_of, matrix_rows, quaternion_of
from cfplan.vehicle.trajectory import FullState, Trajectory

RATE = 100.0  # Hz
HOLD = 0.5  # s of hover after the end, so that what the vehicle keeps when the stream stops is a hover

# s by which setpoints are ahead of the clock: half of the 10 ms for which each is held. Poses are predicted to when
# they are sent, so the position that the vehicle believes is on time but for the beat of its filter, which is as long.
LEAD = 0.005

# s: the body rate that is sent is 4/5 of the one planned so much later and 1/5 of the one planned so much before. The
# controller turns rates into torque, which the motors give late: with a lag T, an angular acceleration α takes the
# torque of α + T dα/dt. What is sent is the rate + 0.018 s · α + 0.00045 s² · dα/dt, for the least deviations in the
# dry run of all paths at motor lags of 0.07, 0.105 and 0.13 s. A mean of planned rates is nearer to no limit than they.
RATE_LEAD = 0.03
LEADING_WEIGHT = 0.8

# s by which the length of the thrust vector is sent ahead of its direction, as motors give it late: for the least
# deviations in the dry run of all paths at motor lags of 0.07, 0.105 and 0.13 s; the lead of rates is for those in the
# stepped lab besides. What is sent is still a thrust of the plan, so no limit is nearer.
THRUST_LEAD = 0.077


@dataclass(frozen=True, slots=True)
class EncodedFlight:
    """A trajectory as the bytes that are sent, each at its time."""

    times: NDArray  # (N,) s after the start of the stream, when each payload is due; the trajectory's are LEAD later
    payloads: NDArray  # (N, 29) uint8
    decoded: FullStateSetpoints  # what the vehicle reads from them
    motion: FullStateSetpoints  # what they make the vehicle fly: planned, without what is sent ahead
    gains: AttitudeGains  # of the vehicle that these packets are for
    space: Space | None  # whose walls level-out leans away from

    @property
    def duration(self) -> float:
        """Return the time from the first payload to the last, s."""
        return float(self.times[-1])


def encode_trajectory(
    trajectory: Trajectory | JoinedTrajectory,
    *,
    hold: float = HOLD,
    gains: AttitudeGains = FIRMWARE_GAINS,
    space: Space | None = None,
    count: int | None = None,
) -> EncodedFlight:
    """Encode a flight: full states at RATE, then hover at the end for at least `hold`, s.

    `space` has the walls that a vehicle whose setpoints stop is to keep away from. With `count`, only the first `count`
    setpoints are made. Raises NotCertifiedError with the setpoint where a value is not finite or does not fit its 16
    bits.
    """
    if not (np.isfinite(trajectory.duration) and 0.0 <= hold < np.inf):
        raise NotCertifiedError(
            f"cannot sample {trajectory.duration} s with a hold of {hold} s",
            where="the encoding",
            hint="give finite times and a hold of at least 0",
        )
    total = int(np.ceil(trajectory.duration * RATE)) + 1 + int(np.ceil(hold * RATE))
    times = np.arange(total if count is None else min(total, count)) / RATE
    states, led, ahead = _sampled(trajectory, times + LEAD)
    payloads = encode_motion(led, ahead, gains, space=space)
    motion = _motion_of(states, states.specific_thrust, states.body_rate)
    return EncodedFlight(times, payloads, decode(payloads), motion, gains, space)


def motion_at(trajectory: Trajectory | JoinedTrajectory, times: NDArray) -> FullStateSetpoints:
    """Return the motion that setpoints are to make, at times (N,), s, of the RATE: the attitudes and rates to fly.

    The acceleration is that of the thrust, less gravity: it includes the compensation for drag.
    """
    return _sampled(trajectory, times)[1]


def _sampled(
    trajectory: Trajectory | JoinedTrajectory, times: NDArray
) -> tuple[FullState, FullStateSetpoints, NDArray]:
    """Return the states at those times, the same motion, and the acceleration BRAKE_LEAD later, (N, 3) m/s².

    The rates before and ahead, and that acceleration, are those of setpoints before and ahead, so the trajectory is
    evaluated there once. From the end on rates are 0, as the vehicle may be left with any setpoint there.
    """
    count, turning, braking = len(times), round(RATE_LEAD * RATE), round(BRAKE_LEAD * RATE)
    before, beyond = np.arange(-turning, 0) / RATE, np.arange(1, braking + 1) / RATE
    every = trajectory.at(np.concatenate([times[0] + before, times, times[-1] + beyond]))
    rates = LEADING_WEIGHT * every.body_rate[2 * turning :][:count]
    rates += (1.0 - LEADING_WEIGHT) * every.body_rate[:count]
    rates[times >= trajectory.duration] = 0.0
    states = every.rows(slice(turning, turning + count))
    thrust = trajectory.at(times + THRUST_LEAD).specific_thrust
    return states, _motion_of(states, thrust, rates), every.acceleration[turning + braking :][:count]


def _motion_of(states: FullState, thrust: NDArray, body_rate: NDArray) -> FullStateSetpoints:
    """Return the setpoints of states, with these thrusts, (N,) m/s², and body rates, (N, 3) rad/s."""
    acceleration = thrust[:, None] * states.thrust_axis
    acceleration[:, 2] -= GRAVITY
    return FullStateSetpoints(states.position, states.velocity, acceleration, states.quaternion, body_rate)


def encode_motion(
    motion: FullStateSetpoints,
    acceleration_ahead: NDArray,
    gains: AttitudeGains = FIRMWARE_GAINS,
    *,
    space: Space | None = None,
) -> NDArray:
    """Return the payloads, (N, 29) uint8, that make the vehicle fly a motion and are harmless when they stop.

    `acceleration_ahead`, (N, 3) m/s², is that of the motion BRAKE_LEAD later. Raises NotCertifiedError where a value is
    not finite or does not fit.
    """
    sent = trade_rates(motion, acceleration_ahead, gains, space)
    return encode(replace(sent, quaternion=command_quaternion(sent.quaternion)))


def command_quaternion(quaternion: NDArray) -> NDArray:
    """Return (N, 4) x y z w to send so that the controller arrives at the attitudes `quaternion`, (N, 4)."""
    return _commands(np.array(quaternion, dtype=float))


def controller_attitude(thrust: NDArray, quaternion: NDArray) -> NDArray:
    """Return the attitudes (N, 3, 3) that the controller makes of thrust vectors (N, 3) and quaternions (N, 4)."""
    return _attitudes(np.array(thrust, dtype=float), np.array(quaternion, dtype=float))


@njit(error_model="numpy")
def _commands(quaternions: NDArray) -> NDArray:
    """Return the result of command_quaternion()."""
    out = np.empty((len(quaternions), 4))
    for n in range(len(quaternions)):
        x, y, z, w = quaternions[n]
        frame = matrix_rows((x, y, z, w), 2.0 / (x * x + y * y + z * z + w * w))
        out[n, 0], out[n, 1], out[n, 2], out[n, 3] = quaternion_of(sent_rows(frame))
    return out


@njit(error_model="numpy")
def _attitudes(thrusts: NDArray, quaternions: NDArray) -> NDArray:
    """Return the result of controller_attitude()."""
    out = np.empty((len(thrusts), 3, 3))
    for n in range(len(thrusts)):
        rows = attitude_rows((thrusts[n, 0], thrusts[n, 1], thrusts[n, 2]), heading_of(quaternions[n]))
        out[n, 0, 0], out[n, 0, 1], out[n, 0, 2] = rows[0]
        out[n, 1, 0], out[n, 1, 1], out[n, 1, 2] = rows[1]
        out[n, 2, 0], out[n, 2, 1], out[n, 2, 2] = rows[2]
    return out


@register_jitable
def sent_rows(attitude: Matrix) -> Matrix:
    """Return the attitude to send for one to be made by the controller: the same z, and x above [cos yaw, sin yaw]."""
    a, b, c = attitude[0][2], attitude[1][2], attitude[2][2]
    cos, sin = direction(attitude[1][1], -attitude[0][1])  # of yaw
    rise = -(cos * a + sin * b) / c
    norm = math.sqrt(1.0 + rise * rise)
    p, q, r = cos / norm, sin / norm, rise / norm
    return (p, b * r - c * q, a), (q, c * p - a * r, b), (r, a * q - b * p, c)


@register_jitable
def attitude_rows(thrust: Vector, heading: tuple[float, float]) -> Matrix:
    """Return the controller's attitude: z along the thrust, y along z × [cos yaw, sin yaw, 0]."""
    cos, sin = direction(heading[0], heading[1])  # of yaw
    a, b, c = thrust
    norm = math.sqrt(a * a + b * b + c * c)
    a, b, c = a / norm, b / norm, c / norm
    left = (-c * sin, c * cos, a * sin - b * cos)
    norm = math.sqrt(left[0] ** 2 + left[1] ** 2 + left[2] ** 2)
    p, q, r = left[0] / norm, left[1] / norm, left[2] / norm
    return (q * c - r * b, p, a), (r * a - p * c, q, b), (p * b - q * a, r, c)
