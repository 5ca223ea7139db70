"""Byte check: certifies that the bytes of setpoints make the vehicle fly the plan, within the limits.

It compares the decoded bytes with the trajectory, which is evaluated again, and uses no number that encoding computed.
Encoding rotates attitudes by quaternions, this check by matrices; they share only the controller's attitude, the push
away from obstacles, and the rates that compensate for the air's moment.

For the names in formulas see rate_trade.py. With R the matrix of the attitude to fly, the wanted attitude is
W = R exp(-τ ω) exp(φ); the controller must make it from the bytes, with the thrust of the motion along R's axis z.
"""

import math
from dataclasses import replace

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.errors import NotCertifiedError
from cfplan.flight.setpoints.encoding import (
    LEAD,
    LEADING_WEIGHT,
    RATE_LEAD,
    THRUST_LEAD,
    EncodedFlight,
    attitude_rows,
    sent_rows,
)
from cfplan.flight.setpoints.level_out import (
    BRAKE_LEAD,
    SPEED_GAINED,
    SPEED_LEFT,
    WALL_LEAD,
    Faces,
    LevelOut,
    faces_of,
    push_off_obstacles,
)
from cfplan.flight.setpoints.packets import (
    ATTITUDE_QUANTUM,
    FULL_STATE_TYPE,
    HALF_QUANTUM,
    PAYLOAD_SIZE,
    FullStateSetpoints,
    arrays_of,
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
from cfplan.machine_code import njit
from cfplan.safety.limits import PlanLimits
from cfplan.safety.quantities import AT_LEAST, AT_MOST, INSTANT
from cfplan.safety.space import Space
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.joint import JoinedTrajectory
from cfplan.vehicle.measures import extremes_at_instants, measures_at_instants
from cfplan.vehicle.rotations import (
    Matrix,
    Vector,
    dot,
    heading_of,
    matrix_product,
    matrix_rows,
    norms,
    transpose,
    turn_rows,
)
from cfplan.vehicle.trajectory import Trajectory

_ROUNDING = 1e-9
_ROUNDED = HALF_QUANTUM + _ROUNDING
_LEAN_MAX = math.radians(75.0)  # the controller's heading is not defined at a tilt of 90°
_GRAVITY = np.array([0.0, 0.0, GRAVITY])
_TINY = 1e-12  # replaces lengths of 0

# Names of the errors of setpoints, in the order of checking, with their tolerances.
_ERRORS = (
    ("position in the packet is not that of the trajectory, off by", _ROUNDED),
    ("velocity in the packet is not that of the trajectory, off by", _ROUNDED),
    ("body_rate in the packet is not that of the trajectory, off by", _ROUNDED),
    ("acceleration in the packet is not that of the trajectory, off by", _ROUNDED),
    ("quaternion in the packet is not that of the trajectory, off by rad", ATTITUDE_QUANTUM),
    ("the thrust that is sent leans too far, by rad", _LEAN_MAX),
    ("the controller would not make the planned torque, off by rad", ATTITUDE_QUANTUM),
)


def check_bytes(encoded: EncodedFlight, trajectory: Trajectory | JoinedTrajectory, limits: PlanLimits) -> None:
    """Certify the bytes of a flight against its trajectory.

    What the controller reads from the payloads lies within half a quantum of the trajectory at its time, the
    attitude within its resolution; speed, acceleration, body rate, tilt and specific thrust of that motion are within
    the limits and their quanta, and the sent values within bounds of their own; the last setpoint is a hover at the
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
    """Certify setpoints like check_bytes(), without requiring that they reach the end of the trajectory.

    Returns the resulting motion. Raises NotCertifiedError with the setpoint at fault.
    """
    times = encoded.times + LEAD
    planned = trajectory.at(times)
    thrust = trajectory.at(times + THRUST_LEAD).specific_thrust
    motion = FullStateSetpoints(
        position=planned.position,
        velocity=planned.velocity,
        acceleration=thrust[:, None] * planned.thrust_axis - _GRAVITY,
        quaternion=planned.quaternion,
        body_rate=_lead_rates(trajectory, times),
    )
    ahead = trajectory.at(times + BRAKE_LEAD).acceleration
    flown = check_motion(np.asarray(encoded.payloads), motion, ahead, encoded.gains, space=encoded.space)
    # The sent acceleration also compensates for drag, so the planned one is checked, with the packet's error.
    _check_limits(flown, planned.acceleration + flown.acceleration - motion.acceleration, limits)
    return flown


def _lead_rates(trajectory: Trajectory | JoinedTrajectory, times: NDArray) -> NDArray:
    """Return the body rates that are sent at times (N,), s, (N, 3) rad/s: with what makes up for the motors' lag.

    From the end on they are 0, as the vehicle may be left with any setpoint there.
    """
    rates = trajectory.at(np.concatenate([times + RATE_LEAD, times - RATE_LEAD])).body_rate
    mean = LEADING_WEIGHT * rates[: len(times)] + (1.0 - LEADING_WEIGHT) * rates[len(times) :]
    mean[times >= trajectory.duration] = 0.0
    return mean


def check_motion(
    payloads: NDArray,
    motion: FullStateSetpoints,
    acceleration_ahead: NDArray,
    gains: AttitudeGains,
    space: Space | None = None,
) -> FullStateSetpoints:
    """Check that payloads, (N, 29) uint8, make the vehicle fly this motion; return the motion that they make.

    The motion returned has the position and velocity of the bytes, the thrust along the attitude at which the
    controller's torque is that of the motion's rates, and the rates that the bytes ask for at the motion's attitude,
    which it keeps. `acceleration_ahead` is that of encode_motion(). Raises NotCertifiedError with the setpoint at
    fault.
    """
    others = np.flatnonzero(payloads[:, 0] != FULL_STATE_TYPE)
    if len(others):
        raise _refused("the payload is no full state", payloads[others[0], 0], int(others[0]))
    sent, asked = decode(payloads), held_against_air(motion, gains)
    harmless = harmless_rates(asked, acceleration_ahead, gains, space)
    errors, acceleration, rate = _compared(arrays_of(sent), arrays_of(asked), harmless, gains.full_rate)
    for (what, most), error in zip(_ERRORS, errors, strict=True):
        if not error.max() <= most:  # also if NaN
            row = int((~(error <= most)).argmax())
            raise _refused(what, float(error[row]), row)
    made = replace(sent, acceleration=acceleration, quaternion=asked.quaternion, body_rate=rate)
    return held_against_air(made, gains, -1.0)


@njit(error_model="numpy")
def _compared(
    sent: tuple[NDArray, ...], asked: tuple[NDArray, ...], harmless: NDArray, full_rate: float
) -> tuple[NDArray, NDArray, NDArray]:
    """Return the errors of setpoints, (len(_ERRORS), N), and the motion that they make.

    `sent` are the fields of setpoints as decoded, `asked` those of the motion with the rates to ask for, `harmless` the
    roll and pitch rates to send, (N, 2) rad/s. Of the motion made, returns acceleration and body rate, (N, 3) each.
    """
    position, velocity, acceleration, quaternion, body_rate = sent
    errors, accelerations, rates = np.empty((7, len(position))), np.empty_like(acceleration), body_rate.copy()
    for n in range(len(position)):
        attitude = matrix_rows(asked[3][n], 2.0)
        x, y, z = asked[4][n, 0], asked[4][n, 1], asked[4][n, 2]
        back = _turn_back(x, y)
        turn = matrix_product(back, _turn_for(x - body_rate[n, 0], y - body_rate[n, 1], full_rate))
        wanted, believed = matrix_product(attitude, turn), transpose(matrix_product(attitude, back))

        cosine = turn[2][2]  # of the angle between thrust as flown and as sent
        force = acceleration[n, 0], acceleration[n, 1], acceleration[n, 2] + GRAVITY
        flown = asked[2][n, 0], asked[2][n, 1], asked[2][n, 2] + GRAVITY
        thrust, length = math.sqrt(dot(flown, flown)) / cosine, math.sqrt(dot(force, force))
        lean = math.acos(force[2] / length)
        made = attitude_rows(force, heading_of(quaternion[n]))
        off_z = thrust * wanted[0][2], thrust * wanted[1][2], thrust * wanted[2][2]
        errors[0, n] = _distance(_row(position, n), _row(asked[0], n))
        errors[1, n] = _distance(_row(velocity, n), _row(asked[1], n))
        errors[2, n] = _distance(_row(body_rate, n), (harmless[n, 0], harmless[n, 1], z))
        errors[3, n] = _distance(force, off_z)
        errors[4, n] = _angle(matrix_rows(quaternion[n], 2.0), sent_rows(wanted))
        errors[5, n] = lean
        # The controller makes its attitude of thrust and yaw; an error of the quaternion turns yaw 1/cos(lean) as far.
        errors[6, n] = _angle(made, wanted) * math.cos(lean)

        # The rates that the setpoint asks for at the attitude that the controller believes in the motion.
        rates[n, 0] -= full_rate * dot(believed[1], force) / length
        rates[n, 1] += full_rate * dot(believed[0], force) / length
        x, y, z = transpose(wanted)
        along = dot(x, force) * cosine, dot(y, force) * cosine, dot(z, force) * cosine
        accelerations[n, 0], accelerations[n, 1] = dot(attitude[0], along), dot(attitude[1], along)
        accelerations[n, 2] = dot(attitude[2], along) - GRAVITY
    return errors, accelerations, rates


def harmless_rates(
    motion: FullStateSetpoints,
    acceleration_ahead: NDArray,
    gains: AttitudeGains = FIRMWARE_GAINS,
    space: Space | None = None,
) -> NDArray:
    """Return the roll and pitch rates to send, (N, 2) rad/s: those that help, and what must not be traded.

    `motion` has the rates to ask for, see held_against_air().
    """
    ahead = np.array(acceleration_ahead, dtype=float, order="C")
    return _harmless(arrays_of(motion), ahead, faces_of(space), gains.level_out, gains.full_rate)


@njit(error_model="numpy")
def _harmless(
    motion: tuple[NDArray, ...], ahead: NDArray, faces: Faces, level_out: LevelOut, full_rate: float
) -> NDArray:
    """Return the result of harmless_rates()."""
    position, velocity, _, quaternion, body_rate = motion
    out = np.empty((len(position), 2))
    for n in range(len(position)):
        pull_x, pull_y = _pull(position[n], velocity[n], ahead[n], faces, level_out)
        x, y = heading_of(quaternion[n])
        size, across = max(math.sqrt(pull_x * pull_x + pull_y * pull_y), _TINY), math.sqrt(x * x + y * y)
        forward, left = (x * pull_x + y * pull_y) / (across * size), (x * pull_y - y * pull_x) / (across * size)
        helpful = min(full_rate * math.sin(math.atan(size / GRAVITY)), level_out.rate_max)
        wx, wy = body_rate[n, 0], body_rate[n, 1]
        excess_x, excess_y = wx + helpful * left, wy - helpful * forward

        size = max(math.sqrt(excess_x * excess_x + excess_y * excess_y), _TINY)
        up = matrix_product(matrix_rows(quaternion[n], 2.0), _turn_back(wx, wy))[2]  # in the axes believed
        across = (up[0] * excess_y - up[1] * excess_x) / size
        traded = min(size, TRADED_RATE_MAX)
        sine = traded / full_rate  # of the turn that replaces it
        if not across * sine + up[2] * math.sqrt(1.0 - sine * sine) >= LEAST_LIFT:  # else it does not lean too far
            reached = max(math.sqrt(across * across + up[2] * up[2]), LEAST_LIFT)
            widest = min(max(math.atan2(across, up[2]) + math.acos(LEAST_LIFT / reached), 0.0), 0.5 * math.pi)
            traded = min(traded, full_rate * math.sin(widest))
        traded /= size
        out[n, 0], out[n, 1] = wx - traded * excess_x, wy - traded * excess_y
    return out


@register_jitable
def _pull(place: NDArray, velocity: NDArray, ahead: NDArray, faces: Faces, level_out: LevelOut) -> tuple[float, float]:
    """Return the horizontal acceleration, m/s², that level-out should give after a setpoint."""
    x, y = place[0] + WALL_LEAD * velocity[0], place[1] + WALL_LEAD * velocity[1]
    off_x, off_y = push_off_obstacles(x, y, place[2], faces.prisms, level_out)
    reach, stiffness, most = level_out.wall_reach, level_out.wall_stiffness, level_out.wall_pull_max
    off_x += min(stiffness * max(reach - (x - faces.low[0]), 0.0), most)
    off_x -= min(stiffness * max(reach - (faces.high[0] - x), 0.0), most)
    off_y += min(stiffness * max(reach - (y - faces.low[1]), 0.0), most)
    off_y -= min(stiffness * max(reach - (faces.high[1] - y), 0.0), most)
    left_x = SPEED_LEFT * velocity[0] + SPEED_GAINED * ahead[0]
    left_y = SPEED_LEFT * velocity[1] + SPEED_GAINED * ahead[1]
    return off_x - level_out.braking * left_x, off_y - level_out.braking * left_y


@register_jitable
def _turn_back(x: float, y: float) -> Matrix:
    """Return the matrix of the turn exp(-τ ω) by roll and pitch rates, rad/s."""
    angle = max(ATTITUDE_AGE * math.sqrt(x * x + y * y), _TINY)
    half = math.sin(0.5 * angle) / angle
    return turn_rows(-ATTITUDE_AGE * x, -ATTITUDE_AGE * y, math.sin(angle) / angle, 2.0 * half * half)


@register_jitable
def _turn_for(x: float, y: float, full_rate: float) -> Matrix:
    """Return the matrix of the turn exp(φ) that replaces roll and pitch rates, rad/s."""
    size = math.sqrt(x * x + y * y)
    scale = 1.0 / max(size, full_rate)  # the turn has the sine |Δ| kw / 2kR, 1 at most
    cosine = math.sqrt(1.0 - min(scale * size, 1.0) ** 2)
    return turn_rows(x, y, scale, scale * scale / (1.0 + cosine))


@register_jitable
def _row(values: NDArray, n: int) -> Vector:
    return values[n, 0], values[n, 1], values[n, 2]


@register_jitable
def _distance(first: Vector, second: Vector) -> float:
    """Return the largest difference of a component; NaN if one is NaN."""
    off_y = np.maximum(abs(first[1] - second[1]), abs(first[2] - second[2]))
    return np.maximum(abs(first[0] - second[0]), off_y)


@register_jitable
def _angle(first: Matrix, second: Matrix) -> float:
    """Return the angle, rad, between rotations: ‖A - B‖² = 8 sin²(angle / 2)."""
    total = 0.0
    for row in range(3):
        a, b = first[row], second[row]
        x, y, z = a[0] - b[0], a[1] - b[1], a[2] - b[2]
        total += x * x + y * y + z * z
    return 2.0 * math.asin(min(math.sqrt(total / 8.0), 1.0))


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
    lean = quantum / thrust  # an error turns the thrust vector by this much
    for quantity in doubtful:
        value, limit = quantity.worst(measured), quantity.allowed(limits)
        rounding = {"rad": lean, "rad/s": quantum + FIRMWARE_GAINS.full_rate * lean}.get(quantity.unit, quantum)
        what = f"{quantity.noun} in the packet breaks its limit, {limit:.4g} {quantity.unit}, with"
        beyond = ~(quantity.excess(value, limit) <= rounding)
        if beyond.any():
            raise _refused(what, float(value[beyond.argmax()]), int(beyond.argmax()))


def _require_hover(flown: FullStateSetpoints, trajectory: Trajectory | JoinedTrajectory) -> None:
    """Check that the last setpoint, which stays in force if nothing follows, is a hover at the end."""
    moves = np.abs(np.stack([flown.acceleration[-1], flown.body_rate[-1]])).max()
    error = np.abs(flown.position[-1] - trajectory.at(np.array([trajectory.duration])).position[0]).max()
    if flown.velocity[-1].any() or not moves <= 4 * HALF_QUANTUM or not error <= _ROUNDED:
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
