"""Differential flatness: path derivatives, speed profile and yaw to the full state and the motor thrusts.

Written in scalar arithmetic, so that the same equations serve numba (trajectory, certificate) and CasADi symbols
(expert). Equations: docs/architecture.md, "The
mathematics"; body rates of the Hopf fibration after Watterson and Kumar, "Control of quadrotors using the Hopf
fibration on SO(3)" (2017); drag after Faessler, Franchi and Scaramuzza (2018), exact here because drag is equal along
body x and y.
"""

from typing import Any, NamedTuple

from numba.extending import register_jitable

from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.rotations import Scalar, Vector

# What a compiler may do to compiled arithmetic: multiply and add at once, divide by way of a reciprocal, drop the
# sign of a zero. It may not change the order of operations, nor assume that numbers are finite.
ROUNDING = {"contract", "arcp", "nsz"}


# Compiled into the loop that calls it, so that the loop can work on several points at once.
_within_the_loop = register_jitable(forceinline=True, fastmath=ROUNDING)


class Body(NamedTuple):
    """The part of an airframe that the map needs, in a form that compiles; fields as in Airframe."""

    mass: Scalar
    inertia: Vector
    arm: Scalar
    thrust_to_torque: Scalar
    drag: tuple[Scalar, Scalar]
    velocity_moment: tuple[Scalar, Scalar]


class Flat(NamedTuple):
    """The full state that path, speed profile and yaw determine, component by component."""

    velocity: Vector
    acceleration: Vector
    jerk: Vector
    snap: Vector
    specific_thrust: Scalar  # m/s², collective thrust over mass
    thrust_axis: Vector  # b₃, unit
    body_rate: Vector  # rad/s, body axes
    angular_acceleration: Vector  # rad/s², body axes
    torque: Vector  # N m, of the motors
    motor_thrust: tuple[Scalar, Scalar, Scalar, Scalar]  # N


@_within_the_loop
def _scaled(a: Scalar, u: Vector) -> Vector:
    return a * u[0], a * u[1], a * u[2]


@_within_the_loop
def _sum2(a: Scalar, u: Vector, b: Scalar, v: Vector) -> Vector:
    return a * u[0] + b * v[0], a * u[1] + b * v[1], a * u[2] + b * v[2]


@_within_the_loop
def _sum3(a: Scalar, u: Vector, b: Scalar, v: Vector, c: Scalar, w: Vector) -> Vector:
    return a * u[0] + b * v[0] + c * w[0], a * u[1] + b * v[1] + c * w[1], a * u[2] + b * v[2] + c * w[2]


@_within_the_loop
def _dot(a: Vector, b: Vector) -> Scalar:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@_within_the_loop
def motion(d1: Vector, d2: Vector, h: Scalar, dh: Scalar) -> tuple[Vector, Vector]:
    """Return velocity and acceleration from γ', γ'', h, h'."""
    return _scaled(h**0.5, d1), _sum2(h, d2, 0.5 * dh, d1)


@_within_the_loop
def flat_state(
    airframe: Airframe | Body,
    derivatives: tuple[Vector, Vector, Vector, Vector],
    h: tuple[Scalar, Scalar, Scalar, Scalar],
    yaw: tuple[Scalar, Scalar, Scalar],
    cos: Any,
    sin: Any,
) -> Flat:
    """Return the full state where `derivatives` are γ' to γ'''', `h` is (h, h', h'', h''') and `yaw` is (ψ, ψ', ψ'').

    `cos` and `sin` are those of the arithmetic in use. h must be positive.
    """
    d1, d2, d3, d4 = derivatives
    h0, h1, h2, h3 = h
    speed = h0**0.5  # ds/dt

    velocity, acceleration = motion(d1, d2, h0, h1)
    acceleration_ds = _sum3(h0, d3, 1.5 * h1, d2, 0.5 * h2, d1)
    acceleration_dds = _sum2(1.0, _sum3(h0, d4, 2.5 * h1, d3, 2.0 * h2, d2), 0.5 * h3, d1)
    jerk = _scaled(speed, acceleration_ds)
    snap = _sum2(h0, acceleration_dds, 0.5 * h1, acceleration_ds)

    # Force over mass of the rotors: with the drag coefficient of body x and y for the whole velocity; the difference
    # of the coefficient along the thrust axis only changes the collective thrust.
    drag, axial_drag = airframe.drag[0] / airframe.mass, airframe.drag[1] / airframe.mass
    force = _sum2(1.0, acceleration, drag, velocity)
    force = (force[0], force[1], force[2] + GRAVITY)
    force_dt = _sum2(1.0, jerk, drag, acceleration)
    force_ddt = _sum2(1.0, snap, drag, jerk)

    norm = _dot(force, force) ** 0.5
    axis = _scaled(1.0 / norm, force)
    norm_dt = _dot(axis, force_dt)
    axis_dt = _sum2(1.0 / norm, force_dt, -norm_dt / norm, axis)
    norm_ddt = _dot(axis, force_ddt) + norm * _dot(axis_dt, axis_dt)
    axis_ddt = _sum3(1.0 / norm, force_ddt, -2.0 * norm_dt / norm, axis_dt, -norm_ddt / norm, axis)
    specific_thrust = norm + (axial_drag - drag) * _dot(axis, velocity)

    psi, psi_ds, psi_dds = yaw
    psi_dt = speed * psi_ds
    psi_ddt = h0 * psi_dds + 0.5 * h1 * psi_ds

    heading = cos(psi), sin(psi)
    body_rate, angular_acceleration = _turning((axis, axis_dt, axis_ddt), heading, (psi_dt, psi_ddt))
    torque = _torque(airframe, body_rate, angular_acceleration, _velocity_across(axis, heading, velocity))
    motor_thrust = motor_thrusts(airframe, airframe.mass * specific_thrust, torque)
    return Flat(
        velocity, acceleration, jerk, snap, specific_thrust, axis, body_rate, angular_acceleration, torque, motor_thrust
    )


