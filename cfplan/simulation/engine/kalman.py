"""The firmware's Kalman filter: the vehicle's state estimate from gyroscope, accelerometer and external poses.

Mueller, Hamer and D'Andrea, "Fusing ultra-wideband range measurements with accelerometers and rate gyroscopes for
quadrocopter state estimation" (2015); Mueller, Hehn and D'Andrea, "Covariance correction step for Kalman filtering
with an attitude" (2017); parameters of crazyflie-firmware 2026.08. In flight only the accelerometer's z is
used, so drag is not modelled, and sideways motion depends on attitude and poses; without poses it coasts.

Everything runs inside numba, in plain loops, which compile several times faster than array expressions; the filter
is a tuple of arrays that are changed in place:

    state (9,)   position 0:3 m, velocity 3:6 m/s in body axes, attitude error 6:9 rad
    prior (16,)  as `Prior.pack` makes it
"""

from dataclasses import astuple, dataclass
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.machine_code import njit
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.rotations import axes_of, matrix_of, product

PREDICTION_PERIOD = 10  # ticks of 1 ms

_TICK = 0.001  # s
_SIZE = 9
_SMALLEST_COVARIANCE, _LARGEST_COVARIANCE = 1e-6, 100.0
_INITIAL_DEVIATIONS = (100.0, 100.0, 1.0, 0.01, 0.01, 0.01, 0.01, 0.01, 0.01)
_ATTITUDE_REVERSION = 0.001  # fraction per prediction by which a vehicle on the ground reverts to level
_SMALLEST_CORRECTION = 1e-4  # rad


@dataclass(frozen=True, slots=True)
class Prior:
    """The parameters of the group kalman, with the firmware's defaults."""

    noise_acceleration_xy: float = 0.5
    noise_acceleration_z: float = 1.0
    noise_velocity: float = 0.0
    noise_position: float = 0.0
    noise_attitude: float = 0.0
    noise_gyro_roll_pitch: float = 0.1  # rad/s
    noise_gyro_yaw: float = 0.1  # rad/s
    initial_x: float = 0.0
    initial_y: float = 0.0
    initial_z: float = 0.0
    initial_yaw: float = 0.0  # rad
    most_position: float = 100.0  # m; beyond, the filter resets itself
    most_velocity: float = 10.0  # m/s
    drag_x: float = 0.0
    drag_y: float = 0.0
    drag_z: float = 0.0  # 1/s

    def pack(self) -> NDArray:
        """Return the parameters (16,) for the functions below."""
        return np.array(astuple(self))


(
    _ACC_XY, _ACC_Z, _VEL, _POS, _ATT, _GYRO_RP, _GYRO_YAW, _X, _Y, _Z, _YAW, _MOST_POSITION, _MOST_VELOCITY,
    _DRAG_X, _DRAG_Y, _DRAG_Z,
) = range(16)  # fmt: skip


class Filter(NamedTuple):
    """The filter's state; changed in place."""

    state: NDArray  # (9,)
    quaternion: NDArray  # (4,) body→world x y z w
    covariance: NDArray  # (9, 9)
    sums: NDArray  # (7,) sums of gyroscope 0:3 and accelerometer 3:6 since the last prediction, and their number
    initial: NDArray  # (4,) quaternion to which a standing vehicle reverts


def new_filter(prior: NDArray) -> Filter:
    """Return a filter in its state after power-up."""
    made = Filter(np.zeros(_SIZE), np.zeros(4), np.zeros((_SIZE, _SIZE)), np.zeros(7), np.zeros(4))
    reset(made, prior)
    return made


@njit(allocates=False)
def reset(kalman: Filter, prior: NDArray) -> None:
    """Reset the filter: at rest at the prior's place, with a large variance."""
    for row in range(_SIZE):
        kalman.state[row] = prior[_X + row] if row < 3 else 0.0
        for column in range(_SIZE):
            kalman.covariance[row, column] = _INITIAL_DEVIATIONS[row] ** 2 if row == column else 0.0
    for axis in range(4):
        kalman.initial[axis] = 0.0
    kalman.initial[2], kalman.initial[3] = np.sin(prior[_YAW] / 2), np.cos(prior[_YAW] / 2)
    for axis in range(4):
        kalman.quaternion[axis] = kalman.initial[axis]
    _clear(kalman.sums)


