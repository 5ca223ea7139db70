"""The firmware's Kalman filter: what the vehicle believes of itself, from gyroscope, accelerometer and external poses.

Mueller, Hamer and D'Andrea, "Fusing ultra-wideband range measurements with accelerometers and rate gyroscopes for
quadrocopter state estimation" (2015); Mueller, Hehn and D'Andrea, "Covariance correction step for Kalman filtering
with an attitude" (2017); parameters of crazyflie-firmware 2026.08. In flight only the accelerometer's z counts, so
drag is unknown to it and sideways motion hangs on attitude and poses; without poses it coasts.

Everything runs inside numba, so the filter is a tuple of arrays that are changed in place:

    state (9,)   position 0:3 m, velocity 3:6 m/s in body axes, attitude error 6:9 rad
    prior (16,)  as `Prior.pack` makes it
"""

from dataclasses import astuple, dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cfplan.simulation.body import rotation
from cfplan.vehicle.airframe import GRAVITY

PREDICTION_PERIOD = 10  # ticks of 1 ms

_TICK = 0.001  # s
_SIZE = 9
_LEAST_COVARIANCE, _MOST_COVARIANCE = 1e-6, 100.0
_INITIAL_DEVIATIONS = (100.0, 100.0, 1.0, 0.01, 0.01, 0.01, 0.01, 0.01, 0.01)
_ATTITUDE_REVERSION = 0.001  # share a prediction by which a vehicle that does not fly is taken to stand level
_LEAST_CORRECTION = 1e-4  # rad


@dataclass(frozen=True, slots=True)
class Prior:
    """The parameters of the group kalman, with the firmware's defaults."""

    noise_acceleration_xy: float = 0.5
    noise_acceleration_z: float = 1.0
    noise_velocity: float = 0.0
    noise_position: float = 0.0
    noise_attitude: float = 0.0
    noise_gyro_roll_pitch: float = 0.1
    # rad/s
    noise_gyro_yaw: float = 0.1
    # rad/s
    initial_x: float = 0.0
    initial_y: float = 0.0
    initial_z: float = 0.0
    initial_yaw: float = 0.0
    # rad
    most_position: float = 100.0
    # m; beyond, the filter resets itself
    most_velocity: float = 10.0
    # m/s
    drag_x: float = 0.0
    drag_y: float = 0.0
    drag_z: float = 0.0
    # 1/s

    def pack(self) -> NDArray:
        """(16,) for the functions below."""
        return np.array(astuple(self))


(
    _ACC_XY, _ACC_Z, _VEL, _POS, _ATT, _GYRO_RP, _GYRO_YAW, _X, _Y, _Z, _YAW, _MOST_POSITION, _MOST_VELOCITY,
    _DRAG_X, _DRAG_Y, _DRAG_Z,
) = range(16)  # fmt: skip


class Filter(NamedTuple):
    """Changed in place."""

    state: NDArray
    # (9,)
    quaternion: NDArray
    # (4,) body→world x y z w
    covariance: NDArray
    # (9, 9)
    sums: NDArray
    # (7,) gyroscope 0:3 and accelerometer 3:6 since the last prediction, and how many
    initial: NDArray
    # (4,) quaternion to which a standing vehicle reverts


def new_filter(prior: NDArray) -> Filter:
    """A filter as it is after power-up."""
    made = Filter(np.zeros(_SIZE), np.zeros(4), np.zeros((_SIZE, _SIZE)), np.zeros(7), np.zeros(4))
    reset(made, prior)
    return made


@njit(cache=True)
def reset(kalman: Filter, prior: NDArray) -> None:
    """Forget everything: stand still at the prior's place, quite unsure where that is."""
    kalman.state[:] = 0.0
    kalman.state[0:3] = prior[_X : _Z + 1]
    kalman.initial[:] = 0.0
    kalman.initial[2], kalman.initial[3] = np.sin(prior[_YAW] / 2), np.cos(prior[_YAW] / 2)
    kalman.quaternion[:] = kalman.initial
    kalman.covariance[:] = 0.0
    for axis in range(_SIZE):
        kalman.covariance[axis, axis] = _INITIAL_DEVIATIONS[axis] ** 2
    kalman.sums[:] = 0.0


