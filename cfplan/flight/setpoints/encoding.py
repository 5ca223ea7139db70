"""Encoding: a trajectory as the packets that fly it, and the independent check that those bytes say what was planned.

The packet's quaternion: the controller takes from it only the Euler yaw (ZYX) ψ, and builds its attitude from the
thrust vector: z along it, y along z × [cos ψ, sin ψ, 0]. The planned attitude (Hopf) has another ψ at the same heading:
the one with which the controller arrives at just that attitude is ψ = atan2(-y₁, y₂) of the planned body y axis. Sent
is the quaternion with the planned thrust axis and that Euler yaw; at 30° of tilt it is up to 8° of yaw away from the
planned attitude, and the controller, reading it, is not.

Roll and pitch rates are not sent as they are planned: most of them is sent as a turn of that attitude, which makes the
same torque and lets the vehicle level out where setpoints stop (see rate_trade.py).
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.errors import NotCertifiedError
from cfplan.flight.setpoints.packets import FULL_STATE_TYPE, PAYLOAD_SIZE, FullStateSetpoints, decode, encode
from cfplan.flight.setpoints.rate_trade import (
    ATTITUDE_AGE,
    BRAKE_LEAD,
    FIRMWARE_GAINS,
    AttitudeGains,
    harmless_rates,
    held_against_air,
    trade_rates,
)
from cfplan.machine_code import njit
from cfplan.safety.limits import PlanLimits
from cfplan.safety.quantities import AT_LEAST, AT_MOST, INSTANT
from cfplan.safety.space import Space
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.joint import JoinedTrajectory
from cfplan.vehicle.measures import extremes_at_instants, measures_at_instants
from cfplan.vehicle.panels import (
    WIDTH,
    give_out,
    lanes_for,
    pair_in,
    quaternion_in,
    take_in,
    triple_in,
    write_pair,
    write_quaternion_in,
    write_triple,
)
from cfplan.vehicle.rotations import (
    Matrix,
    Vector,
    dot,
    heading_of,
    matrix_product,
    matrix_rows,
    norms,
    quaternion_of,
    transpose,
    transposed_product,
    turn_rows,
)
from cfplan.vehicle.trajectory import FullState, Trajectory
from cfplan.vehicle.trigonometry import sine

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
LEADING_SHARE = 0.8

# s by which the length of the thrust vector is sent ahead of its direction, as motors give it late: for the least
# deviations in the dry run of all paths at motor lags of 0.07, 0.105 and 0.13 s; the lead of rates is for those in the
# stepped lab besides. What is sent is still a thrust of the plan, so no limit is nearer.
THRUST_LEAD = 0.077

HALF_QUANTUM = 0.5e-3  # of position m, velocity m/s, acceleration m/s², body rate rad/s
ATTITUDE_QUANTUM = np.radians(0.25)  # the largest angle by which compressing turns a quaternion
_ROUNDING = 1e-9
_ROUNDED = HALF_QUANTUM + _ROUNDING
_OFF = "{} in the packet is not that of the trajectory, off by"
_NO_TURN = 1e-12  # rad, in place of a smaller turn
_LEAST_LIFT = math.cos(math.radians(75.0))  # the controller's heading is not defined at a tilt of 90°
_BATCH = 4096  # setpoints at a time, so that memory does not grow with the states of a long flight
_GRAVITY = np.array([0.0, 0.0, GRAVITY])


@dataclass(frozen=True, slots=True)
class EncodedFlight:
    """A trajectory as the bytes that are sent, each at its time."""

    times: NDArray  # (N,) s after the start of the stream, when each payload is due
    payloads: NDArray  # (N, 29) uint8
    decoded: FullStateSetpoints  # what the vehicle reads from them
    motion: FullStateSetpoints  # what they make the vehicle fly: planned, without what is sent ahead
    lead: float  # s by which each setpoint is ahead of the trajectory at its time
    rate_lead: float  # s by which the rates are before and ahead of that, of which its body rate is made
    thrust_lead: float  # s by which the length of its thrust vector is ahead of that
    gains: AttitudeGains  # of the vehicle that these packets are for
    space: Space | None  # whose walls level-out leans away from

    @property
    def duration(self) -> float:
        """Return the time from the first payload to the last, s."""
        return float(self.times[-1])


def encode_trajectory(
    trajectory: Trajectory | JoinedTrajectory,
    *,
    rate: float = RATE,
    hold: float = HOLD,
    lead: float = LEAD,
    rate_lead: float = RATE_LEAD,
    thrust_lead: float = THRUST_LEAD,
    gains: AttitudeGains = FIRMWARE_GAINS,
    space: Space | None = None,
    count: int | None = None,
) -> EncodedFlight:
    """Encode a flight: full states at `rate`, Hz, then hover at the end for at least `hold`, s.

    `lead`, s, samples the trajectory that much ahead of the clock. `space` has the walls that a vehicle whose setpoints
    stop is to keep away from. With `count`, so many setpoints are made at most, the first ones. Raises
    NotCertifiedError with the setpoint where a value is not finite or does not fit its 16 bits.
    """
    if not (np.isfinite([trajectory.duration, lead, rate_lead, thrust_lead]).all() and rate > 0 and hold >= 0):
        raise NotCertifiedError(
            f"cannot sample {trajectory.duration} s at {rate} Hz with a hold of {hold} s",
            where="the encoding",
            hint="give finite times, a rate above 0 and a hold of at least 0",
        )
    moving = int(np.ceil(trajectory.duration * rate)) + 1
    whole = moving + int(np.ceil(hold * rate))
    times = np.arange(whole if count is None else min(whole, count)) / rate
    payloads, planned = [], []
    for rows in _batches(len(times)):
        moments = times[rows] + lead
        states = trajectory.at(moments)
        motion = _led(states, trajectory, moments, rate_lead, thrust_lead)
        coming = trajectory.at(moments + BRAKE_LEAD).acceleration
        payloads.append(encode_motion(motion, coming, gains, rows.start, space=space))
        planned.append(_motion_of(states, states.specific_thrust, states.body_rate))
    sent = np.concatenate(payloads)
    return EncodedFlight(times, sent, decode(sent), _joined(planned), lead, rate_lead, thrust_lead, gains, space)


def motion_at(
    trajectory: Trajectory | JoinedTrajectory,
    times: NDArray,
    rate_lead: float = RATE_LEAD,
    thrust_lead: float = THRUST_LEAD,
) -> FullStateSetpoints:
    """Return the motion that setpoints are to make, at times (N,), s: the attitudes and rates to fly.

    The acceleration is that of the thrust, less gravity: it includes the compensation for drag.
    """
    return _led(trajectory.at(times), trajectory, times, rate_lead, thrust_lead)


def _led(
    states: FullState, trajectory: Trajectory | JoinedTrajectory, times: NDArray, rate_lead: float, thrust_lead: float
) -> FullStateSetpoints:
    """Return the same from the states at those times."""
    thrust = trajectory.at(times + thrust_lead).specific_thrust if thrust_lead else states.specific_thrust
    turning = lead_rates(trajectory, times, rate_lead) if rate_lead else states.body_rate
    return _motion_of(states, thrust, turning)


def _motion_of(states: FullState, thrust: NDArray, turning: NDArray) -> FullStateSetpoints:
    """Return the setpoints of states, with these thrusts, (N,) m/s², and body rates, (N, 3) rad/s."""
    acceleration = thrust[:, None] * states.thrust_axis
    acceleration[:, 2] -= GRAVITY
    return FullStateSetpoints(
        position=states.position,
        velocity=states.velocity,
        acceleration=acceleration,
        quaternion=states.quaternion,
        body_rate=turning,
    )


def _joined(parts: Sequence[FullStateSetpoints]) -> FullStateSetpoints:
    """Return setpoints one part behind the other."""
    if len(parts) == 1:
        return parts[0]
    fields = FullStateSetpoints.__slots__
    return FullStateSetpoints(*(np.concatenate([getattr(part, name) for part in parts]) for name in fields))


def lead_rates(trajectory: Trajectory | JoinedTrajectory, times: NDArray, rate_lead: float = RATE_LEAD) -> NDArray:
    """Return the body rates to send at times (N,), s, (N, 3) rad/s: with what makes up for the motors' lag.

    From the end on they are 0, as the vehicle may be left with any setpoint there.
    """
    rates = trajectory.at(np.concatenate([times + rate_lead, times - rate_lead])).body_rate
    return _mean_rates(np.array(rates.T, dtype=float, order="C"), times, trajectory.duration)


@njit
def _mean_rates(rates: NDArray, times: NDArray, duration: float) -> NDArray:
    """Return what lead_rates() does, of the rates ahead and then those before, (3, 2 N)."""
    mean, count = np.zeros((len(times), 3)), len(times)
    for n in range(count):
        if not times[n] >= duration:
            for axis in range(3):
                ahead, before = rates[axis, n], rates[axis, count + n]
                mean[n, axis] = LEADING_SHARE * ahead + (1.0 - LEADING_SHARE) * before
    return mean


def encode_motion(
    motion: FullStateSetpoints,
    acceleration_ahead: NDArray,
    gains: AttitudeGains = FIRMWARE_GAINS,
    first: int = 0,
    *,
    space: Space | None = None,
) -> NDArray:
    """Return the payloads, (N, 29) uint8, that make the vehicle fly a motion and are harmless when they stop.

    `acceleration_ahead`, (N, 3) m/s², is that of the motion BRAKE_LEAD later; `first` is the number of the first
    setpoint, for the error's text. Raises NotCertifiedError where a value is not finite or does not fit.
    """
    sent = trade_rates(motion, acceleration_ahead, gains, space)
    return encode(replace(sent, quaternion=command_quaternion(sent.quaternion)), first)


def _batches(count: int) -> Iterator[slice]:
    return (slice(first, min(first + _BATCH, count)) for first in range(0, count, _BATCH))


def command_quaternion(quaternion: NDArray) -> NDArray:
    """Return (N, 4) x y z w to send so that the controller arrives at the attitudes `quaternion`, (N, 4)."""
    return _commands(np.array(quaternion, dtype=float))


def controller_attitude(thrust: NDArray, quaternion: NDArray) -> NDArray:
    """Return the attitudes (N, 3, 3) that the controller makes of thrust vectors (N, 3) and quaternions (N, 4)."""
    return _attitudes(np.array(thrust, dtype=float), np.array(quaternion, dtype=float))


def check_bytes(encoded: EncodedFlight, trajectory: Trajectory | JoinedTrajectory, limits: PlanLimits) -> None:
    """Certify the bytes against the trajectory, which is evaluated afresh: nothing that encoding computed is used.

    Turned back by what the body rates leave to the attitude, what the controller makes of the decoded payloads lies
    within half a quantum of the trajectory at its time, the attitude within what its bits allow; speed, acceleration,
    body rate, tilt and specific thrust of that motion are within the limits and their quanta, and what is sent within
    bounds of its own; the last setpoint is a hover at the end of the path. Raises NotCertifiedError with the setpoint
    at fault.
    """
    payloads = np.asarray(encoded.payloads)
    if payloads.ndim != 2 or payloads.shape != (len(encoded.times), PAYLOAD_SIZE) or len(payloads) == 0:
        raise NotCertifiedError(
            f"payloads of shape {payloads.shape} for {len(encoded.times)} times",
            where="the encoding",
            hint="encode the trajectory anew",
        )
    flown = check_setpoints(encoded, trajectory, limits)
    _require_hover(flown, trajectory, len(payloads))


def check_setpoints(
    encoded: EncodedFlight, trajectory: Trajectory | JoinedTrajectory, limits: PlanLimits
) -> FullStateSetpoints:
    """Certify as check_bytes() does each of the setpoints, which need not go on to the end of the trajectory.

    Returns the motion that the last of them make. Raises NotCertifiedError with the setpoint at fault.
    """
    payloads = np.asarray(encoded.payloads)
    for rows in _batches(len(payloads)):
        times = encoded.times[rows] + encoded.lead
        planned = trajectory.at(times)
        thrust = trajectory.at(times + encoded.thrust_lead).specific_thrust
        motion = FullStateSetpoints(
            position=planned.position,
            velocity=planned.velocity,
            acceleration=thrust[:, None] * planned.thrust_axis - _GRAVITY,
            quaternion=planned.quaternion,
            body_rate=lead_rates(trajectory, times, encoded.rate_lead),
        )
        coming = trajectory.at(times + BRAKE_LEAD).acceleration
        flown = check_motion(payloads[rows], motion, coming, encoded.gains, rows.start, space=encoded.space)
        # What is sent makes up for drag besides, so the planned acceleration is judged, with the packet's error.
        acceleration = planned.acceleration + flown.acceleration - motion.acceleration
        _check_limits(flown, acceleration, limits, rows.start)
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

    The motion returned is that of the bytes: the thrust along the attitude at which the controller's torque is that of
    the motion's rates, and the rates that the setpoint's attitude and rates ask for at the motion's attitude. Raises
    NotCertifiedError with the number of the setpoint at fault, counted from `first`.
    """
    others = np.flatnonzero(payloads[:, 0] != FULL_STATE_TYPE)
    if len(others):
        raise _refused("the payload is no full state", payloads[others[0], 0], first + int(others[0]))
    decoded = decode(payloads)
    harmless = harmless_rates(motion, acceleration_ahead, gains, space)
    asked = held_against_air(motion, gains)
    position, velocity, acceleration, quaternion, body_rate = (
        np.array(getattr(asked, name), dtype=float, order="C") for name in FullStateSetpoints.__slots__
    )
    compared, flown, attitude, rate = _made(
        decoded.acceleration, decoded.quaternion, decoded.body_rate, acceleration, quaternion, body_rate,
        gains.full_rate,
    )  # fmt: skip
    check, row, value = _first_fault(
        decoded.position, position, decoded.velocity, velocity, decoded.body_rate, harmless, body_rate, compared
    )
    if check >= 0:
        raise _refused(_FAULTS[check], value, first + row)
    made = replace(decoded, acceleration=flown, quaternion=quaternion, body_rate=rate)
    return replace(held_against_air(made, gains, -1.0), quaternion=attitude)