@_within_the_loop
def _turning(
    axes: tuple[Vector, Vector, Vector], heading: tuple[Scalar, Scalar], turn: tuple[Scalar, Scalar]
) -> tuple[Vector, Vector]:
    """Return body rate and angular acceleration.

    `axes` are the thrust axis and its first two time derivatives, `heading` is (cos ψ, sin ψ), `turn` holds those of ψ.
    """
    (a, b, c), (a1, b1, c1), (a2, b2, c2) = axes
    (cos_psi, sin_psi), (psi_dt, psi_ddt) = heading, turn
    lift = 1.0 / (1.0 + c)
    p = a1 - a * c1 * lift
    r = b1 - b * c1 * lift
    p_dt = a2 - (a1 * c1 + a * c2) * lift + a * c1 * c1 * lift * lift
    r_dt = b2 - (b1 * c1 + b * c2) * lift + b * c1 * c1 * lift * lift
    wx = p * sin_psi - r * cos_psi
    wy = p * cos_psi + r * sin_psi
    wz = (b * a1 - a * b1) * lift + psi_dt
    return (wx, wy, wz), (
        p_dt * sin_psi - r_dt * cos_psi + psi_dt * wy,
        p_dt * cos_psi + r_dt * sin_psi - psi_dt * wx,
        (b * a2 - a * b2) * lift - (b * a1 - a * b1) * c1 * lift * lift + psi_ddt,
    )


@_within_the_loop
def _velocity_across(axis: Vector, heading: tuple[Scalar, Scalar], velocity: Vector) -> tuple[Scalar, Scalar]:
    """Return the velocity along body x and y."""
    a, b, c = axis
    lift = 1.0 / (1.0 + c)
    first = velocity[0] - a * (velocity[2] + lift * (a * velocity[0] + b * velocity[1]))
    second = velocity[1] - b * (velocity[2] + lift * (a * velocity[0] + b * velocity[1]))
    cos_psi, sin_psi = heading
    return cos_psi * first + sin_psi * second, cos_psi * second - sin_psi * first


@_within_the_loop
def _torque(
    airframe: Airframe | Body, body_rate: Vector, angular_acceleration: Vector, velocity: tuple[Scalar, Scalar]
) -> Vector:
    """Return the torque of the motors, N m; the air adds a moment in proportion to the velocity along body x, y."""
    jx, jy, jz = airframe.inertia
    (wx, wy, wz), (about_x, about_y) = body_rate, airframe.velocity_moment
    return (
        jx * angular_acceleration[0] + (jz - jy) * wy * wz - about_x * velocity[1],
        jy * angular_acceleration[1] + (jx - jz) * wz * wx + about_y * velocity[0],
        jz * angular_acceleration[2] + (jy - jx) * wx * wy,
    )


@_within_the_loop
def motor_thrusts(
    airframe: Airframe | Body, collective: Scalar, torque: Vector
) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """Return the thrust of motors 1 to 4, N, that gives the collective thrust, N, and the torque, N m."""
    roll, pitch, yaw = (
        torque[0] / (4.0 * airframe.arm),
        torque[1] / (4.0 * airframe.arm),
        torque[2] / (4.0 * airframe.thrust_to_torque),
    )
    share = 0.25 * collective  # the signs are those of MOTOR_TORQUE_SIGNS
    return (
        share - roll - pitch - yaw,
        share - roll + pitch + yaw,
        share + roll + pitch - yaw,
        share + roll - pitch + yaw,
    )


def compiled_body(airframe: Airframe) -> Body:
    """Return the airframe for compiled code, which takes only floats."""
    (jx, jy, jz), (planar, axial), (about_x, about_y) = airframe.inertia, airframe.drag, airframe.velocity_moment
    return Body(
        float(airframe.mass), (float(jx), float(jy), float(jz)), float(airframe.arm),
        float(airframe.thrust_to_torque), (float(planar), float(axial)), (float(about_x), float(about_y)),
    )  # fmt: skip
