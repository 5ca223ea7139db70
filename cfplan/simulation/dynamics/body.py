"""The simulated vehicle: a rigid body with motor lag and what air does to moving rotors, stepped at 1 kHz or slower.

Air does three things in proportion to the velocity v through it, in body axes: drag, a moment about x and y that tilts
the body against its motion (v_y about x, -v_x about y: blade flapping, drag above the centre of mass), and with |v|² in
the rotor plane more thrust at the same rotor speed. Real flights show all three. Motors give the thrust that they are
asked for times the airframe's thrust scale; where that curves, a parabola through nothing asked and hover.

Semi-implicit Euler, each line using what the lines above it made: motors, body rate, velocity, position, attitude.
Everything runs inside numba, so state and parameters are flat arrays:

    state (17,)   position 0:3 m, velocity 3:6 m/s, quaternion 6:10 body→world x y z w,
                  body rate 10:13 rad/s in body axes, thrust of each motor 13:17 N

The floor is inelastic and holds: a body on it that the rotors do not lift stays where it is and tips over, back onto
its feet or, if it came down steeper than `TIPPING_ANGLE`, onto its back, where it stays. It turns at a finite rate, so
that its gyroscopes feel it.
"""

from typing import Any

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.machine_code import njit
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.rotations import Quaternion, Vector, about_z, axes_of, product, yaw_of

TIME_STEP = 0.001  # s

# About what a Crazyflie's feet, 32 mm from its centre and 10 mm below it, and gravity make of a fall onto an edge.
TIPPING_ANGLE = np.radians(75.0)  # rad from upright: beyond it, over onto the back
TIPPING_RATE = 10.0  # rad/s
_LEVEL = 1e-9  # rad

POSITION = slice(0, 3)
VELOCITY = slice(3, 6)
QUATERNION = slice(6, 10)
BODY_RATE = slice(10, 13)
MOTORS = slice(13, 17)
STATE_SIZE = 17

# Where each parameter lies in the array that `pack_body` makes.
(
    MASS, _JX, _JY, _JZ, _ARM, _THRUST_TO_TORQUE, THRUST_MAX, LAG, DRAG, AXIAL_DRAG, FLOOR, _REACTION, STEP,
    _ROLL_MOMENT, _PITCH_MOMENT, _LIFT, THRUST_SCALE, _CURVATURE, _HOVER,
) = range(19)  # fmt: skip

Parameters = Any  # what `pack_body` makes, as an array or as a tuple
Motors = tuple[float, float, float, float]

STILL_AIR = np.zeros(3)
FULL_EFFICIENCY = np.ones(4)


def pack_body(airframe: Airframe, *, floor: float = 0.0, step: float = TIME_STEP) -> NDArray:
    """Return the parameters for `step_body`; `floor` is the height of the ground, -inf for none; `step` in s."""
    return np.array(
        [
            airframe.mass,
            *airframe.inertia,
            airframe.arm,
            airframe.thrust_to_torque,
            airframe.motor_thrust_max,
            airframe.motor_time_constant,
            *airframe.drag,
            floor,
            airframe.rotor_reaction,
            step,
            *airframe.velocity_moment,
            airframe.lift_with_speed,
            airframe.thrust_scale,
            airframe.thrust_curvature,
            airframe.hover_thrust / airframe.thrust_scale,
        ],
        dtype=float,
    )


def hovering(airframe: Airframe, position: NDArray, yaw: float = 0.0) -> NDArray:
    """Return the state, (17,), of a vehicle that hovers."""
    state = at_rest(position, yaw)
    state[MOTORS] = airframe.hover_thrust
    return state


def at_rest(position: NDArray, yaw: float = 0.0) -> NDArray:
    """Return the state, (17,), of a vehicle that stands still, level, its motors off."""
    state = np.zeros(STATE_SIZE)
    state[POSITION] = position
    state[QUATERNION] = about_z(yaw)
    return state