# What _first_fault() checks, in its order; the value at fault follows.
_FAULTS = (
    _OFF.format("position"),
    _OFF.format("velocity"),
    _OFF.format("body_rate"),
    _OFF.format("acceleration"),
    "quaternion in the packet is not that of the trajectory, off by rad",
    "the thrust that is sent leans too far, with a vertical share of",
    "the controller would not make the planned torque, off by rad",
)


@njit(error_model="numpy")
def _first_fault(
    position: NDArray, planned_position: NDArray, velocity: NDArray, planned_velocity: NDArray, rate: NDArray,
    harmless: NDArray, planned_rate: NDArray, compared: NDArray,
) -> tuple[int, int, float]:  # fmt: skip
    """Return the first of the _FAULTS that there is, -1 where there is none, its first setpoint and the value there.

    Position, velocity and rate are as decoded, (N, 3), and as planned; roll and pitch rates, (N, 2), as they are to be
    sent. `compared` is that of _made().
    """
    for n in range(len(position)):
        off = _largest_error(position, planned_position, n)
        if not off <= _ROUNDED:
            return 0, n, off
    for n in range(len(position)):
        off = _largest_error(velocity, planned_velocity, n)
        if not off <= _ROUNDED:
            return 1, n, off
    for n in range(len(position)):
        off = _larger(abs(rate[n, 0] - harmless[n, 0]), abs(rate[n, 1] - harmless[n, 1]))
        off = _larger(off, abs(rate[n, 2] - planned_rate[n, 2]))
        if not off <= _ROUNDED:
            return 2, n, off
    for n in range(len(position)):
        if not compared[n, 0] <= _ROUNDED:
            return 3, n, compared[n, 0]
    for n in range(len(position)):
        turned = 2.0 * math.asin(1.0 if compared[n, 1] > 1.0 else compared[n, 1])
        if not turned <= ATTITUDE_QUANTUM:
            return 4, n, turned
    for n in range(len(position)):
        if not compared[n, 3] >= _LEAST_LIFT:
            return 5, n, compared[n, 3]
    # The controller makes its attitude of thrust and yaw, and an error of the quaternion turns yaw 1/cos(tilt) as far.
    for n in range(len(position)):
        off = 2.0 * math.asin(1.0 if compared[n, 2] > 1.0 else compared[n, 2]) * compared[n, 3]
        if not off <= ATTITUDE_QUANTUM:
            return 6, n, off
    return -1, 0, 0.0