@njit(cache=True)
def step_filter(
    kalman: Filter, prior: NDArray, gyro: NDArray, acceleration: NDArray, poses: NDArray, tick: int, flying: bool
) -> bool:
    """One tick of 1 ms; False when the state had left its bounds and was reset.

    `gyro` (3,) rad/s and `acceleration` (3,) m/s² as measured in body axes; `poses` (n, 9) those that came since the
    last tick: position 0:3, quaternion 3:7, standard deviations of position, m, and attitude, rad. A pose whose
    quaternion is zero gives a position alone.
    """
    changed = len(poses) > 0
    if tick % PREDICTION_PERIOD == 0 and kalman.sums[6] > 0:
        _predict(kalman, prior, kalman.sums[0:3] / kalman.sums[6], kalman.sums[3:6] / kalman.sums[6], flying)
        kalman.sums[:] = 0.0
        changed = True
    _add_noise(kalman, prior)
    for row in range(len(poses)):
        _fuse_pose(kalman, poses[row])
    kalman.sums[0:3] += gyro
    kalman.sums[3:6] += acceleration
    kalman.sums[6] += 1
    if changed:
        _absorb_attitude_error(kalman)
    if not _within_bounds(kalman, prior):
        reset(kalman, prior)
        return False
    return True


@njit(cache=True)
def estimate(kalman: Filter, out: NDArray) -> None:
    """Write position 0:3, velocity 3:6 in world axes and quaternion 6:10 to `out`."""
    out[0:3] = kalman.state[0:3]
    out[3:6] = rotation(kalman.quaternion) @ kalman.state[3:6]
    out[6:10] = kalman.quaternion


@njit(cache=True)
def _within_bounds(kalman: Filter, prior: NDArray) -> bool:
    for axis in range(3):
        # Written so that NaN is out of bounds.
        if not (abs(kalman.state[axis]) < prior[_MOST_POSITION]):
            return False
        if not (abs(kalman.state[3 + axis]) < prior[_MOST_VELOCITY]):
            return False
    return True


@njit(cache=True)
def _predict(kalman: Filter, prior: NDArray, gyro: NDArray, acceleration: NDArray, flying: bool) -> None:
    dt = PREDICTION_PERIOD * _TICK
    turn = rotation(kalman.quaternion)
    state = kalman.state
    kalman.covariance[:] = _carried(kalman.covariance, _linearised(state, turn, gyro, prior, dt, flying))

    force = acceleration.copy()
    drag = np.zeros(3)
    if flying:
        force[0] = force[1] = 0.0
        drag[:] = prior[_DRAG_X : _DRAG_Z + 1]
    velocity = state[3:6].copy()
    state[0:3] += turn @ (velocity * dt + force * (dt * dt / 2))
    state[2] -= GRAVITY * dt * dt / 2
    # In body axes: dv/dt = f − ω × v − g Rᵀe₃ − drag v
    state[3] += dt * (force[0] + gyro[2] * velocity[1] - gyro[1] * velocity[2] - GRAVITY * turn[2, 0])
    state[4] += dt * (force[1] - gyro[2] * velocity[0] + gyro[0] * velocity[2] - GRAVITY * turn[2, 1])
    state[5] += dt * (force[2] + gyro[1] * velocity[0] - gyro[0] * velocity[1] - GRAVITY * turn[2, 2])
    state[3:6] -= dt * drag * velocity

    _turn_by(kalman.quaternion, gyro * dt)
    if not flying:
        level = (1.0 - _ATTITUDE_REVERSION) * kalman.quaternion + _ATTITUDE_REVERSION * kalman.initial
        kalman.quaternion[:] = level / np.sqrt(np.sum(level**2))


@njit(cache=True)
def _carried(covariance: NDArray, step: NDArray) -> NDArray:
    return step @ covariance @ step.T


@njit(cache=True)
def _linearised(state: NDArray, turn: NDArray, gyro: NDArray, prior: NDArray, dt: float, flying: bool) -> NDArray:
    """(9, 9) how small changes of the state go through one prediction."""
    step = np.eye(_SIZE)
    step[0:3, 3:6] = turn * dt
    px, py, pz = state[3], state[4], state[5]
    for axis in range(3):
        step[axis, 6] = (py * turn[axis, 2] - pz * turn[axis, 1]) * dt
        step[axis, 7] = (-px * turn[axis, 2] + pz * turn[axis, 0]) * dt
        step[axis, 8] = (px * turn[axis, 1] - py * turn[axis, 0]) * dt
    step[3:6, 3:6] -= dt * _skew(gyro)
    if flying:
        for axis in range(3):
            step[3 + axis, 3 + axis] -= dt * prior[_DRAG_X + axis]
    step[3:6, 6:9] = -GRAVITY * dt * _skew(turn[2, :])
    step[6:9, 6:9] = _rotated_error(gyro * (dt / 2))
    return step


@njit(cache=True)
def _skew(vector: NDArray) -> NDArray:
    x, y, z = vector[0], vector[1], vector[2]
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