@njit(allocates=False)
def step_body(state: NDArray, command: NDArray, body: NDArray, wind: NDArray, efficiency: NDArray) -> None:
    """Advance `state` by one step, in place.

    `command` (4,) N is what each motor is asked for, clipped to `motor_thrust_max`, then scaled; `wind` (3,) m/s in
    world axes; `efficiency` (4,) is the share of its thrust that each motor gives, 1 without a fault.
    """
    step = body[STEP]
    lag = lag_share(body)
    axes = axes_of(state[6], state[7], state[8], state[9])
    air = along_axes((state[3] - wind[0], state[4] - wind[1], state[5] - wind[2]), axes)
    lift = lift_of(air, body)
    push_0, twist_0 = _spin_up(state, command, body, efficiency, lag, lift, 0)
    push_1, twist_1 = _spin_up(state, command, body, efficiency, lag, lift, 1)
    push_2, twist_2 = _spin_up(state, command, body, efficiency, lag, lift, 2)
    push_3, twist_3 = _spin_up(state, command, body, efficiency, lag, lift, 3)

    # On the floor the ground takes all torque and every force that does not lift the body off it.
    upward = (push_0 + push_1 + push_2 + push_3) * axes[2][2]
    if state[2] <= body[FLOOR] and state[5] <= 0.0 and upward <= body[MASS] * GRAVITY:
        rest(state, body)
        return

    velocity, rate = (state[3], state[4], state[5]), (state[10], state[11], state[12])
    pushes, twists = (push_0, push_1, push_2, push_3), (twist_0, twist_1, twist_2, twist_3)
    state[10], state[11], state[12] = turned_faster(rate, air, pushes, twists, body)
    state[3], state[4], state[5] = accelerated(velocity, air, axes, pushes, body)
    for axis in range(3):
        state[axis] += step * state[3 + axis]
    _turn(state, step)
    if state[2] < body[FLOOR]:
        rest(state, body)


@register_jitable(forceinline=True)
def lag_share(body: Parameters) -> float:
    """Return the share of what a motor's thrust misses that it makes up for in a step."""
    return min(1.0, body[STEP] / max(body[LAG], 1e-9))


@register_jitable(forceinline=True)
def spun_up(thrust: float, asked: float, body: Parameters, lag: float) -> tuple[float, float]:
    """Return a motor's thrust, N, after a step in which it is asked for another, and by how much it changes."""
    asked = min(max(asked, 0.0), body[THRUST_MAX])
    curvature = body[_CURVATURE]
    if curvature != 0.0:
        share = asked / body[_HOVER]
        if curvature > 0.0:
            share = min(share, (1.0 + curvature) / (2.0 * curvature))  # no further than the top
        asked = body[_HOVER] * share * (1.0 + curvature - curvature * share)
    change = (body[THRUST_SCALE] * asked - thrust) * lag
    return thrust + change, change


@register_jitable(forceinline=True)
def along_axes(vector: Vector, axes: tuple[Vector, Vector, Vector]) -> tuple[float, float, float]:
    """Return a vector's components along three axes."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = axes
    x, y, z = vector
    return xx * x + xy * y + xz * z, yx * x + yy * y + yz * z, zx * x + zy * y + zz * z


@register_jitable(forceinline=True)
def lift_of(air: Vector, body: Parameters) -> float:
    """Return the factor on thrust of a velocity through the air, m/s in body axes."""
    return 1.0 + body[_LIFT] * (air[0] * air[0] + air[1] * air[1])


@register_jitable(forceinline=True)
def twist_of(push: float, change: float, body: Parameters) -> float:
    """Return a motor's torque about the thrust axis, N m, by its push, N, and by how much its thrust changes in a step.

    A rotor that speeds up pushes the body the other way round, as its drag does.
    """
    return body[_THRUST_TO_TORQUE] * push + body[_REACTION] * change / body[STEP]


@register_jitable(forceinline=True)
def turned_faster(rate: Vector, air: Vector, pushes: Motors, twists: Motors, body: Parameters) -> Vector:
    """Return the body rate, rad/s, after a step.

    By the velocity through the air, m/s in body axes, the push of each motor, N, and its torque, N m.
    """
    push_0, push_1, push_2, push_3 = pushes
    torque_x = body[_ARM] * (-push_0 - push_1 + push_2 + push_3) + body[_ROLL_MOMENT] * air[1]
    torque_y = body[_ARM] * (-push_0 + push_1 + push_2 - push_3) - body[_PITCH_MOMENT] * air[0]
    torque_z = -twists[0] + twists[1] - twists[2] + twists[3]
    (wx, wy, wz), step = rate, body[STEP]
    jx, jy, jz = body[_JX], body[_JY], body[_JZ]
    return (
        wx + step * (torque_x + (jy - jz) * wy * wz) / jx,
        wy + step * (torque_y + (jz - jx) * wz * wx) / jy,
        wz + step * (torque_z + (jx - jy) * wx * wy) / jz,
    )


@register_jitable(forceinline=True)
def accelerated(
    velocity: Vector, air: Vector, axes: tuple[Vector, Vector, Vector], pushes: Motors, body: Parameters
) -> Vector:
    """Return the velocity, m/s, after a step, by that through the air in body axes, the axes and the pushes, N."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = axes
    step = body[STEP]
    thrust = pushes[0] + pushes[1] + pushes[2] + pushes[3]
    force_x = -body[DRAG] * air[0]
    force_y = -body[DRAG] * air[1]
    force_z = thrust - body[AXIAL_DRAG] * air[2]
    return (
        velocity[0] + step * (xx * force_x + yx * force_y + zx * force_z) / body[MASS],
        velocity[1] + step * (xy * force_x + yy * force_y + zy * force_z) / body[MASS],
        velocity[2] + step * (xz * force_x + yz * force_y + zz * force_z) / body[MASS] - step * GRAVITY,
    )


