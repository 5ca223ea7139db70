"""Stops along the path, encoded before take-off for every moment of the flight.

From the setpoint that is due, the clock of the trajectory runs slower and slower until it stands: the vehicle brakes
on the path itself, where it was certified to be, and ends level at rest. With r the rate of that clock,

    v = r v₀,   a = r² a₀ + ṙ v₀,   attitude from a + g and heading,   body rates from the turn between attitudes.

r falls as a quintic smoothstep, so the braking deceleration is at most 1.875 v₀ / duration, and begins from nothing. A
stop that begins at once, or is shorter, turns the vehicle so fast that link loss within it ends outside the walls.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.setpoints.encoding import (
    RATE_LEAD,
    THRUST_LEAD,
    command_quaternion,
    controller_attitude,
    encode_motion,
)
from cfplan.flight.setpoints.packets import PAYLOAD_SIZE, FullStateSetpoints
from cfplan.flight.setpoints.rate_trade import FIRMWARE_GAINS, AttitudeGains, ahead
from cfplan.safety.space import Space
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.rotations import about_z, norms, quaternions_of, yaw_of

DURATION = 1.2  # s, from full speed to rest: 3.1 m/s² from 2 m/s on top of the turn's own
_GRAVITY = np.array([0.0, 0.0, GRAVITY])
_CHUNK = 200  # stops at a time, so that all fields of them stay in a processor's cache


def encode_stops(
    motion: FullStateSetpoints,
    rate: float,
    duration: float = DURATION,
    rows: NDArray | None = None,
    gains: AttitudeGains = FIRMWARE_GAINS,
    space: Space | None = None,
) -> NDArray:
    """Return (N, M, 29) uint8: stop i begins with the place of the motion's row i and ends in hover; M at `rate`, Hz.

    `motion` is what the setpoints of the flight make the vehicle fly, N rows at `rate`. Where `rows` are given, stops
    from these alone. `gains` and `space` as for the setpoints of the flight.
    """
    begin = np.arange(len(motion.position)) if rows is None else rows
    out = np.empty((len(begin), round(duration * rate) + 1, PAYLOAD_SIZE), dtype=np.uint8)
    for some in chunks(len(begin)):
        stops, coming = stop_motion(motion, begin[some], rate, duration)
        out[some] = encode_motion(stops, coming, gains, space=space).reshape(-1, *out.shape[1:])
    return out


def chunks(count: int) -> Iterator[slice]:
    """Return slices of so many stops as are made at a time."""
    return (slice(first, min(first + _CHUNK, count)) for first in range(0, count, _CHUNK))


def stop_motion(
    motion: FullStateSetpoints,
    begin: NDArray,
    rate: float,
    duration: float = DURATION,
    *,
    rate_lead: float = RATE_LEAD,
    thrust_lead: float = THRUST_LEAD,
) -> tuple[FullStateSetpoints, NDArray]:
    """Return the stops from rows `begin`, (K,), of a motion, one after another, K · M rows, as motion to fly.

    With it comes the acceleration of each row BRAKE_LEAD later, (K · M, 3). Body rates and the length of the thrust
    vector are ahead by the leads, s, as in the setpoints of a plan.
    """
    steps, count = round(duration * rate), len(motion.position)
    share = np.arange(steps + 1) / steps
    clock_rate = 1.0 - share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    slowing = -30.0 * share**2 * (1.0 - share) ** 2 / duration
    elapsed = share - 2.5 * share**4 + 3.0 * share**5 - share**6  # the integral of clock_rate
    elapsed *= duration * rate  # in setpoints
    place = np.minimum(begin[:, None] + elapsed, count - 1.0)
    row = np.minimum(place.astype(int), max(count - 2, 0))
    between = (place - row)[..., None]

    def at(values: NDArray) -> NDArray:
        after = values[np.minimum(row + 1, len(values) - 1)]
        return values[row] + between * (after - values[row])

    velocity = at(motion.velocity)
    acceleration = clock_rate[:, None] ** 2 * at(motion.acceleration) + slowing[:, None] * velocity
    turn = at(np.unwrap(yaw_of(command_quaternion(motion.quaternion).T))[:, None])[..., 0].reshape(-1)
    made = controller_attitude(acceleration.reshape(-1, 3) + _GRAVITY, about_z(turn))
    attitude = quaternions_of(made)
    body_rate = _ahead(_turn_rates(attitude.reshape(len(begin), steps + 1, 4), rate), rate_lead * rate)
    body_rate[:, -1] = 0.0  # the vehicle may be left with the last setpoint
    force = acceleration + _GRAVITY
    thrust = norms(force)[..., None]
    sent = _ahead(thrust, thrust_lead * rate) / thrust * force - _GRAVITY
    stops = FullStateSetpoints(
        position=at(motion.position).reshape(-1, 3),
        velocity=(clock_rate[:, None] * velocity).reshape(-1, 3),
        acceleration=sent.reshape(-1, 3),
        quaternion=attitude,
        body_rate=body_rate.reshape(-1, 3),
    )
    return stops, ahead(acceleration, rate).reshape(-1, 3)


def _ahead(values: NDArray, by: float) -> NDArray:
    """Return (..., M, K): the rows `by` rows later on; the last holds."""
    place = np.minimum(np.arange(values.shape[-2]) + by, values.shape[-2] - 1.0)
    row = place.astype(int)
    after = np.minimum(row + 1, values.shape[-2] - 1)
    return values[..., row, :] + (place - row)[:, None] * (values[..., after, :] - values[..., row, :])


def _turn_rates(quaternion: NDArray, rate: float) -> NDArray:
    """Return (..., M, 3) rad/s in body axes: the turn from the attitude before to the one after."""
    before = np.concatenate([quaternion[..., :1, :], quaternion[..., :-1, :]], axis=-2)
    after = np.concatenate([quaternion[..., 1:, :], quaternion[..., -1:, :]], axis=-2)
    periods = np.full(quaternion.shape[-2], 2.0)
    periods[[0, -1]] = 1.0
    v0, w0, v1, w1 = before[..., :3], before[..., 3:], after[..., :3], after[..., 3:]
    vector = w0 * v1 - w1 * v0 - np.cross(v0, v1)
    scalar = w0 * w1 + np.sum(v0 * v1, axis=-1, keepdims=True)
    sine = norms(vector)[..., None]
    angle = 2.0 * np.arctan2(sine, np.abs(scalar)) * np.sign(np.where(scalar == 0.0, 1.0, scalar))
    return vector / np.maximum(sine, 1e-12) * angle * rate / periods[:, None]