@njit
def step_filter(
    kalman: Filter, prior: NDArray, gyro: NDArray, acceleration: NDArray, poses: NDArray, tick: int, flying: bool
) -> bool:
    """Step the filter by 1 ms; return False if the state had left its bounds and was reset.

    `gyro` (3,) rad/s and `acceleration` (3,) m/s² as measured in body axes; `poses` (n, 9) are those since the
    last tick: position 0:3, quaternion 3:7, standard deviations of position, m, and attitude, rad. A pose whose
    quaternion is zero gives a position alone.
    """
    changed = len(poses) > 0
    if tick % PREDICTION_PERIOD == 0 and kalman.sums[6] > 0:
        for place in range(6):
            kalman.sums[place] /= kalman.sums[6]
        predict(kalman, prior, flying)
        _clear(kalman.sums)
        changed = True
    _add_noise(kalman, prior)
    for row in range(len(poses)):
        _fuse_pose(kalman, poses, row)
    for axis in range(3):
        kalman.sums[axis] += gyro[axis]
        kalman.sums[3 + axis] += acceleration[axis]
    kalman.sums[6] += 1
    if changed:
        _absorb_attitude_error(kalman)
    if not _within_bounds(kalman, prior):
        reset(kalman, prior)
        return False
    return True


@njit(allocates=False)
def estimate(kalman: Filter, out: NDArray) -> None:
    """Write position 0:3, velocity 3:6 in world axes and quaternion 6:10 to `out`."""
    q = kalman.quaternion
    vx, vy, vz = kalman.state[3], kalman.state[4], kalman.state[5]
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = axes_of(q[0], q[1], q[2], q[3])
    for axis in range(3):
        out[axis] = kalman.state[axis]
    out[3] = xx * vx + yx * vy + zx * vz
    out[4] = xy * vx + yy * vy + zy * vz
    out[5] = xz * vx + yz * vy + zz * vz
    for axis in range(4):
        out[6 + axis] = kalman.quaternion[axis]


@njit(allocates=False)
def _clear(values: NDArray) -> None:
    for place in range(len(values)):
        values[place] = 0.0


@njit(allocates=False)
def _within_bounds(kalman: Filter, prior: NDArray) -> bool:
    for axis in range(3):
        # Written so that NaN is out of bounds.
        if not (abs(kalman.state[axis]) < prior[_MOST_POSITION]):
            return False
        if not (abs(kalman.state[3 + axis]) < prior[_MOST_VELOCITY]):
            return False
    return True


@njit
def predict(kalman: Filter, prior: NDArray, flying: bool) -> None:
    """Predict over PREDICTION_PERIOD with the means in `sums`.

    In body axes dv/dt = f − ω × v − g Rᵀe₃ − drag v, where in flight f is along z alone.
    """
    dt = PREDICTION_PERIOD * _TICK
    state, sums = kalman.state, kalman.sums
    turn = matrix_of(kalman.quaternion)
    wx, wy, wz = sums[0], sums[1], sums[2]
    fx, fy, fz = sums[3], sums[4], sums[5]
    if flying:
        fx = fy = 0.0
    _carry(kalman.covariance, linearised(state, turn, sums, prior, dt, flying))

    px, py, pz = state[3], state[4], state[5]
    dx, dy, dz = px * dt + fx * dt * dt / 2, py * dt + fy * dt * dt / 2, pz * dt + fz * dt * dt / 2
    for axis in range(3):
        state[axis] += turn[axis, 0] * dx + turn[axis, 1] * dy + turn[axis, 2] * dz
    state[2] -= GRAVITY * dt * dt / 2
    state[3] += dt * (fx + wz * py - wy * pz - GRAVITY * turn[2, 0])
    state[4] += dt * (fy - wz * px + wx * pz - GRAVITY * turn[2, 1])
    state[5] += dt * (fz + wy * px - wx * py - GRAVITY * turn[2, 2])
    if flying:
        state[3] -= dt * prior[_DRAG_X] * px
        state[4] -= dt * prior[_DRAG_Y] * py
        state[5] -= dt * prior[_DRAG_Z] * pz

    _turn_by(kalman.quaternion, wx * dt, wy * dt, wz * dt)
    if not flying:
        for axis in range(4):
            kalman.quaternion[axis] *= 1.0 - _ATTITUDE_REVERSION
            kalman.quaternion[axis] += _ATTITUDE_REVERSION * kalman.initial[axis]
        _normalise(kalman.quaternion)