@register_jitable(forceinline=True)
def _spin_up(
    state: NDArray, command: NDArray, body: NDArray, efficiency: NDArray, lag: float, lift: float, motor: int
) -> tuple[float, float]:
    """Advance a motor's thrust by a step; return its push, N, and its torque about the thrust axis, N m."""
    state[13 + motor], change = spun_up(state[13 + motor], command[motor], body, lag)
    push = state[13 + motor] * efficiency[motor] * lift
    return push, twist_of(push, change, body)


@register_jitable(forceinline=True)
def turn_of(rate: Vector, step: float) -> tuple[float, float]:
    """Return the size of a body rate, rad/s, and half the angle, rad, by which it turns in a step, s."""
    wx, wy, wz = rate
    size = np.sqrt(wx * wx + wy * wy + wz * wz)
    return size, 0.5 * size * step


@register_jitable(forceinline=True)
def turned(
    attitude: Quaternion, rate: Vector, size: float, half: float, sin: float, cos: float, step: float
) -> tuple[float, float, float, float]:
    """Return an attitude turned by a body rate over a step, exactly for a constant rate; `sin` and `cos` of `half`."""
    share = 0.5 * step if half < 1e-9 else sin / size
    rx, ry, rz, rw = rate[0] * share, rate[1] * share, rate[2] * share, cos
    x, y, z, w = attitude
    norm = np.sqrt((x * x + y * y + z * z + w * w) * (rx * rx + ry * ry + rz * rz + rw * rw))
    x, y, z, w = product((x, y, z, w), (rx, ry, rz, rw))
    return x / norm, y / norm, z / norm, w / norm


@njit(allocates=False)
def _turn(state: NDArray, step: float) -> None:
    """Turn the attitude by the body rate over a step, s."""
    rate, attitude = (state[10], state[11], state[12]), (state[6], state[7], state[8], state[9])
    size, half = turn_of(rate, step)
    state[6], state[7], state[8], state[9] = turned(attitude, rate, size, half, np.sin(half), np.cos(half), step)


@njit(allocates=False)
def rest(state: NDArray, body: NDArray) -> None:
    """Lie on the floor for a step: in place, tipping over the shorter way; standing, exactly level, yaw kept."""
    state[2] = body[FLOOR]
    state[3:6] = 0.0
    state[10:13] = 0.0
    (_, _, up_x), (_, _, up_y), (_, _, up_z) = axes_of(state[6], state[7], state[8], state[9])
    across = np.sqrt(up_x * up_x + up_y * up_y)
    tilt = np.arctan2(across, up_z)
    if tilt < _LEVEL:
        half = 0.5 * yaw_of(state[6:10])
        state[6:8] = 0.0
        state[8], state[9] = np.sin(half), np.cos(half)
    elif np.pi - tilt > _LEVEL:
        # About the horizontal axis that brings the body's z axis up, in body axes.
        turn = tilt if tilt < TIPPING_ANGLE else tilt - np.pi
        rate = min(max(turn / body[STEP], -TIPPING_RATE), TIPPING_RATE)
        state[10], state[11] = -rate * up_y / across, rate * up_x / across
        _turn(state, body[STEP])
