"""The firmware's Lee controller with its integrals, as crazyflie-firmware has it (controller 5).

Lee, Leok and McClamroch, "Geometric tracking control of a quadrotor UAV on SE(3)" (2010). It commands a collective
thrust and torques; the power distribution divides them among the motors. Runs at 500 Hz inside numba:

    reference (14,)  position 0:3, velocity 3:6, acceleration 6:9, jerk 9:12, yaw 12 rad, yaw rate 13 rad/s
    state            position 0:3, velocity 3:6, quaternion 6:10, body rate 10:13, as in `body`
    memory (6,)      integrals of the position error 0:3, m s, and of the attitude error 3:6, rad s; zeros at the start
    control (4,)     collective thrust N, torque x, y, z N m
    gains (22,)      as `LeeGains.pack` makes them
"""

from dataclasses import astuple, dataclass, fields

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.machine_code import njit
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.rotations import Vector, axes_of

REFERENCE_SIZE, MEMORY_SIZE = 14, 6
_FIRMWARE_INERTIA = (16.571710e-6, 16.655602e-6, 29.261652e-6)  # kg m², which the controller assumes
_LEAST_THRUST = 0.01  # N, below which the integrals are cleared
_KP, _KD, _KI, _KR, _KW, _KA, _MASS, _INERTIA = 0, 3, 6, 9, 12, 15, 18, 19


@dataclass(frozen=True, slots=True)
class LeeGains:
    """The parameters of the group ctrlLee, by their names there, with the firmware's defaults."""

    Kpos_Px: float = 7.0  # 1/s²
    Kpos_Py: float = 7.0
    Kpos_Pz: float = 7.0
    Kpos_Dx: float = 4.0  # 1/s
    Kpos_Dy: float = 4.0
    Kpos_Dz: float = 4.0
    Kpos_Ix: float = 0.0  # 1/s³
    Kpos_Iy: float = 0.0
    Kpos_Iz: float = 0.0
    KR_x: float = 0.007  # N m
    KR_y: float = 0.007
    KR_z: float = 0.008
    Kw_x: float = 0.00115  # N m s
    Kw_y: float = 0.00115
    Kw_z: float = 0.002
    KI_x: float = 0.03  # N m/s
    KI_y: float = 0.03
    KI_z: float = 0.03
    mass: float = 0.034  # kg

    def pack(self) -> NDArray:
        """Return the gains (22,), as the compiled controller takes them."""
        return np.array([*astuple(self), *_FIRMWARE_INERTIA])


LEE_GAINS = tuple(each.name for each in fields(LeeGains))


@njit(allocates=False, error_model="numpy")
def step_lee(
    control: NDArray, memory: NDArray, gains: NDArray, reference: NDArray, state: NDArray, period: float
) -> None:
    """Step the controller by `period`, s (0.002 in the firmware): write `control` and update `memory`."""
    axes = axes_of(state[6], state[7], state[8], state[9])
    force_x = _pull(memory, gains, reference, state, 0, period)
    force_y = _pull(memory, gains, reference, state, 1, period)
    force_z = _pull(memory, gains, reference, state, 2, period) + GRAVITY
    along = force_x * axes[2][0] + force_y * axes[2][1] + force_z * axes[2][2]
    thrust = gains[_MASS] * along
    control[0] = thrust
    if thrust < _LEAST_THRUST:
        for k in range(MEMORY_SIZE):
            memory[k] = 0.0
    wanted = _axes_along((force_x, force_y, force_z), reference[12]) if thrust > 0.0 else _AXES
    errors = _turn_between(wanted, axes)

    # Rates by which the wanted axes turn, in the wanted axes, then in the body's.
    jerk = (reference[9], reference[10], reference[11])
    share = gains[_MASS] / thrust if thrust != 0.0 else 0.0
    rates = (-share * _dot(jerk, wanted[1]), share * _dot(jerk, wanted[0]), reference[13] * wanted[2][2])
    spin = (
        rates[0] * wanted[0][0] + rates[1] * wanted[1][0] + rates[2] * wanted[2][0],
        rates[0] * wanted[0][1] + rates[1] * wanted[1][1] + rates[2] * wanted[2][1],
        rates[0] * wanted[0][2] + rates[1] * wanted[1][2] + rates[2] * wanted[2][2],
    )
    wx, wy, wz = state[10], state[11], state[12]
    jx, jy, jz = gains[_INERTIA], gains[_INERTIA + 1], gains[_INERTIA + 2]
    turning = ((jz - jy) * wy * wz, (jx - jz) * wz * wx, (jy - jx) * wx * wy)
    for k in range(3):
        memory[3 + k] += period * errors[k]
        faster = state[10 + k] - _dot(spin, axes[k])
        control[1 + k] = turning[k] - (
            gains[_KR + k] * errors[k] + gains[_KW + k] * faster + gains[_KA + k] * memory[3 + k]
        )


_AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@register_jitable(forceinline=True)
def _pull(memory: NDArray, gains: NDArray, reference: NDArray, state: NDArray, axis: int, period: float) -> float:
    """Return the desired acceleration along an axis, m/s², and update the integral."""
    error = reference[axis] - state[axis]
    memory[axis] += period * error
    return (
        reference[6 + axis] + gains[_KD + axis] * (reference[3 + axis] - state[3 + axis]) + gains[_KP + axis] * error
        + gains[_KI + axis] * memory[axis]
    )  # fmt: skip


@register_jitable(forceinline=True)
def _axes_along(force: Vector, yaw: float) -> tuple[Vector, Vector, Vector]:
    """Return the axes of a body whose z is along a force and whose x lies over the direction of yaw."""
    size = np.sqrt(_dot(force, force))
    zx, zy, zz = force[0] / size, force[1] / size, force[2] / size
    cos, sin = np.cos(yaw), np.sin(yaw)
    yx, yy, yz = -zz * sin, zz * cos, zx * sin - zy * cos
    size = np.sqrt(yx * yx + yy * yy + yz * yz)
    yx, yy, yz = yx / size, yy / size, yz / size
    return (yy * zz - yz * zy, yz * zx - yx * zz, yx * zy - yy * zx), (yx, yy, yz), (zx, zy, zz)


@register_jitable(forceinline=True)
def _turn_between(wanted: tuple[Vector, Vector, Vector], axes: tuple[Vector, Vector, Vector]) -> Vector:
    """Return half of (Wᵀ R - Rᵀ W) as a vector, of the axes W and R."""
    return (
        0.5 * (_dot(wanted[2], axes[1]) - _dot(axes[2], wanted[1])),
        0.5 * (_dot(wanted[0], axes[2]) - _dot(axes[0], wanted[2])),
        0.5 * (_dot(wanted[1], axes[0]) - _dot(axes[1], wanted[0])),
    )


@register_jitable(forceinline=True)
def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@register_jitable
def divide_power(control: NDArray, levers: tuple[float, float], most: float, motors: NDArray) -> None:
    """Divide thrust and torques among the motors, (4,) N; all are lowered by the excess of the largest over `most`, N.

    `levers`, m: the arm about x and y, and the yaw torque per thrust.
    """
    thrust = 0.25 * control[0]
    roll, pitch = 0.25 * control[1] / levers[0], 0.25 * control[2] / levers[0]
    yaw = 0.25 * control[3] / levers[1]
    motors[0], motors[1] = thrust - roll - pitch - yaw, thrust - roll + pitch + yaw
    motors[2], motors[3] = thrust + roll + pitch - yaw, thrust + roll - pitch + yaw
    excess = max(0.0, motors[0] - most, motors[1] - most, motors[2] - most, motors[3] - most)
    for k in range(4):
        motors[k] = max(motors[k] - excess, 0.0)