@njit
def linearised(state: NDArray, turn: NDArray, gyro: NDArray, prior: NDArray, dt: float, flying: bool) -> NDArray:
    """Return the (9, 9) Jacobian of one prediction."""
    step = np.zeros((_SIZE, _SIZE))
    for axis in range(_SIZE):
        step[axis, axis] = 1.0
    px, py, pz = state[3], state[4], state[5]
    for axis in range(3):
        for other in range(3):
            step[axis, 3 + other] = turn[axis, other] * dt
        step[axis, 6] = (py * turn[axis, 2] - pz * turn[axis, 1]) * dt
        step[axis, 7] = (-px * turn[axis, 2] + pz * turn[axis, 0]) * dt
        step[axis, 8] = (px * turn[axis, 1] - py * turn[axis, 0]) * dt
        if flying:
            step[3 + axis, 3 + axis] -= dt * prior[_DRAG_X + axis]
    _add_cross(step, 3, 3, -dt, gyro[0], gyro[1], gyro[2])
    _add_cross(step, 3, 6, -GRAVITY * dt, turn[2, 0], turn[2, 1], turn[2, 2])
    _rotate_error(step, gyro[0] * dt / 2, gyro[1] * dt / 2, gyro[2] * dt / 2)
    return step


@register_jitable
def _add_cross(step: NDArray, row: int, column: int, scale: float, x: float, y: float, z: float) -> None:
    """Add scale · [vector ×] to the block of 3 × 3 that begins there."""
    step[row, column + 1] -= scale * z
    step[row, column + 2] += scale * y
    step[row + 1, column] += scale * z
    step[row + 1, column + 2] -= scale * x
    step[row + 2, column] -= scale * y
    step[row + 2, column + 1] += scale * x


@njit(allocates=False)
def _rotate_error(step: NDArray, x: float, y: float, z: float) -> None:
    """Write the block that turns the attitude error when the attitude turns by twice (x, y, z), to second order."""
    step[6, 6], step[6, 7], step[6, 8] = 1 - y * y / 2 - z * z / 2, z + x * y / 2, -y + x * z / 2
    step[7, 6], step[7, 7], step[7, 8] = -z + x * y / 2, 1 - x * x / 2 - z * z / 2, x + y * z / 2
    step[8, 6], step[8, 7], step[8, 8] = y + x * z / 2, -x + y * z / 2, 1 - x * x / 2 - y * y / 2


@njit
def _carry(covariance: NDArray, step: NDArray) -> None:
    """Propagate the covariance: P ← A P Aᵀ."""
    half = np.zeros((_SIZE, _SIZE))
    for row in range(_SIZE):
        for column in range(_SIZE):
            for inner in range(_SIZE):
                half[row, column] += step[row, inner] * covariance[inner, column]
    for row in range(_SIZE):
        for column in range(_SIZE):
            value = 0.0
            for inner in range(_SIZE):
                value += half[row, inner] * step[column, inner]
            covariance[row, column] = value


@njit(allocates=False)
def _carry_attitude(covariance: NDArray, step: NDArray) -> None:
    """Propagate the covariance through a step, (9, 9), of which only the block of attitude errors is not identity."""
    for column in range(_SIZE):
        a, b, c = covariance[6, column], covariance[7, column], covariance[8, column]
        for row in range(6, 9):
            covariance[row, column] = step[row, 6] * a + step[row, 7] * b + step[row, 8] * c
    for row in range(_SIZE):
        a, b, c = covariance[row, 6], covariance[row, 7], covariance[row, 8]
        for column in range(6, 9):
            covariance[row, column] = a * step[column, 6] + b * step[column, 7] + c * step[column, 8]