@register_jitable(forceinline=True)
def _largest_error(sent: NDArray, planned: NDArray, n: int) -> float:
    """Return the largest difference of a setpoint's components; NaN where one is."""
    x, y, z = abs(sent[n, 0] - planned[n, 0]), abs(sent[n, 1] - planned[n, 1]), abs(sent[n, 2] - planned[n, 2])
    return _larger(_larger(x, y), z)


@register_jitable(forceinline=True)
def _larger(first: float, second: float) -> float:
    """Return the larger number; what is none before all others."""
    return first if not first <= second else second


def _check_limits(flown: FullStateSetpoints, acceleration: NDArray, limits: PlanLimits, first: int) -> None:
    """Check that the motion of setpoints keeps the limits; `acceleration`, (N, 3), is that of the motion alone.

    Raises NotCertifiedError with the number of the setpoint at fault, counted from `first`.
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
        beyond = ~(quantity.excess(value, limit) <= rounding)
        if beyond.any():
            row = int(beyond.argmax())
            what = f"{quantity.noun} in the packet breaks its limit, {limit:.4g} {quantity.unit}, with"
            raise _refused(what, float(value[row]), first + row)


def _require_hover(flown: FullStateSetpoints, trajectory: Trajectory | JoinedTrajectory, count: int) -> None:
    """Check that the last of the setpoints, with which the vehicle is left if nothing more comes, is a hover.

    `flown` is the motion that they make the vehicle fly; position and velocity are as decoded.
    """
    moves = np.abs(np.stack([flown.acceleration[-1], flown.body_rate[-1]])).max()
    off = np.abs(flown.position[-1] - trajectory.at(np.array([trajectory.duration])).position[0]).max()
    if flown.velocity[-1].any() or not moves <= 4 * HALF_QUANTUM or not off <= HALF_QUANTUM + _ROUNDING:
        raise NotCertifiedError(
            "the last setpoint is not a hover at the end of the path",
            where=f"setpoint {count - 1}",
            hint="encode the trajectory with a longer hold",
        )


def _refused(what: str, value: float, setpoint: int) -> NotCertifiedError:
    """Return the error of a setpoint."""
    return NotCertifiedError(
        f"{what} {value:.4g}",
        where=f"setpoint {setpoint}",
        hint="plan more slowly, with --speed 0.9; if the plan keeps its limits there, please report this",
    )


# Rows of the panels of _made: what comes in, and what goes out.
_SENT_FORCE, _SENT_ATTITUDE, _SENT_RATE, _FORCE, _ATTITUDE, _RATE = 0, 3, 7, 9, 12, 16
_THRUST_OFF, _FLOWN, _MADE_ATTITUDE, _MADE_RATE, _ROWS = 18, 22, 25, 29, 31


@njit(error_model="numpy")
def _made(
    acceleration: NDArray, quaternion: NDArray, body_rate: NDArray, planned_acceleration: NDArray,
    planned_quaternion: NDArray, planned_rate: NDArray, full_rate: float,
) -> tuple[NDArray, NDArray, NDArray, NDArray]:  # fmt: skip
    """Hold setpoints as decoded against the motion that they are to make, N of each.

    Returned are, (N, 4), by how much the thrust vectors are off, m/s² in their worst component, the sines of half the
    angles by which the quaternions are, and the controller's attitudes turned back by what stands for rates, and the
    vertical share of the thrust; and the motion made: accelerations (N, 3), attitudes (N, 4) and body rates (N, 3).
    """
    count = len(acceleration)
    off, flown, attitude, rate = np.empty((count, 4)), np.empty((count, 3)), np.empty((count, 4)), body_rate.copy()
    panel = np.empty(_ROWS * WIDTH)
    for begin in range(0, count, WIDTH):
        lanes = lanes_for(count - begin)
        take_in(panel, _SENT_FORCE, acceleration, begin, lanes)
        take_in(panel, _SENT_ATTITUDE, quaternion, begin, lanes)
        take_in(panel, _SENT_RATE, body_rate[:, :2], begin, lanes)
        take_in(panel, _FORCE, planned_acceleration, begin, lanes)
        take_in(panel, _ATTITUDE, planned_quaternion, begin, lanes)
        take_in(panel, _RATE, planned_rate[:, :2], begin, lanes)
        _hold_all_against(panel, lanes, full_rate)
        give_out(off, begin, panel, _THRUST_OFF)
        give_out(flown, begin, panel, _FLOWN)
        give_out(attitude, begin, panel, _MADE_ATTITUDE)
        give_out(rate[:, :2], begin, panel, _MADE_RATE)
    return off, flown, attitude, rate


@register_jitable
def _hold_all_against(panel: NDArray, lanes: int, full_rate: float) -> None:
    lanes = min(lanes, WIDTH)  # the compiler must see that no index overflows
    for n in range(lanes):
        _hold_against(panel, n, full_rate)


@register_jitable(forceinline=True)
def _hold_against(panel: NDArray, n: int, full_rate: float) -> None:
    """Write what _made() returns of one setpoint."""
    frame = _rows_of(quaternion_in(panel, _ATTITUDE, n))
    (wx, wy), (sent_x, sent_y) = pair_in(panel, _RATE, n), pair_in(panel, _SENT_RATE, n)
    turned = max(ATTITUDE_AGE * math.sqrt(wx * wx + wy * wy), _NO_TURN)
    half = sine(0.5 * turned) / turned
    seen = turn_rows(-ATTITUDE_AGE * wx, -ATTITUDE_AGE * wy, sine(turned) / turned, 2.0 * half * half)
    dx, dy = wx - sent_x, wy - sent_y
    size = math.sqrt(dx * dx + dy * dy)
    along = 1.0 / max(size, full_rate)  # the turn back has the sine |Δ| kw / 2kR, 1 at most
    size *= along
    back = turn_rows(dx, dy, along, along * along / (1.0 + math.sqrt(1.0 - min(size * size, 1.0))))
    turn = matrix_product(seen, back)
    wanted, believed = matrix_product(frame, turn), transpose(matrix_product(frame, seen))

    px, py, pz = triple_in(panel, _FORCE, n)
    cosine = turn[2][2]  # between thrust as flown and as sent
    pz += GRAVITY
    thrust = math.sqrt(px * px + py * py + pz * pz) / cosine
    fx, fy, fz = triple_in(panel, _SENT_FORCE, n)
    force = fx, fy, fz + GRAVITY
    worst = abs(force[0] - thrust * wanted[0][2])
    error = abs(force[1] - thrust * wanted[1][2])
    worst = worst if error <= worst else error  # also what is not a number
    error = abs(force[2] - thrust * wanted[2][2])
    worst = worst if error <= worst else error
    length = math.sqrt(dot(force, force))

    sent = quaternion_in(panel, _SENT_ATTITUDE, n)
    made = _attitude_rows(force, heading_of(sent))
    turned = _sine_of_half(_rows_of(sent), _pointed_to_yaw(wanted))
    off = _sine_of_half(transposed_product(made, turn), frame)
    forth = transposed_product(frame, wanted)
    ax, ay, az = dot(forth[0], force) * cosine, dot(forth[1], force) * cosine, dot(forth[2], force) * cosine
    write_quaternion_in(panel, _THRUST_OFF, n, (worst, turned, off, force[2] / length))
    write_triple(panel, _FLOWN, n, (ax, ay, az - GRAVITY))
    write_quaternion_in(panel, _MADE_ATTITUDE, n, quaternion_of(matrix_product(forth, made)))
    # The rates that the setpoint asks for at the attitude that the controller believes in the motion.
    x, y = full_rate * dot(believed[0], force) / length, full_rate * dot(believed[1], force) / length
    write_pair(panel, _MADE_RATE, n, sent_x - y, sent_y + x)


@register_jitable(forceinline=True)
def _rows_of(quaternion: tuple[float, float, float, float]) -> Matrix:
    x, y, z, w = quaternion
    return matrix_rows(quaternion, 2.0 / (x * x + y * y + z * z + w * w))


@register_jitable(forceinline=True)
def _sine_of_half(first: Matrix, second: Matrix) -> float:
    """Return the sine of half the angle between rotations: ‖A - B‖² = 8 sin²(angle / 2)."""
    total = _off(first[0], second[0]) + _off(first[1], second[1]) + _off(first[2], second[2])
    return math.sqrt(total / 8.0)


@register_jitable(forceinline=True)
def _off(first: Vector, second: Vector) -> float:
    x, y, z = first[0] - second[0], first[1] - second[1], first[2] - second[2]
    return x * x + y * y + z * z


@njit(error_model="numpy")
def _attitudes(thrusts: NDArray, quaternions: NDArray) -> NDArray:
    """Return what controller_attitude gives."""
    out = np.empty((len(thrusts), 3, 3))
    for n in range(len(thrusts)):
        rows = _attitude_rows((thrusts[n, 0], thrusts[n, 1], thrusts[n, 2]), heading_of(quaternions[n]))
        out[n, 0, 0], out[n, 0, 1], out[n, 0, 2] = rows[0]
        out[n, 1, 0], out[n, 1, 1], out[n, 1, 2] = rows[1]
        out[n, 2, 0], out[n, 2, 1], out[n, 2, 2] = rows[2]
    return out


@register_jitable(forceinline=True)
def _attitude_rows(thrust: Vector, heading: tuple[float, float]) -> Matrix:
    """Return the controller's attitude: z along the thrust, y along z × [cos yaw, sin yaw, 0]."""
    cos, sin = _direction(heading[0], heading[1])  # of yaw
    a, b, c = thrust
    norm = math.sqrt(a * a + b * b + c * c)
    a, b, c = a / norm, b / norm, c / norm
    left = (-c * sin, c * cos, a * sin - b * cos)
    norm = math.sqrt(left[0] ** 2 + left[1] ** 2 + left[2] ** 2)
    p, q, r = left[0] / norm, left[1] / norm, left[2] / norm
    return (q * c - r * b, p, a), (r * a - p * c, q, b), (p * b - q * a, r, c)


