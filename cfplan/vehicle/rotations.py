"""Rotations: quaternions x, y, z, w from body to world, their matrices, yaw and tilt, and the Hopf fibration.

One function body serves numpy and numba alike, as both index a quaternion by component: a tuple, an array (4,), or for
N attitudes at once an array (4, N), which is the transpose of the (N, 4) that trajectories and packets hold.

The Hopf fibration (Watterson and Kumar, "Control of quadrotors using the Hopf fibration on SO(3)", 2017) makes an
attitude of a thrust axis and a yaw: a turn by yaw about the vertical, then the least turn from there to the axis. Euler
yaw (ZYX), which `yaw_of` gives, differs from it by a little that vanishes with tilt.
"""

from typing import Any

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.machine_code import njit

Scalar = Any  # float, NDArray or casadi.SX
Vector = tuple[Scalar, Scalar, Scalar]
Quaternion = Any  # four scalars: a tuple, or an array whose first axis is 4


@register_jitable
def heading_of(quaternion: Quaternion) -> tuple[Scalar, Scalar]:
    """Return the horizontal components x, y of the body's x axis: cosine and sine of yaw, times the cosine of pitch."""
    x, y, z, w = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    return 1.0 - 2.0 * (y * y + z * z), 2.0 * (w * z + x * y)


@register_jitable
def yaw_of(quaternion: Quaternion) -> Scalar:
    """Return yaw, rad, of the Euler angles ZYX: the heading of the body's x axis."""
    x, y = heading_of(quaternion)
    return np.arctan2(y, x)


@register_jitable
def roll_pitch_of(quaternion: Quaternion) -> tuple[Scalar, Scalar]:
    """Return roll and pitch, rad, of the Euler angles ZYX."""
    x, y, z, w = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    rise = np.minimum(np.maximum(2.0 * (w * y - z * x), -1.0), 1.0)
    return np.arctan2(2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)), np.arcsin(rise)


def tilt_of(quaternion: Quaternion) -> Scalar:
    """Return the angle, rad, between the body's z axis and the vertical."""
    x, y = quaternion[0], quaternion[1]
    return np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0))


def about_z(yaw: Scalar) -> NDArray:
    """Return the quaternion (..., 4) of a level attitude with this yaw, rad."""
    half = np.asarray(yaw) / 2
    return np.stack([0.0 * half, 0.0 * half, np.sin(half), np.cos(half)], axis=-1)


@register_jitable(forceinline=True)
def hopf_quaternion(axis: Vector, cos: Scalar, sin: Scalar) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """Return the attitude with this thrust axis, a unit vector; `cos` and `sin` are those of half the Hopf yaw."""
    a, b, c = axis
    norm = (2.0 * (1.0 + c)) ** 0.5
    return (a * sin - b * cos) / norm, (a * cos + b * sin) / norm, sin * norm / 2, cos * norm / 2


@register_jitable
def product(first: Quaternion, second: Quaternion) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """Return first ⊗ second: the turn `second` in the axes that `first` makes."""
    x, y, z, w = first[0], first[1], first[2], first[3]
    a, b, c, d = second[0], second[1], second[2], second[3]
    return (
        w * a + x * d + y * c - z * b,
        w * b - x * c + y * d + z * a,
        w * c + x * b - y * a + z * d,
        w * d - x * a - y * b - z * c,
    )


@njit
def matrix_of(quaternion: NDArray) -> NDArray:
    """Return the (3, 3) matrix of a unit quaternion, (4,): its columns are the body's axes."""
    x, y, z, w = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    matrix = np.empty((3, 3))
    matrix[0, 0] = 1 - 2 * (y * y + z * z)
    matrix[0, 1] = 2 * (x * y - z * w)
    matrix[0, 2] = 2 * (x * z + y * w)
    matrix[1, 0] = 2 * (x * y + z * w)
    matrix[1, 1] = 1 - 2 * (x * x + z * z)
    matrix[1, 2] = 2 * (y * z - x * w)
    matrix[2, 0] = 2 * (x * z - y * w)
    matrix[2, 1] = 2 * (y * z + x * w)
    matrix[2, 2] = 1 - 2 * (x * x + y * y)
    return matrix
