"""The rigid body with motor lag and the aerodynamics of moving rotors, stepped at 1 kHz or a little slower.

Air has three effects. In proportion to the velocity v through it, in body axes: drag, and a moment about x and y that
tilts the body against its motion (v_y about x, -v_x about y: blade flapping, drag above the centre of mass). In
proportion to |v|² in the rotor plane: more thrust at the same rotor speed. Real flights show all three. Motors give the
commanded thrust times the airframe's thrust scale; a curved thrust is a parabola through zero thrust and hover.

Semi-implicit Euler, in order: motors, body rate, velocity, position, attitude; each step uses the results before it.

The floor is inelastic and holds: a body on it that the rotors do not lift stays where it is and tips over, back onto
its feet or, if it came down steeper than `TIPPING_ANGLE`, onto its back, where it stays. It turns at a finite rate, so
that its gyroscopes feel it.
"""

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.machine_code import njit
from cfplan.simulation.engine.layout import (
    ARM,
    ASKED,
    AXIAL_DRAG,
    CURVATURE,
    CURVATURE_PER_HOVER,
    DRAG,
    EFFICIENCY,
    FLOOR,
    JX,
    JY,
    JZ,
    LAG,
    LIFT,
    MASS,
    PITCH_MOMENT,
    REACTION,
    ROLL_MOMENT,
    THRUST_MAX,
    THRUST_SCALE,
    THRUST_TO_TORQUE,
    TOP,
    WIND,
    quadruple,
    vector,
    write_quadruple,
    write_vector,
)
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.rotations import Quaternion, Vector, axes_of, product, yaw_of

TIME_STEP = 0.001  # s

# Estimated from a fall onto an edge under gravity, with feet 32 mm from the centre and 10 mm below it.
TIPPING_ANGLE = np.radians(75.0)  # rad from upright: beyond it, over onto the back
TIPPING_RATE = 10.0  # rad/s
_LEVEL = 1e-9  # rad


@njit(allocates=False, error_model="numpy")
def step_body(vehicle: NDArray, step: float) -> None:
    """Advance one vehicle, (77,) as in `layout`, by a step, s, with the commanded thrusts."""
    move(vehicle, 1, 0, step)
    stay_above_floor(vehicle, 1, 0, step)


@njit(allocates=False, error_model="numpy")
def step_and_feel(vehicle: NDArray, step: float, felt: NDArray) -> None:
    """Advance one vehicle; write the specific force, (3,) m/s² in body axes, measured by its accelerometer."""
    vx, vy, vz = vehicle[3], vehicle[4], vehicle[5]
    step_body(vehicle, step)
    axes = axes_of(vehicle[6], vehicle[7], vehicle[8], vehicle[9])
    fx, fy, fz = (vehicle[3] - vx) / step, (vehicle[4] - vy) / step, (vehicle[5] - vz) / step + GRAVITY
    felt[0], felt[1], felt[2] = _along(axes, fx, fy, fz)


@register_jitable(forceinline=True)
def move(batch: NDArray, width: int, n: int, step: float) -> None:
    """Advance a lane by a step, s; what stands on the floor and is not lifted stays. `stay_above_floor` comes next."""
    mass = batch[MASS * width + n]
    per_mass, per_step = 1.0 / mass, 1.0 / step
    qx, qy, qz, qw = quadruple(batch, width, n, 6)
    axes = axes_of(qx, qy, qz, qw)
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = axes
    (vx, vy, vz), wind = vector(batch, width, n, 3), vector(batch, width, n, WIND)
    air_x, air_y, air_z = _along(axes, vx - wind[0], vy - wind[1], vz - wind[2])
    lift = 1.0 + batch[LIFT * width + n] * (air_x * air_x + air_y * air_y)

    # Motors: thrust follows the command with a lag; a rotor that speeds up turns the body the other way.
    response = min(1.0, step / max(batch[LAG * width + n], 1e-9))
    push_0, twist_0 = _spin_up(batch, width, n, 0, response, lift, per_step)
    push_1, twist_1 = _spin_up(batch, width, n, 1, response, lift, per_step)
    push_2, twist_2 = _spin_up(batch, width, n, 2, response, lift, per_step)
    push_3, twist_3 = _spin_up(batch, width, n, 3, response, lift, per_step)
    thrust = push_0 + push_1 + push_2 + push_3
    arm = batch[ARM * width + n]
    torque_x = arm * (-push_0 - push_1 + push_2 + push_3) + batch[ROLL_MOMENT * width + n] * air_y
    torque_y = arm * (-push_0 + push_1 + push_2 - push_3) - batch[PITCH_MOMENT * width + n] * air_x
    torque_z = -twist_0 + twist_1 - twist_2 + twist_3

    # On the floor the ground takes all torque and every force that does not lift the body off it.
    height = batch[2 * width + n]
    held = (height <= batch[FLOOR * width + n]) & (vz <= 0.0) & (thrust * zz <= mass * GRAVITY)
    free = 0.0 if held else 1.0

    wx, wy, wz = vector(batch, width, n, 10)
    jx, jy, jz = batch[JX * width + n], batch[JY * width + n], batch[JZ * width + n]
    rate = (
        free * (wx + step * (torque_x + (jy - jz) * wy * wz) / jx),
        free * (wy + step * (torque_y + (jz - jx) * wz * wx) / jy),
        free * (wz + step * (torque_z + (jx - jy) * wx * wy) / jz),
    )
    force_x, force_y = -batch[DRAG * width + n] * air_x, -batch[DRAG * width + n] * air_y
    force_z = thrust - batch[AXIAL_DRAG * width + n] * air_z
    velocity = (
        free * (vx + step * (xx * force_x + yx * force_y + zx * force_z) * per_mass),
        free * (vy + step * (xy * force_x + yy * force_y + zy * force_z) * per_mass),
        free * (vz + step * (xz * force_x + yz * force_y + zz * force_z) * per_mass - step * GRAVITY),
    )
    x, y, _ = vector(batch, width, n, 0)
    place = x + step * velocity[0], y + step * velocity[1], height + step * velocity[2]
    write_vector(batch, width, n, 10, rate)
    write_vector(batch, width, n, 3, velocity)
    write_vector(batch, width, n, 0, place)
    write_quadruple(batch, width, n, 6, _turned((qx, qy, qz, qw), rate, step))


