"""Byte check: certifies that the bytes of setpoints make the vehicle fly what was planned, and within the limits.

It begins with the decoded bytes and the trajectory, which is evaluated afresh, and uses no number that encoding
computed. Where encoding goes from setpoint to setpoint in compiled code, by quaternions, this goes from formula to
formula over all setpoints, by matrices.

For the names in formulas see rate_trade.py. With R the matrix of the attitude to fly, the wanted attitude is
R exp(-τ ω) exp(φ); the controller must make it from the bytes, with the thrust of the motion along R's axis z.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import NotCertifiedError
from cfplan.flight.setpoints.encoding import (
    LEAD,
    THRUST_LEAD,
    EncodedFlight,
    command_quaternion,
    controller_attitude,
    lead_rates,
)
from cfplan.flight.setpoints.level_out import (
    BRAKE_LEAD,
    SPEED_GAINED,
    SPEED_LEFT,
    WALL_LEAD,
    faces_of,
    pushes_off_obstacles,
)
from cfplan.flight.setpoints.packets import (
    ATTITUDE_QUANTUM,
    FULL_STATE_TYPE,
    HALF_QUANTUM,
    PAYLOAD_SIZE,
    FullStateSetpoints,
    decode,
)
from cfplan.flight.setpoints.rate_trade import (
    ATTITUDE_AGE,
    FIRMWARE_GAINS,
    LEAST_LIFT,
    TRADED_RATE_MAX,
    AttitudeGains,
    held_against_air,
)
from cfplan.safety.limits import PlanLimits
from cfplan.safety.quantities import AT_LEAST, AT_MOST, INSTANT
from cfplan.safety.space import Space
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.joint import JoinedTrajectory
from cfplan.vehicle.measures import extremes_at_instants, measures_at_instants
from cfplan.vehicle.rotations import heading_of, matrix_product, matrix_rows, norms, quaternions_of, turn_rows
from cfplan.vehicle.trajectory import Trajectory

_ROUNDING = 1e-9
_ROUNDED = HALF_QUANTUM + _ROUNDING
_LEAN_MAX = math.radians(75.0)  # the controller's heading is not defined at a tilt of 90°
_GRAVITY = np.array([0.0, 0.0, GRAVITY])
_TINY = 1e-12  # in place of lengths of 0


def check_bytes(encoded: EncodedFlight, trajectory: Trajectory | JoinedTrajectory, limits: PlanLimits) -> None:
    """Certify the bytes of a flight against its trajectory.

    What the controller makes of the decoded payloads lies within half a quantum of the trajectory at its time, the
    attitude within what its bits allow; speed, acceleration, body rate, tilt and specific thrust of that motion are
    within the limits and their quanta, and what is sent within bounds of its own; the last setpoint is a hover at the
    end of the path. Raises NotCertifiedError with the setpoint at fault.
    """
    payloads = np.asarray(encoded.payloads)
    if payloads.ndim != 2 or payloads.shape != (len(encoded.times), PAYLOAD_SIZE) or len(payloads) == 0:
        raise NotCertifiedError(
            f"payloads of shape {payloads.shape} for {len(encoded.times)} times",
            where="the encoding",
            hint="encode the trajectory anew",
        )
    flown = check_setpoints(encoded, trajectory, limits)
    _require_hover(flown, trajectory)


def check_setpoints(
    encoded: EncodedFlight, trajectory: Trajectory | JoinedTrajectory, limits: PlanLimits
) -> FullStateSetpoints:
    """Certify as check_bytes() does each of the setpoints, which need not go on to the end of the trajectory.

    Returns the motion that they make. Raises NotCertifiedError with the setpoint at fault.
    """
    times = encoded.times + LEAD
    planned = trajectory.at(times)
    thrust = trajectory.specific_thrust_at(times + THRUST_LEAD)
    motion = FullStateSetpoints(
        position=planned.position,
        velocity=planned.velocity,
        acceleration=thrust[:, None] * planned.thrust_axis - _GRAVITY,
        quaternion=planned.quaternion,
        body_rate=lead_rates(trajectory, times),
    )
    ahead = trajectory.acceleration_at(times + BRAKE_LEAD)
    flown = check_motion(np.asarray(encoded.payloads), motion, ahead, encoded.gains, space=encoded.space)
    # What is sent makes up for drag besides, so the planned acceleration is judged, with the packet's error.
    _check_limits(flown, planned.acceleration + flown.acceleration - motion.acceleration, limits)
    return flown


def check_motion(
    payloads: NDArray,
    motion: FullStateSetpoints,
    acceleration_ahead: NDArray,
    gains: AttitudeGains,
    first: int = 0,
    *,
    space: Space | None = None,
) -> FullStateSetpoints:
    """Check that payloads, (N, 29) uint8, make the vehicle fly this motion; return the motion that they make.

    The motion returned has the position and velocity of the bytes, the thrust along the attitude at which the
    controller's torque is that of the motion's rates, and the rates that the bytes ask for at the motion's attitude,
    which it keeps. `acceleration_ahead` is that of encode_motion(). Raises NotCertifiedError with the number of the
    setpoint at fault, counted from `first`.
    """
    _require(
        first, "the payload is no full state: its type is off by", np.abs(payloads[:, 0] - float(FULL_STATE_TYPE)), 0.0
    )
    sent, asked = decode(payloads), held_against_air(motion, gains)
    rate, force = asked.body_rate, (sent.acceleration + _GRAVITY).T
    attitude = matrix_rows(asked.quaternion.T, 2.0)
    back = _turn_back(rate)
    turn = matrix_product(back, _turn_for((rate - sent.body_rate)[:, :2], gains))
    wanted = np.array(matrix_product(attitude, turn))  # (3, 3, N), as `believed`
    believed = np.array(matrix_product(attitude, back))
    cosine, length = turn[2][2], np.sqrt(np.einsum("in,in->n", force, force))
    made = np.moveaxis(controller_attitude(force.T, sent.quaternion), 0, 2)
    to_send = command_quaternion(quaternions_of(np.ascontiguousarray(np.moveaxis(wanted, 2, 0))))

    off = "{} in the packet is not that of the trajectory, off by".format
    harmless = np.column_stack([harmless_rates(asked, acceleration_ahead, gains, space), rate[:, 2]])
    thrust = norms(asked.acceleration + _GRAVITY) / cosine
    lean = np.arccos(force[2] / length)
    # The controller makes its attitude of thrust and yaw, and an error of the quaternion turns yaw 1/cos(lean) as far.
    misses = _angle(np.sqrt(np.einsum("ijn,ijn->n", made - wanted, made - wanted) / 8.0)) * np.cos(lean)
    _require(first, off("position"), _error(sent.position, asked.position), _ROUNDED)
    _require(first, off("velocity"), _error(sent.velocity, asked.velocity), _ROUNDED)
    _require(first, off("body_rate"), _error(sent.body_rate, harmless), _ROUNDED)
    _require(first, off("acceleration"), _error(force.T, (thrust * wanted[:, 2]).T), _ROUNDED)
    _require(first, off("quaternion") + " rad", _angle_between(sent.quaternion, to_send), ATTITUDE_QUANTUM)
    _require(first, "the thrust that is sent leans too far, by rad", lean, _LEAN_MAX)
    _require(first, "the controller would not make the planned torque, off by rad", misses, ATTITUDE_QUANTUM)

    flown = np.einsum("ijn,jn->ni", np.array(attitude), np.einsum("ijn,in->jn", wanted, force) * cosine)
    x, y, _ = gains.full_rate * np.einsum("ijn,in->jn", believed, force / length)
    made_rate = np.column_stack([sent.body_rate[:, 0] - y, sent.body_rate[:, 1] + x, sent.body_rate[:, 2]])
    asked = replace(sent, acceleration=flown - _GRAVITY, quaternion=asked.quaternion, body_rate=made_rate)
    return held_against_air(asked, gains, -1.0)


def harmless_rates(
    motion: FullStateSetpoints,
    acceleration_ahead: NDArray,
    gains: AttitudeGains = FIRMWARE_GAINS,
    space: Space | None = None,
) -> NDArray:
    """Return the roll and pitch rates to send, (N, 2) rad/s: those that help, and what must not be traded.

    `motion` has the rates to ask for, see held_against_air().
    """
    level_out, velocity = gains.level_out, motion.velocity[:, :2]
    soon = motion.position + WALL_LEAD * np.column_stack([velocity, np.zeros(len(velocity))])
    pull = pushes_off_obstacles(soon, faces_of(space).prisms, level_out)
    for distance, sign in () if space is None else ((soon - space.low, 1.0), (space.high - soon, -1.0)):
        nearer = np.maximum(level_out.wall_reach - distance[:, :2], 0.0)
        pull += sign * np.minimum(level_out.wall_stiffness * nearer, level_out.wall_pull_max)
    pull -= level_out.braking * (SPEED_LEFT * velocity + SPEED_GAINED * acceleration_ahead[:, :2])

    (x, y), size = heading_of(motion.quaternion.T), np.maximum(norms(pull), _TINY)
    forward, left = np.array([x * pull[:, 0] + y * pull[:, 1], x * pull[:, 1] - y * pull[:, 0]]) / np.hypot(x, y) / size
    helpful = np.minimum(gains.full_rate * np.sin(np.arctan(size / GRAVITY)), level_out.rate_max)
    excess = motion.body_rate[:, :2] - (helpful * np.array([-left, forward])).T
    size = np.maximum(norms(excess), _TINY)

    up = matrix_product(matrix_rows(motion.quaternion.T, 2.0), _turn_back(motion.body_rate))[2]  # in axes believed
    across = (up[0] * excess[:, 1] - up[1] * excess[:, 0]) / size
    reached = np.maximum(np.hypot(across, up[2]), LEAST_LIFT)
    widest = np.clip(np.arctan2(across, up[2]) + np.arccos(LEAST_LIFT / reached), 0.0, math.pi / 2)
    traded = np.minimum(np.minimum(size, TRADED_RATE_MAX), gains.full_rate * np.sin(widest))
    return np.asarray(motion.body_rate[:, :2] - excess * (traded / size)[:, None])


def _turn_back(rate: NDArray):
    """Return the matrix, rows of components (N,), of the turn exp(-τ ω), about x and y, by rates (N, 3), rad/s."""
    x, y = -ATTITUDE_AGE * rate[:, :2].T
    angle = np.hypot(x, y) / math.pi
    return turn_rows(x, y, np.sinc(angle), 0.5 * np.sinc(0.5 * angle) ** 2)


def _turn_for(rate: NDArray, gains: AttitudeGains):
    """Return the matrix likewise of the turn exp(φ) that replaces rates, (N, 2) rad/s."""
    size = norms(rate)
    scale = 1.0 / np.maximum(size, gains.full_rate)  # the turn has the sine |Δ| kw / 2kR, 1 at most
    cosine = np.sqrt(1.0 - np.minimum(scale * size, 1.0) ** 2)
    return turn_rows(rate[:, 0], rate[:, 1], scale, scale**2 / (1.0 + cosine))


def _error(sent: NDArray, planned: NDArray) -> NDArray:
    """Return the largest error of the components, (N,); NaN where one is NaN."""
    return np.asarray(np.abs(sent - planned).max(axis=1))


def _angle(sine_of_half: NDArray) -> NDArray:
    return np.asarray(2.0 * np.arcsin(np.minimum(sine_of_half, 1.0)))


def _angle_between(first: NDArray, second: NDArray) -> NDArray:
    """Return the angles, (N,) rad, between unit quaternions, (N, 4)."""
    return np.asarray(2.0 * np.arccos(np.minimum(np.abs(np.einsum("ni,ni->n", first, second)), 1.0)))


def _require(first: int, what: str, value: NDArray, most: float) -> None:
    """Raise NotCertifiedError at the first setpoint whose value, (N,), is more than `most`, or NaN."""
    if (wrong := ~(value <= most)).any():
        raise _refused(what, float(value[wrong.argmax()]), first + int(wrong.argmax()))


def _check_limits(flown: FullStateSetpoints, acceleration: NDArray, limits: PlanLimits) -> None:
    """Check that the motion of setpoints keeps the limits; `acceleration`, (N, 3), is that of the motion alone.

    Raises NotCertifiedError with the number of the setpoint at fault.
    """
    force = flown.acceleration + _GRAVITY
    known = [np.array(each, dtype=float, order="C") for each in (flown.velocity, acceleration, flown.body_rate, force)]
    highest, lowest = extremes_at_instants(*known)
    extremes = {AT_MOST: highest, AT_LEAST: lowest}
    doubtful = [q for q in INSTANT if not q.excess(q.worst(extremes[q.side]), q.allowed(limits)) <= 0.0]
    if not doubtful:
        return
    quantum, thrust, measured = np.sqrt(3) * HALF_QUANTUM + _ROUNDING, norms(force), measures_at_instants(*known)
    lean = quantum / thrust  # an error turns the thrust vector so far
    for quantity in doubtful:
        value, limit = quantity.worst(measured), quantity.allowed(limits)
        rounding = {"rad": lean, "rad/s": quantum + FIRMWARE_GAINS.full_rate * lean}.get(quantity.unit, quantum)
        what = f"{quantity.noun} in the packet breaks its limit, {limit:.4g} {quantity.unit}, with"
        beyond = ~(quantity.excess(value, limit) <= rounding)
        if beyond.any():
            raise _refused(what, float(value[beyond.argmax()]), int(beyond.argmax()))


def _require_hover(flown: FullStateSetpoints, trajectory: Trajectory | JoinedTrajectory) -> None:
    """Check that the last setpoint, with which the vehicle is left if nothing more comes, is a hover at the end."""
    moves = np.abs(np.stack([flown.acceleration[-1], flown.body_rate[-1]])).max()
    off = np.abs(flown.position[-1] - trajectory.at(np.array([trajectory.duration])).position[0]).max()
    if flown.velocity[-1].any() or not moves <= 4 * HALF_QUANTUM or not off <= _ROUNDED:
        raise NotCertifiedError(
            "the last setpoint is not a hover at the end of the path",
            where=f"setpoint {len(flown.position) - 1}",
            hint="encode the trajectory with a longer hold",
        )


def _refused(what: str, value: float, setpoint: int) -> NotCertifiedError:
    """Return the error of a setpoint."""
    return NotCertifiedError(
        f"{what} {value:.4g}",
        where=f"setpoint {setpoint}",
        hint="plan more slowly, with --speed 0.9; if the plan keeps its limits there, please report this",
    )
