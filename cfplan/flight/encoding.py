"""A trajectory as the packets that fly it, and the check that those bytes say what was planned.

The packet's quaternion. The controller takes from it only the Euler yaw (ZYX) ψ, and builds its attitude from the
thrust vector: z along it, y along z × [cos ψ, sin ψ, 0]. The planned attitude (Hopf) has another ψ at the same heading:
the one with which the controller arrives at just that attitude is ψ = atan2(-y₁, y₂) of the planned body y axis. Sent
is the quaternion with the planned thrust axis and that Euler yaw; at 30° of tilt it is up to 8° of yaw away from the
planned attitude, and the controller, reading it, is not.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cfplan.errors import NotCertifiedError
from cfplan.flight.packets import FULL_STATE_TYPE, PAYLOAD_SIZE, FullStateSetpoints, decode, encode
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.trajectory import FullState, Trajectory

RATE = 100.0  # Hz
HOLD = 0.5  # s of hover after the end, so that what the vehicle keeps when the stream stops is a hover

RATE_LEAD = 0.015
# s by which body rates are sent ahead of the rest. The controller turns them into torque, which the motors give late:
# at lags of 0.07 to 0.13 s this takes up to a third off the worst deviation and costs at most half a centimetre.

HALF_QUANTUM = 0.5e-3  # of position m, velocity m/s, acceleration m/s², body rate rad/s
ATTITUDE_QUANTUM = np.radians(0.25)  # the most by which the compressed quaternion turns
_ROUNDING = 1e-9


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
) -> EncodedFlight:
    """The payloads of a flight: full states at `rate`, Hz, then hover at the end for at least `hold`, s.

    `lead`, s, samples the trajectory that much ahead of the clock; none pays, as a setpoint held for 10 ms and poses
    that are as old make up for each other. Raises NotCertifiedError with the setpoint where a value is not finite or
    does not fit its 16 bits.
    """
    if not (np.isfinite(trajectory.duration) and rate > 0 and hold >= 0 and np.isfinite(lead + rate_lead)):
        raise NotCertifiedError(f"cannot sample {trajectory.duration} s at {rate} Hz with a hold of {hold} s")
    moving = int(np.ceil(trajectory.duration * rate)) + 1
    times = np.arange(moving + int(np.ceil(hold * rate))) / rate
    payloads = encode(setpoints_at(trajectory, times + lead, rate_lead))
    return EncodedFlight(times, payloads, decode(payloads), lead, rate_lead)


def setpoints_at(trajectory: Trajectory, times: NDArray, rate_lead: float = RATE_LEAD) -> FullStateSetpoints:
    """What the controller is to be told at each time, (N,) s: the acceleration includes what makes up for drag."""
    states = trajectory.at(times)
    return FullStateSetpoints(
        position=states.position,
        velocity=states.velocity,
        acceleration=thrust_vector(states) - np.array([0.0, 0.0, GRAVITY]),
        quaternion=command_quaternion(states.quaternion),
        body_rate=trajectory.at(times + rate_lead).body_rate,
    )


def thrust_vector(states: FullState) -> NDArray:
    """(N, 3) m/s², what the rotors must give over mass."""
    return states.specific_thrust[:, None] * states.thrust_axis


def command_quaternion(quaternion: NDArray) -> NDArray:
    """(N, 4) x y z w to send so that the controller arrives at the attitudes `quaternion`, (N, 4)."""
    _, y, z = np.moveaxis(_rotations(quaternion), 2, 0)
    yaw = np.arctan2(-y[:, 0], y[:, 1])
    heading = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    x = np.column_stack([heading, -np.sum(heading * z[:, :2], axis=1) / z[:, 2]])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return Rotation.from_matrix(np.stack([x, np.cross(z, x), z], axis=2)).as_quat()


def controller_attitude(thrust: NDArray, quaternion: NDArray) -> NDArray:
    """(N, 3, 3) the attitudes that the controller makes of thrust vectors (N, 3) and received quaternions (N, 4)."""
    x, y, z, w = np.moveaxis(quaternion, -1, 0)
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    axis = thrust / np.linalg.norm(thrust, axis=1, keepdims=True)
    left = np.cross(axis, np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))]))
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    return np.stack([np.cross(left, axis), left, axis], axis=2)


def check_bytes(encoded: EncodedFlight, trajectory: Trajectory, limits: PlanLimits) -> None:
    """Certify the bytes, not what they were made of. Raises NotCertifiedError with the setpoint at fault.

    Every field of the decoded payloads lies within half a quantum of the trajectory at its time, the quaternion and
    the attitude that the controller makes of it within what its bits allow; speed, acceleration, body rate, tilt and
    specific thrust are within the limits and their quanta; the last setpoint is a hover at the end of the path.
    """
    payloads = np.asarray(encoded.payloads)
    if payloads.ndim != 2 or payloads.shape != (len(encoded.times), PAYLOAD_SIZE) or len(payloads) == 0:
        raise NotCertifiedError(f"payloads of shape {payloads.shape} for {len(encoded.times)} times")
    _require(payloads[:, 0] == FULL_STATE_TYPE, "the payload is no full state", payloads[:, 0])
    told = decode(payloads)
    times = encoded.times + encoded.lead
    states = trajectory.at(times)
    meant = setpoints_at(trajectory, times, encoded.rate_lead)
    for name in ("position", "velocity", "acceleration", "body_rate"):
        error = np.abs(getattr(told, name) - getattr(meant, name)).max(axis=1)
        _require(
            error <= HALF_QUANTUM + _ROUNDING, f"{name} in the packet is not that of the trajectory, off by", error
        )

    force = told.acceleration + np.array([0.0, 0.0, GRAVITY])
    thrust = np.linalg.norm(force, axis=1)
    quantum = np.sqrt(3) * HALF_QUANTUM + _ROUNDING
    _require(thrust >= limits.specific_thrust_min - quantum, "too little specific thrust in the packet, m/s²", thrust)
    tilt = np.arccos(np.clip(force[:, 2] / thrust, -1.0, 1.0))
    off = _angles(_rotations(told.quaternion), _rotations(meant.quaternion))
    _require(off <= ATTITUDE_QUANTUM, "quaternion in the packet is not that of the trajectory, off by rad", off)
    # The controller makes its attitude of thrust and yaw, and an error of the quaternion turns yaw 1/cos(tilt) as far.
    off = _angles(controller_attitude(force, told.quaternion), _rotations(states.quaternion))
    _require(
        off * np.cos(tilt) <= ATTITUDE_QUANTUM, "the controller would not make the planned attitude, off by rad", off
    )
    for name, values, limit in (
        ("speed", told.velocity, limits.speed),
        ("acceleration", told.acceleration - (meant.acceleration - states.acceleration), limits.acceleration),
        ("angular velocity", told.body_rate, limits.angular_velocity),
    ):
        size = np.linalg.norm(values, axis=1)
        _require(size <= limit + quantum, f"{name} in the packet exceeds its limit, {limit:g}, with", size)
    _require(
        tilt <= limits.tilt + quantum / thrust, f"tilt in the packet exceeds its limit, {limits.tilt:.4g}, with", tilt
    )
    _require_hover(told, trajectory.at(np.array([trajectory.duration])).position[0])


def _require_hover(told: FullStateSetpoints, end: NDArray) -> None:
    """The last setpoint is what the vehicle is left with if nothing more comes."""
    moves = [told.velocity[-1], told.acceleration[-1], told.body_rate[-1]]
    if np.any(moves) or np.any(np.abs(told.position[-1] - end) > HALF_QUANTUM + _ROUNDING):
        raise NotCertifiedError(
            "the last setpoint is not a hover at the end of the path",
            where=f"setpoint {len(told.position) - 1}",
            hint="encode the trajectory with a longer hold",
        )


def _require(good: NDArray, what: str, values: NDArray) -> None:
    if not np.all(good):
        row = int(np.flatnonzero(~good)[0])
        raise NotCertifiedError(f"{what} {values[row]:.4g}", where=f"setpoint {row}")


def _angles(first: NDArray, second: NDArray) -> NDArray:
    """(N,) rad between attitudes (N, 3, 3)."""
    return 2 * np.arcsin(np.clip(np.linalg.norm(first - second, axis=(1, 2)) / np.sqrt(8), 0.0, 1.0))


def _rotations(quaternion: NDArray) -> NDArray:
    return Rotation.from_quat(quaternion).as_matrix()