@njit(cache=True)
def _rotated_error(half: NDArray) -> NDArray:
    """(3, 3) turns the attitude error's covariance when the attitude turns by twice `half`, to second order."""
    x, y, z = half[0], half[1], half[2]
    return np.array(
        [
            [1 - y * y / 2 - z * z / 2, z + x * y / 2, -y + x * z / 2],
            [-z + x * y / 2, 1 - x * x / 2 - z * z / 2, x + y * z / 2],
            [y + x * z / 2, -x + y * z / 2, 1 - x * x / 2 - y * y / 2],
        ]
    )


@njit(cache=True)
def _add_noise(kalman: Filter, prior: NDArray) -> None:
    for axis in range(3):
        acceleration = prior[_ACC_Z] if axis == 2 else prior[_ACC_XY]
        gyro = prior[_GYRO_YAW] if axis == 2 else prior[_GYRO_RP]
        kalman.covariance[axis, axis] += (acceleration * _TICK**2 + prior[_VEL] * _TICK + prior[_POS]) ** 2
        kalman.covariance[3 + axis, 3 + axis] += (acceleration * _TICK + prior[_VEL]) ** 2
        kalman.covariance[6 + axis, 6 + axis] += (gyro * _TICK + prior[_ATT]) ** 2
    _bound(kalman.covariance)


@njit(cache=True)
def _bound(covariance: NDArray) -> None:
    for row in range(_SIZE):
        for column in range(row, _SIZE):
            value = 0.5 * (covariance[row, column] + covariance[column, row])
            if not value <= _MOST_COVARIANCE:
                value = _MOST_COVARIANCE
            elif row == column and value < _LEAST_COVARIANCE:
                value = _LEAST_COVARIANCE
            covariance[row, column] = value
            covariance[column, row] = value


@njit(cache=True)
def _fuse_pose(kalman: Filter, pose: NDArray) -> None:
    for axis in range(3):
        _fuse(kalman, axis, pose[axis] - kalman.state[axis], pose[7])
    x, y, z, w = pose[3], pose[4], pose[5], pose[6]
    if x == 0.0 and y == 0.0 and z == 0.0 and w == 0.0:
        return
    # The residual estimate⁻¹ ⊗ measured, in body axes; small angles.
    a, b, c, d = -kalman.quaternion[0], -kalman.quaternion[1], -kalman.quaternion[2], kalman.quaternion[3]
    scale = 2.0 / (d * w - a * x - b * y - c * z)
    _fuse(kalman, 6, scale * (d * x + a * w + b * z - c * y), pose[8])
    _fuse(kalman, 7, scale * (d * y - a * z + b * w + c * x), pose[8])
    _fuse(kalman, 8, scale * (d * z + a * y - b * x + c * w), pose[8])


@njit(cache=True)
def _fuse(kalman: Filter, measured: int, error: float, deviation: float) -> None:
    """A direct measurement of one state, in Joseph's form."""
    covariance = kalman.covariance
    column = covariance[:, measured].copy()
    gain = column / (column[measured] + deviation * deviation)
    kalman.state[:] += gain * error
    keep = np.eye(_SIZE)
    keep[:, measured] -= gain
    covariance[:] = keep @ covariance @ keep.T + deviation * deviation * np.outer(gain, gain)
    _bound(covariance)


@njit(cache=True)
def _absorb_attitude_error(kalman: Filter) -> None:
    error = kalman.state[6:9].copy()
    if np.max(np.abs(error)) > _LEAST_CORRECTION and np.max(np.abs(error)) < 10.0:
        _turn_by(kalman.quaternion, error)
        step = np.eye(_SIZE)
        step[6:9, 6:9] = _rotated_error(error / 2)
        kalman.covariance[:] = _carried(kalman.covariance, step)
    kalman.state[6:9] = 0.0
    _bound(kalman.covariance)


@njit(cache=True)
def _turn_by(quaternion: NDArray, angle: NDArray) -> None:
    """Turn an attitude by a rotation vector, rad, in body axes."""
    size = np.sqrt(np.sum(angle**2)) + 1e-9
    share = np.sin(size / 2) / size
    a, b, c, d = share * angle[0], share * angle[1], share * angle[2], np.cos(size / 2)
    x, y, z, w = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    quaternion[0] = w * a + x * d + y * c - z * b
    quaternion[1] = w * b - x * c + y * d + z * a
    quaternion[2] = w * c + x * b - y * a + z * d
    quaternion[3] = w * d - x * a - y * b - z * c
    quaternion /= np.sqrt(np.sum(quaternion**2))