@register_jitable(forceinline=True)
def _along(axes: tuple[Vector, Vector, Vector], x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return a vector's components along three axes."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = axes
    return xx * x + xy * y + xz * z, yx * x + yy * y + yz * z, zx * x + zy * y + zz * z


@register_jitable(forceinline=True)
def _spin_up(
    batch: NDArray, width: int, n: int, motor: int, response: float, lift: float, per_step: float
) -> tuple[float, float]:  # seven, as it is inlined
    """Advance a motor's thrust by a step; return its push, N, and its torque about the thrust axis, N m."""
    thrust, asked = batch[(13 + motor) * width + n], batch[(ASKED + motor) * width + n]
    most, scale = min(batch[THRUST_MAX * width + n], batch[TOP * width + n]), batch[THRUST_SCALE * width + n]
    asked = min(max(asked, 0.0), most)
    asked *= 1.0 + batch[CURVATURE * width + n] - batch[CURVATURE_PER_HOVER * width + n] * asked
    change = (scale * asked - thrust) * response
    batch[(13 + motor) * width + n] = thrust + change
    push = (thrust + change) * batch[(EFFICIENCY + motor) * width + n] * lift
    return push, batch[THRUST_TO_TORQUE * width + n] * push + batch[REACTION * width + n] * change * per_step


@register_jitable(forceinline=True)
def _turned(attitude: Quaternion, rate: Vector, step: float) -> tuple[float, float, float, float]:
    """Return an attitude turned by a body rate over a step, s.

    Sine and cosine of half the turn by their series, which are exact to 1e-11 below 0.4 rad (200 rad/s for 4 ms).
    """
    hx, hy, hz = 0.5 * step * rate[0], 0.5 * step * rate[1], 0.5 * step * rate[2]
    square = hx * hx + hy * hy + hz * hz
    sine = 1.0 + square * (-1 / 6 + square * (1 / 120 + square * (-1 / 5040 + square / 362880)))  # over the angle
    cosine = 1.0 + square * (-1 / 2 + square * (1 / 24 + square * (-1 / 720 + square / 40320)))
    x, y, z, w = product(attitude, (hx * sine, hy * sine, hz * sine, cosine))
    per_size = 1.0 / np.sqrt(x * x + y * y + z * z + w * w)
    return x * per_size, y * per_size, z * per_size, w * per_size


@register_jitable
def stay_above_floor(batch: NDArray, width: int, n: int, step: float) -> None:
    """Let a lane that has come down lie on the floor: in place, tipping over the shorter way; standing, exactly level,
    yaw kept.
    """
    height, floor = batch[2 * width + n], batch[FLOOR * width + n]
    if not (height < floor or (height <= floor and batch[5 * width + n] <= 0.0)):
        return
    batch[2 * width + n] = floor
    write_vector(batch, width, n, 3, (0.0, 0.0, 0.0))
    write_vector(batch, width, n, 10, (0.0, 0.0, 0.0))
    attitude = quadruple(batch, width, n, 6)
    (_, _, up_x), (_, _, up_y), (_, _, up_z) = axes_of(attitude[0], attitude[1], attitude[2], attitude[3])
    across = np.sqrt(up_x * up_x + up_y * up_y)
    tilt = np.arctan2(across, up_z)
    if tilt < _LEVEL:
        half = 0.5 * yaw_of(attitude)
        write_quadruple(batch, width, n, 6, (0.0, 0.0, np.sin(half), np.cos(half)))
    elif np.pi - tilt > _LEVEL:
        # About the horizontal axis that brings the body's z axis up, in body axes.
        turn = tilt if tilt < TIPPING_ANGLE else tilt - np.pi
        speed = min(max(turn / step, -TIPPING_RATE), TIPPING_RATE)
        rate = -speed * up_y / across, speed * up_x / across, 0.0
        write_vector(batch, width, n, 10, rate)
        write_quadruple(batch, width, n, 6, _turned(attitude, rate, step))
