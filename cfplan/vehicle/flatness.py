"""The flatness map: path derivatives, speed profile and yaw to the full state and the motor thrusts.

Written once, in plain arithmetic on the components of vectors, so that numpy arrays (trajectory, certificate)
and CasADi symbols (expert) go through the same equations. Equations: DESIGN section 4; body rates of the Hopf
fibration after Watterson and Kumar, "Control of quadrotors using the Hopf fibration on SO(3)" (2017); drag after
Faessler, Franchi and Scaramuzza (2018), exact here because drag is equal along body x and y.
"""

from typing import Any, NamedTuple

from cfplan.vehicle.airframe import GRAVITY, MOTOR_TORQUE_SIGNS, Airframe

Scalar = Any  # float, NDArray or casadi.SX
Vector = tuple[Scalar, Scalar, Scalar]


class Flat(NamedTuple):
    """What the path, the speed profile and yaw determine, component by component."""

    velocity: Vector
    acceleration: Vector
    jerk: Vector
    snap: Vector
    specific_thrust: Scalar
    # m/s², collective thrust over mass
    thrust_axis: Vector
    # b₃, unit
    body_rate: Vector
    # rad/s, body axes
    angular_acceleration: Vector
    # rad/s², body axes
    torque: Vector
    # N m
    motor_thrust: tuple[Scalar, Scalar, Scalar, Scalar]
    # N


def _combine(*terms: tuple[Scalar, Vector]) -> Vector:
    x, y, z = (sum(weight * vector[axis] for weight, vector in terms) for axis in range(3))
    return x, y, z


def _dot(a: Vector, b: Vector) -> Scalar:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def motion(d1: Vector, d2: Vector, h: Scalar, dh: Scalar) -> tuple[Vector, Vector]:
    """Velocity and acceleration from γ', γ'', h, h'."""
    return _combine((h**0.5, d1)), _combine((h, d2), (0.5 * dh, d1))


def flat_state(
    airframe: Airframe,
    derivatives: tuple[Vector, Vector, Vector, Vector],
    h: tuple[Scalar, Scalar, Scalar, Scalar],
    yaw: tuple[Scalar, Scalar, Scalar],
    cos: Any,
    sin: Any,
) -> Flat:
    """The full state where `derivatives` are γ' to γ'''', `h` is (h, h', h'', h''') and `yaw` is (ψ, ψ', ψ'').

    `cos` and `sin` are those of the arithmetic in use. h must be positive.
    """
    d1, d2, d3, d4 = derivatives
    h0, h1, h2, h3 = h
    speed = h0**0.5  # ds/dt

    velocity, acceleration = motion(d1, d2, h0, h1)
    acceleration_ds = _combine((h0, d3), (1.5 * h1, d2), (0.5 * h2, d1))
    acceleration_dds = _combine((h0, d4), (2.5 * h1, d3), (2.0 * h2, d2), (0.5 * h3, d1))
    jerk = _combine((speed, acceleration_ds))
    snap = _combine((h0, acceleration_dds), (0.5 * h1, acceleration_ds))

    # Force over mass that the rotors must give: drag along body x and y is that of the whole velocity, and what
    # drag along the thrust axis differs by only changes the collective thrust.
    drag, axial_drag = airframe.drag[0] / airframe.mass, airframe.drag[1] / airframe.mass
    force = _combine((1.0, acceleration), (drag, velocity))
    force = (force[0], force[1], force[2] + GRAVITY)
    force_dt = _combine((1.0, jerk), (drag, acceleration))
    force_ddt = _combine((1.0, snap), (drag, jerk))

    norm = _dot(force, force) ** 0.5
    axis = _combine((1.0 / norm, force))
    norm_dt = _dot(axis, force_dt)
    axis_dt = _combine((1.0 / norm, force_dt), (-norm_dt / norm, axis))
    norm_ddt = _dot(axis, force_ddt) + norm * _dot(axis_dt, axis_dt)
    axis_ddt = _combine((1.0 / norm, force_ddt), (-2.0 * norm_dt / norm, axis_dt), (-norm_ddt / norm, axis))
    specific_thrust = norm + (axial_drag - drag) * _dot(axis, velocity)

    psi, psi_ds, psi_dds = yaw
    psi_dt = speed * psi_ds
    psi_ddt = h0 * psi_dds + 0.5 * h1 * psi_ds

    (a, b, c), (a1, b1, c1), (a2, b2, c2) = axis, axis_dt, axis_ddt
    lift = 1.0 / (1.0 + c)
    p = a1 - a * c1 * lift
    r = b1 - b * c1 * lift
    p_dt = a2 - (a1 * c1 + a * c2) * lift + a * c1 * c1 * lift * lift
    r_dt = b2 - (b1 * c1 + b * c2) * lift + b * c1 * c1 * lift * lift
    cos_psi, sin_psi = cos(psi), sin(psi)
    wx = p * sin_psi - r * cos_psi
    wy = p * cos_psi + r * sin_psi
    wz = (b * a1 - a * b1) * lift + psi_dt
    body_rate = (wx, wy, wz)
    angular_acceleration = (
        p_dt * sin_psi - r_dt * cos_psi + psi_dt * wy,
        p_dt * cos_psi + r_dt * sin_psi - psi_dt * wx,
        (b * a2 - a * b2) * lift - (b * a1 - a * b1) * c1 * lift * lift + psi_ddt,
    )

    jx, jy, jz = airframe.inertia
    torque = (
        jx * angular_acceleration[0] + (jz - jy) * wy * wz,
        jy * angular_acceleration[1] + (jx - jz) * wz * wx,
        jz * angular_acceleration[2] + (jy - jx) * wx * wy,
    )
    motor_thrust = motor_thrusts(airframe, airframe.mass * specific_thrust, torque)
    return Flat(
        velocity, acceleration, jerk, snap, specific_thrust, axis, body_rate, angular_acceleration, torque, motor_thrust
    )


def motor_thrusts(airframe: Airframe, collective: Scalar, torque: Vector) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """Thrust of motors 1 to 4, N, that gives the collective thrust, N, and the torque, N m."""
    roll, pitch, yaw = (
        torque[0] / (4.0 * airframe.arm),
        torque[1] / (4.0 * airframe.arm),
        torque[2] / (4.0 * airframe.thrust_to_torque),
    )
    one, two, three, four = (
        0.25 * collective + float(sx) * roll + float(sy) * pitch + float(sz) * yaw
        for sx, sy, sz in MOTOR_TORQUE_SIGNS.T
    )
    return one, two, three, four