@njit(allocates=False)
def _add_noise(kalman: Filter, prior: NDArray) -> None:
    for axis in range(3):
        acceleration = prior[_ACC_Z] if axis == 2 else prior[_ACC_XY]
        gyro = prior[_GYRO_YAW] if axis == 2 else prior[_GYRO_RP]
        kalman.covariance[axis, axis] += (acceleration * _TICK**2 + prior[_VEL] * _TICK + prior[_POS]) ** 2
        kalman.covariance[3 + axis, 3 + axis] += (acceleration * _TICK + prior[_VEL]) ** 2
        kalman.covariance[6 + axis, 6 + axis] += (gyro * _TICK + prior[_ATT]) ** 2
    _bound(kalman.covariance)


@njit(allocates=False)
def _bound(covariance: NDArray) -> None:
    for row in range(_SIZE):
        for column in range(row, _SIZE):
            value = 0.5 * (covariance[row, column] + covariance[column, row])
            if not value <= _LARGEST_COVARIANCE:
                value = _LARGEST_COVARIANCE
            elif row == column and value < _SMALLEST_COVARIANCE:
                value = _SMALLEST_COVARIANCE
            covariance[row, column] = value
            covariance[column, row] = value


@njit(error_model="numpy")  # a pose turned by half a turn divides by zero: infinity, as on board
def _fuse_pose(kalman: Filter, poses: NDArray, row: int) -> None:
    x, y, z, w = poses[row, 3], poses[row, 4], poses[row, 5], poses[row, 6]
    for axis in range(3):
        fuse(kalman, axis, poses[row, axis] - kalman.state[axis], poses[row, 7])
    if x == 0.0 and y == 0.0 and z == 0.0 and w == 0.0:
        return
    # The residual estimate⁻¹ ⊗ measured, in body axes; small angles.
    a, b, c, d = -kalman.quaternion[0], -kalman.quaternion[1], -kalman.quaternion[2], kalman.quaternion[3]
    scale = 2.0 / (d * w - a * x - b * y - c * z)
    error = (
        scale * (d * x + a * w + b * z - c * y),
        scale * (d * y - a * z + b * w + c * x),
        scale * (d * z + a * y - b * x + c * w),
    )
    for axis in range(3):
        fuse(kalman, 6 + axis, error[axis], poses[row, 8])


@njit(error_model="numpy")
def fuse(kalman: Filter, measured: int, error: float, deviation: float) -> None:
    """Fuse a direct measurement of one state: with c = P e and k = c / (eᵀc + σ²), P ← P − k cᵀ."""
    covariance = kalman.covariance
    spread = covariance[measured, measured] + deviation * deviation
    column = np.empty(_SIZE)
    for place in range(_SIZE):
        column[place] = covariance[place, measured]
    for place in range(_SIZE):
        gain = column[place] / spread
        kalman.state[place] += gain * error
        for other in range(_SIZE):
            covariance[place, other] -= gain * column[other]
    _bound(covariance)


@njit
def _absorb_attitude_error(kalman: Filter) -> None:
    x, y, z = kalman.state[6], kalman.state[7], kalman.state[8]
    most = max(abs(x), abs(y), abs(z))
    if most > _SMALLEST_CORRECTION and most < 10.0:
        _turn_by(kalman.quaternion, x, y, z)
        step = np.zeros((_SIZE, _SIZE))
        _rotate_error(step, x / 2, y / 2, z / 2)
        _carry_attitude(kalman.covariance, step)
    for axis in range(3):
        kalman.state[6 + axis] = 0.0
    _bound(kalman.covariance)


@njit(allocates=False)
def _turn_by(quaternion: NDArray, angle_x: float, angle_y: float, angle_z: float) -> None:
    """Turn an attitude by a rotation vector, rad, in body axes."""
    size = np.sqrt(angle_x**2 + angle_y**2 + angle_z**2) + 1e-9
    share = np.sin(size / 2) / size
    a, b, c, d = share * angle_x, share * angle_y, share * angle_z, np.cos(size / 2)
    turned = product(quaternion, (a, b, c, d))
    for axis in range(4):
        quaternion[axis] = turned[axis]
    _normalise(quaternion)


@njit(allocates=False)
def _normalise(quaternion: NDArray) -> None:
    size = 0.0
    for axis in range(4):
        size += quaternion[axis] ** 2
    size = np.sqrt(size)
    for axis in range(4):
        quaternion[axis] /= size
