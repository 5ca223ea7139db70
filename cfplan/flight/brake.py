"""Stops along the path, encoded before take-off for every moment of the flight.

From the setpoint that is due, the clock of the trajectory runs slower and slower until it stands: the vehicle brakes
on the path itself, where it was certified to be, and ends level at rest. With r the rate of that clock,

    v = r v₀,   a = r² a₀ + ṙ v₀,   attitude from a + g and yaw,   body rates from the turn between attitudes.

r falls as a smoothstep, so the braking deceleration is at most 1.5 v₀ / duration.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cfplan.flight.encoding import command_quaternion, controller_attitude
from cfplan.flight.packets import FullStateSetpoints, decode, encode
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.trajectory import hopf_quaternion

DURATION = 0.8  # s, from full speed to rest: 3.75 m/s² from 2 m/s on top of the turn's own
_GRAVITY = np.array([0.0, 0.0, GRAVITY])


def encode_stops(payloads: NDArray, rate: float, duration: float = DURATION) -> NDArray:
    """(N, M, 29) uint8: stop i begins with setpoint i's place and ends in hover; M setpoints at `rate`."""
    reference = decode(payloads)
    steps = round(duration * rate)
    share = np.arange(steps + 1) / steps
    clock_rate = 1.0 - share**2 * (3.0 - 2.0 * share)
    slowing = -6.0 * share * (1.0 - share) / duration
    elapsed = duration * rate * (share - share**3 + share**4 / 2.0)  # in setpoints; the integral of clock_rate
    place = np.minimum(np.arange(len(payloads))[:, None] + elapsed, len(payloads) - 1.0)
    row = np.minimum(place.astype(int), max(len(payloads) - 2, 0))
    between = (place - row)[..., None]

    def at(values: NDArray) -> NDArray:
        after = values[np.minimum(row + 1, len(values) - 1)]
        return values[row] + between * (after - values[row])

    velocity = at(reference.velocity)
    acceleration = clock_rate[:, None] ** 2 * at(reference.acceleration) + slowing[:, None] * velocity
    force = acceleration + _GRAVITY
    axis = force / np.linalg.norm(force, axis=-1, keepdims=True)
    shape = (len(payloads), steps + 1)
    attitude = hopf_quaternion(axis.reshape(-1, 3), at(_hopf_yaw(reference)[:, None]).reshape(-1))
    body_rate = _turn_rates(attitude.reshape(*shape, 4), rate)
    body_rate[:, -1] = 0.0  # the vehicle may be left with the last setpoint
    return encode(
        FullStateSetpoints(
            position=at(reference.position).reshape(-1, 3),
            velocity=(clock_rate[:, None] * velocity).reshape(-1, 3),
            acceleration=acceleration.reshape(-1, 3),
            quaternion=command_quaternion(attitude),
            body_rate=body_rate.reshape(-1, 3),
        )
    ).reshape(*shape, -1)


def _hopf_yaw(reference: FullStateSetpoints) -> NDArray:
    """(N,) rad, not wrapped: yaw of the attitudes that the controller makes of the setpoints, less their tilt."""
    made = controller_attitude(reference.acceleration + _GRAVITY, reference.quaternion)
    quaternion = Rotation.from_matrix(made).as_quat()
    return np.unwrap(2.0 * np.arctan2(quaternion[:, 2], quaternion[:, 3]))


def _turn_rates(quaternion: NDArray, rate: float) -> NDArray:
    """(..., M, 3) rad/s in body axes: the turn from the attitude before to the one after, over the time between."""
    before = np.concatenate([quaternion[..., :1, :], quaternion[..., :-1, :]], axis=-2)
    after = np.concatenate([quaternion[..., 1:, :], quaternion[..., -1:, :]], axis=-2)
    periods = np.full(quaternion.shape[-2], 2.0)
    periods[[0, -1]] = 1.0
    v0, w0, v1, w1 = before[..., :3], before[..., 3:], after[..., :3], after[..., 3:]
    vector = w0 * v1 - w1 * v0 - np.cross(v0, v1)
    scalar = w0 * w1 + np.sum(v0 * v1, axis=-1, keepdims=True)
    sine = np.linalg.norm(vector, axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, np.abs(scalar)) * np.sign(np.where(scalar == 0.0, 1.0, scalar))
    return vector / np.maximum(sine, 1e-12) * angle * rate / periods[:, None]
