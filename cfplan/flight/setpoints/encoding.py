"""A trajectory as the packets that fly it, and the check that those bytes say what was planned.

The packet's quaternion. The controller takes from it only the Euler yaw (ZYX) ψ, and builds its attitude from the
thrust vector: z along it, y along z × [cos ψ, sin ψ, 0]. The planned attitude (Hopf) has another ψ at the same heading:
the one with which the controller arrives at just that attitude is ψ = atan2(-y₁, y₂) of the planned body y axis. Sent
is the quaternion with the planned thrust axis and that Euler yaw; at 30° of tilt it is up to 8° of yaw away from the
planned attitude, and the controller, reading it, is not.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import NotCertifiedError
from cfplan.flight.setpoints.packets import FULL_STATE_TYPE, PAYLOAD_SIZE, FullStateSetpoints, decode, encode, joined
from cfplan.machine_code import njit
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.trajectory import Trajectory

RATE = 100.0  # Hz
HOLD = 0.5  # s of hover after the end, so that what the vehicle keeps when the stream stops is a hover

RATE_LEAD = 0.015
# s by which body rates are sent ahead of the rest. The controller turns them into torque, which the motors give late:
# at lags of 0.07 to 0.13 s this takes up to a third off the worst deviation and costs at most half a centimetre.

THRUST_LEAD = 0.06
# s by which the length of the thrust vector is sent ahead of its direction, as motors give it late. At lags of 0.05 to
# 0.13 s it takes a third to two thirds off the worst deviation; where there is no lag it costs half a centimetre at
# 2 m/s and three at 5. What is sent is still a thrust of the plan, so no limit is nearer.

HALF_QUANTUM = 0.5e-3  # of position m, velocity m/s, acceleration m/s², body rate rad/s
ATTITUDE_QUANTUM = np.radians(0.25)  # the most by which the compressed quaternion turns
_ROUNDING = 1e-9
_SAME_TIME = 1e-9  # s
_BATCH = 4096  # setpoints at a time, so that memory does not grow with the states of a long flight


@dataclass(frozen=True, slots=True)
class EncodedFlight:
    """A trajectory as the bytes that are sent, each at its time."""

    times: NDArray
    # (N,) s after the start of the stream, when each payload is due
    payloads: NDArray
    # (N, 29) uint8
    decoded: FullStateSetpoints
    # what the vehicle reads from them
    lead: float
    # s by which each setpoint is ahead of the trajectory at its time
    rate_lead: float
    # s by which its body rate is ahead of that
    thrust_lead: float
    # s by which the length of its thrust vector is

    @property
    def duration(self) -> float:
        """s, from the first payload to the last."""
        return float(self.times[-1])


def encode_trajectory(
    trajectory: Trajectory,
    *,
    rate: float = RATE,
    hold: float = HOLD,
    lead: float = 0.0,
    rate_lead: float = RATE_LEAD,
    thrust_lead: float = THRUST_LEAD,
) -> EncodedFlight:
    """The payloads of a flight: full states at `rate`, Hz, then hover at the end for at least `hold`, s.

    `lead`, s, samples the trajectory that much ahead of the clock; none pays, as a setpoint held for 10 ms and poses
    that are as old make up for each other. Raises NotCertifiedError with the setpoint where a value is not finite or
    does not fit its 16 bits.
    """
    return _encoded(trajectory, rate, hold, lead, rate_lead, thrust_lead, limits=None)


def encode_checked(trajectory: Trajectory, limits: PlanLimits, *, hold: float = HOLD) -> EncodedFlight:
    """What encode_trajectory() makes, certified as by check_bytes(); the trajectory is evaluated once for both."""
    encoded = _encoded(trajectory, RATE, hold, 0.0, RATE_LEAD, THRUST_LEAD, limits)
    _require_hover(encoded.decoded, trajectory, len(encoded.payloads))
    return encoded


def _encoded(
    trajectory: Trajectory,
    rate: float,
    hold: float,
    lead: float,
    rate_lead: float,
    thrust_lead: float,
    limits: PlanLimits | None,
) -> EncodedFlight:
    """Each setpoint is checked against limits where there are any."""
    times = _times(trajectory, rate, hold, (lead, rate_lead, thrust_lead))
    payloads, told = [], []
    for rows in _batches(len(times)):
        meant = _meant_at(trajectory, times[rows] + lead, rate_lead, thrust_lead)
        payloads.append(encode(meant.setpoints, rows.start))
        told.append(decode(payloads[-1]))
        if limits is not None:
            _check_rows(payloads[-1], told[-1], meant, limits, rows.start)
    return EncodedFlight(times, np.concatenate(payloads), joined(told), lead, rate_lead, thrust_lead)


def _times(trajectory: Trajectory, rate: float, hold: float, leads: Sequence[float]) -> NDArray:
    if not (np.isfinite(trajectory.duration) and rate > 0 and hold >= 0 and np.isfinite(sum(leads))):
        raise NotCertifiedError(f"cannot sample {trajectory.duration} s at {rate} Hz with a hold of {hold} s")
    moving = int(np.ceil(trajectory.duration * rate)) + 1
    return np.arange(moving + int(np.ceil(hold * rate))) / rate


def _batches(count: int) -> Iterator[slice]:
    return (slice(first, min(first + _BATCH, count)) for first in range(0, count, _BATCH))


def setpoints_at(
    trajectory: Trajectory, times: NDArray, rate_lead: float = RATE_LEAD, thrust_lead: float = THRUST_LEAD
) -> FullStateSetpoints:
    """What the controller is to be told at each time, (N,) s: the acceleration includes what makes up for drag."""
    return _meant_at(trajectory, times, rate_lead, thrust_lead).setpoints


class _Meant(NamedTuple):
    """What is to be told at N times, and what the plan has there."""

    setpoints: FullStateSetpoints
    acceleration: NDArray
    # (N, 3)
    attitude: NDArray
    # (N, 4)


def _meant_at(trajectory: Trajectory, times: NDArray, rate_lead: float, thrust_lead: float) -> _Meant:
    # Often the times ahead are those of later setpoints: then only what lies beyond the last is evaluated besides.
    count, ahead = len(times), _steps_ahead(times, thrust_lead)
    beyond = times[count - ahead :] + thrust_lead
    states = trajectory.at(np.concatenate([times, beyond, times + rate_lead]))
    due, pushing, turning = slice(count), slice(ahead, ahead + count), slice(count + ahead, None)
    acceleration = states.specific_thrust[pushing, None] * states.thrust_axis[due]
    acceleration[:, 2] -= GRAVITY
    attitude = states.quaternion[due]
    setpoints = FullStateSetpoints(
        position=states.position[due],
        velocity=states.velocity[due],
        acceleration=acceleration,
        quaternion=command_quaternion(attitude),
        body_rate=states.body_rate[turning],
    )
    return _Meant(setpoints, states.acceleration[due], attitude)


def _steps_ahead(times: NDArray, lead: float) -> int:
    """How many times later each time is that much later; all of them where that is none of them."""
    steps = int(np.searchsorted(times, times[0] + lead - _SAME_TIME))
    return steps if np.all(np.abs(times[steps:] - times[: len(times) - steps] - lead) < _SAME_TIME) else len(times)


def command_quaternion(quaternion: NDArray) -> NDArray:
    """(N, 4) x y z w to send so that the controller arrives at the attitudes `quaternion`, (N, 4)."""
    return _commands(np.array(quaternion, dtype=float))


def controller_attitude(thrust: NDArray, quaternion: NDArray) -> NDArray:
    """(N, 3, 3) the attitudes that the controller makes of thrust vectors (N, 3) and received quaternions (N, 4)."""
    return _attitudes(np.array(thrust, dtype=float), np.array(quaternion, dtype=float))


def check_bytes(encoded: EncodedFlight, trajectory: Trajectory, limits: PlanLimits) -> None:
    """Certify the bytes, not what they were made of. Raises NotCertifiedError with the setpoint at fault.

    Every field of the decoded payloads lies within half a quantum of the trajectory at its time, the quaternion and
    the attitude that the controller makes of it within what its bits allow; speed, acceleration, body rate, tilt and
    specific thrust are within the limits and their quanta; the last setpoint is a hover at the end of the path.
    """
    payloads = np.asarray(encoded.payloads)
    if payloads.ndim != 2 or payloads.shape != (len(encoded.times), PAYLOAD_SIZE) or len(payloads) == 0:
        raise NotCertifiedError(f"payloads of shape {payloads.shape} for {len(encoded.times)} times")
    for rows in _batches(len(payloads)):
        meant = _meant_at(trajectory, encoded.times[rows] + encoded.lead, encoded.rate_lead, encoded.thrust_lead)
        _check_rows(payloads[rows], decode(payloads[rows]), meant, limits, rows.start)
    _require_hover(decode(payloads[-1:]), trajectory, len(payloads))


def _check_rows(payloads: NDArray, told: FullStateSetpoints, meant: _Meant, limits: PlanLimits, first: int) -> None:
    """What check_bytes asks of each setpoint, of those from number `first` on; `told` is what the payloads say."""

    def require(good: NDArray, what: str, values: NDArray) -> None:
        _require(good, what, values, first)

    require(payloads[:, 0] == FULL_STATE_TYPE, "the payload is no full state", payloads[:, 0])
    wanted = meant.setpoints
    (
        position, velocity, thrust_error, rate_error, thrust, tilt, turned, made, speed, planned, body_rate
    ) = _inspected(
        told.position, told.velocity, told.acceleration, told.quaternion, told.body_rate,
        wanted.position, wanted.velocity, wanted.acceleration, wanted.quaternion, wanted.body_rate,
        meant.acceleration, meant.attitude,
    )  # fmt: skip
    for name, error in (
        ("position", position), ("velocity", velocity), ("acceleration", thrust_error), ("body_rate", rate_error)
    ):  # fmt: skip
        require(error <= HALF_QUANTUM + _ROUNDING, f"{name} in the packet is not that of the trajectory, off by", error)

    quantum = np.sqrt(3) * HALF_QUANTUM + _ROUNDING
    require(thrust >= limits.specific_thrust_min - quantum, "too little specific thrust in the packet, m/s²", thrust)
    require(turned <= ATTITUDE_QUANTUM, "quaternion in the packet is not that of the trajectory, off by rad", turned)
    # The controller makes its attitude of thrust and yaw, and an error of the quaternion turns yaw 1/cos(tilt) as far.
    require(
        made * np.cos(tilt) <= ATTITUDE_QUANTUM, "the controller would not make the planned attitude, off by rad", made
    )
    for name, size, limit in (
        ("speed", speed, limits.speed),
        ("acceleration", planned, limits.acceleration),
        ("angular velocity", body_rate, limits.angular_velocity),
    ):
        require(size <= limit + quantum, f"{name} in the packet exceeds its limit, {limit:g}, with", size)
    require(
        tilt <= limits.tilt + quantum / thrust, f"tilt in the packet exceeds its limit, {limits.tilt:.4g}, with", tilt
    )


def _require_hover(told: FullStateSetpoints, trajectory: Trajectory, count: int) -> None:
    """The last setpoint is what the vehicle is left with if nothing more comes."""
    moves = [told.velocity[-1], told.acceleration[-1], told.body_rate[-1]]
    end = trajectory.path(trajectory.path.end)
    if np.any(moves) or np.any(np.abs(told.position[-1] - end) > HALF_QUANTUM + _ROUNDING):
        raise NotCertifiedError(
            "the last setpoint is not a hover at the end of the path",
            where=f"setpoint {count - 1}",
            hint="encode the trajectory with a longer hold",
        )


def _require(good: NDArray, what: str, values: NDArray, first: int = 0) -> None:
    """`first` is the number of the setpoint that the first row is of."""
    if not np.all(good):
        row = int(np.flatnonzero(~good)[0])
        raise NotCertifiedError(f"{what} {values[row]:.4g}", where=f"setpoint {first + row}")


@njit(error_model="numpy")
def _inspected(
    position: NDArray, velocity: NDArray, acceleration: NDArray, quaternion: NDArray, body_rate: NDArray,
    meant_position: NDArray, meant_velocity: NDArray, meant_acceleration: NDArray, meant_quaternion: NDArray,
    meant_body_rate: NDArray, planned: NDArray, attitude: NDArray,
) -> NDArray:  # fmt: skip
    """(11, N) of what setpoints say and what is meant.

    The largest errors of position, velocity, acceleration and body rate; specific thrust and tilt; rad by which the
    quaternion is off, and the attitude that the controller makes; speed, planned acceleration as sent, body rate.
    """
    out = np.empty((11, len(position)))
    force = acceleration.copy()
    force[:, 2] += GRAVITY
    out[6] = _angles(_frames(quaternion), _frames(meant_quaternion))
    out[7] = _angles(_attitudes(force, quaternion), _frames(attitude))
    for n in range(len(position)):
        a, b, c, d = position[n], velocity[n], acceleration[n], body_rate[n]
        e, f, g, h = meant_position[n], meant_velocity[n], meant_acceleration[n], meant_body_rate[n]
        out[0, n] = _largest(a[0] - e[0], a[1] - e[1], a[2] - e[2])
        out[1, n] = _largest(b[0] - f[0], b[1] - f[1], b[2] - f[2])
        out[2, n] = _largest(c[0] - g[0], c[1] - g[1], c[2] - g[2])
        out[3, n] = _largest(d[0] - h[0], d[1] - h[1], d[2] - h[2])
        out[4, n] = thrust = _norm(force[n, 0], force[n, 1], force[n, 2])
        out[5, n] = math.acos(min(max(force[n, 2] / thrust, -1.0), 1.0))
        out[8, n] = _norm(b[0], b[1], b[2])
        wanted = planned[n]  # the acceleration sent makes up for drag besides
        out[9, n] = _norm(c[0] - g[0] + wanted[0], c[1] - g[1] + wanted[1], c[2] - g[2] + wanted[2])
        out[10, n] = _norm(d[0], d[1], d[2])
    return out


@njit(error_model="numpy")
def _largest(x: float, y: float, z: float) -> float:
    """Of the sizes; not a number where one is none."""
    sizes = abs(x) + abs(y) + abs(z)
    return max(abs(x), abs(y), abs(z)) if sizes == sizes else sizes


@njit(error_model="numpy")
def _norm(x: float, y: float, z: float) -> float:
    return math.sqrt(x * x + y * y + z * z)


@njit(error_model="numpy")
def _angles(first: NDArray, second: NDArray) -> NDArray:
    """(N,) rad between attitudes (N, 3, 3)."""
    out = np.empty(len(first))
    for n in range(len(first)):
        total = 0.0
        for i in range(3):
            for j in range(3):
                total += (first[n, i, j] - second[n, i, j]) ** 2
        half = math.sqrt(total / 8.0)
        out[n] = 2.0 * math.asin(half if half <= 1.0 else 1.0) if half == half else half  # what is no number stays so
    return out


@njit(error_model="numpy")
def _frames(quaternions: NDArray) -> NDArray:
    """(N, 3, 3) whose columns are the body axes of attitudes (N, 4), not zero."""
    out = np.empty((len(quaternions), 3, 3))
    for n in range(len(quaternions)):
        x, y, z, w = quaternions[n, 0], quaternions[n, 1], quaternions[n, 2], quaternions[n, 3]
        scale = 2.0 / (x * x + y * y + z * z + w * w)
        out[n, 0, 0], out[n, 1, 1] = 1.0 - scale * (y * y + z * z), 1.0 - scale * (x * x + z * z)
        out[n, 2, 2] = 1.0 - scale * (x * x + y * y)
        out[n, 0, 1], out[n, 1, 0] = scale * (x * y - z * w), scale * (x * y + z * w)
        out[n, 0, 2], out[n, 2, 0] = scale * (x * z + y * w), scale * (x * z - y * w)
        out[n, 1, 2], out[n, 2, 1] = scale * (y * z - x * w), scale * (y * z + x * w)
    return out


@njit(error_model="numpy")
def _attitudes(thrusts: NDArray, quaternions: NDArray) -> NDArray:
    """What controller_attitude gives: z along the thrust, y along z × [cos yaw, sin yaw, 0]."""
    out = np.empty((len(thrusts), 3, 3))
    for n in range(len(thrusts)):
        x, y, z, w = quaternions[n, 0], quaternions[n, 1], quaternions[n, 2], quaternions[n, 3]
        cos, sin = _direction(1.0 - 2.0 * (y * y + z * z), 2.0 * (w * z + x * y))  # of yaw
        a, b, c = thrusts[n, 0], thrusts[n, 1], thrusts[n, 2]
        norm = math.sqrt(a * a + b * b + c * c)
        a, b, c = a / norm, b / norm, c / norm
        left = (-c * sin, c * cos, a * sin - b * cos)
        norm = math.sqrt(left[0] ** 2 + left[1] ** 2 + left[2] ** 2)
        p, q, r = left[0] / norm, left[1] / norm, left[2] / norm
        out[n, 0, 0], out[n, 1, 0], out[n, 2, 0] = q * c - r * b, r * a - p * c, p * b - q * a
        out[n, 0, 1], out[n, 1, 1], out[n, 2, 1] = p, q, r
        out[n, 0, 2], out[n, 1, 2], out[n, 2, 2] = a, b, c
    return out


@njit(error_model="numpy")
def _commands(quaternions: NDArray) -> NDArray:
    """What command_quaternion gives: z as planned, x above [cos yaw, sin yaw]."""
    out = np.empty((len(quaternions), 4))
    planned = _frames(quaternions)
    for n in range(len(quaternions)):
        frame = planned[n]
        a, b, c = frame[0, 2], frame[1, 2], frame[2, 2]
        cos, sin = _direction(frame[1, 1], -frame[0, 1])  # of yaw
        rise = -(cos * a + sin * b) / c
        norm = math.sqrt(1.0 + rise * rise)
        p, q, r = cos / norm, sin / norm, rise / norm
        frame[0, 0], frame[1, 0], frame[2, 0] = p, q, r
        frame[0, 1], frame[1, 1], frame[2, 1] = b * r - c * q, c * p - a * r, a * q - b * p
        _write_quaternion(out[n], frame)
    return out


@njit(error_model="numpy")
def _direction(x: float, y: float) -> tuple[float, float]:
    """Cosine and sine of atan2(y, x)."""
    size = math.sqrt(x * x + y * y)
    return (1.0, 0.0) if size == 0.0 else (x / size, y / size)


@njit(error_model="numpy")
def _write_quaternion(out: NDArray, frame: NDArray) -> None:
    """x y z w of a rotation matrix, by way of the largest component (Shepperd 1978)."""
    trace = frame[0, 0] + frame[1, 1] + frame[2, 2]
    i = 0 if frame[0, 0] >= frame[1, 1] and frame[0, 0] >= frame[2, 2] else 1 if frame[1, 1] >= frame[2, 2] else 2
    j, k = (i + 1) % 3, (i + 2) % 3
    if trace >= frame[i, i]:
        twice = math.sqrt(1.0 + trace)
        for axis in range(3):
            before, behind = (axis + 1) % 3, (axis + 2) % 3
            out[axis] = (frame[behind, before] - frame[before, behind]) / (2.0 * twice)
        out[3] = twice / 2.0
    else:
        twice = math.sqrt(1.0 + frame[i, i] - frame[j, j] - frame[k, k])
        out[i] = twice / 2.0
        out[j] = (frame[j, i] + frame[i, j]) / (2.0 * twice)
        out[k] = (frame[k, i] + frame[i, k]) / (2.0 * twice)
        out[3] = (frame[k, j] - frame[j, k]) / (2.0 * twice)