@njit(error_model="numpy")
def _commands(quaternions: NDArray) -> NDArray:
    """Return what command_quaternion gives: z as planned, x above [cos yaw, sin yaw]."""
    out, panel = np.empty((len(quaternions), 4)), np.empty(8 * WIDTH)
    for begin in range(0, len(quaternions), WIDTH):
        lanes = lanes_for(len(quaternions) - begin)
        take_in(panel, 0, quaternions, begin, lanes)
        _point_all_to_yaw(panel, lanes)
        give_out(out, begin, panel, 4)
    return out


@register_jitable
def _point_all_to_yaw(panel: NDArray, lanes: int) -> None:
    """Write _pointed_to_yaw() of the first four rows to the next four."""
    lanes = min(lanes, WIDTH)
    for n in range(lanes):
        frame = _pointed_to_yaw(_rows_of(quaternion_in(panel, 0, n)))
        write_quaternion_in(panel, 4, n, quaternion_of(frame))


@register_jitable(forceinline=True)
def _pointed_to_yaw(frame: Matrix) -> Matrix:
    """Return a planned attitude turned about its z to the one that is sent: x above [cos yaw, sin yaw]."""
    a, b, c = frame[0][2], frame[1][2], frame[2][2]
    cos, sin = _direction(frame[1][1], -frame[0][1])  # of yaw
    rise = -(cos * a + sin * b) / c
    norm = math.sqrt(1.0 + rise * rise)
    p, q, r = cos / norm, sin / norm, rise / norm
    return (p, b * r - c * q, a), (q, c * p - a * r, b), (r, a * q - b * p, c)


@register_jitable(forceinline=True)
def _direction(x: float, y: float) -> tuple[float, float]:
    """Return cosine and sine of atan2(y, x)."""
    size = math.sqrt(x * x + y * y)
    cos, sin = x / size, y / size
    return cos if size > 0.0 else 1.0, sin if size > 0.0 else 0.0
