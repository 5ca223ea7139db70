"""Rotations: quaternions x, y, z, w from body to world, their matrices, yaw and tilt, and the Hopf fibration.

One function body serves numpy and numba alike, as both index a quaternion by component: a tuple, an array (4,), or for
N attitudes at once an array (4, N), which is the transpose of the (N, 4) that trajectories and packets hold.

The Hopf fibration (Watterson and Kumar, "Control of quadrotors using the Hopf fibration on SO(3)", 2017) makes an
attitude of a thrust axis and a yaw: a turn by yaw about the vertical, then the least turn from there to the axis. Euler
yaw (ZYX), which `yaw_of` gives, differs from it by a little that vanishes with tilt.
"""

import math
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


@register_jitable(forceinline=True)
def axes_of(x: float, y: float, z: float, w: float) -> tuple[Vector, Vector, Vector]:
    """Return the body's axes x, y, z in the world, of a unit quaternion: the columns of its matrix, as scalars."""
    return (
        (1 - 2.0 * (y * y + z * z), 2.0 * (x * y + z * w), 2.0 * (x * z - y * w)),
        (2.0 * (x * y - z * w), 1 - 2.0 * (x * x + z * z), 2.0 * (y * z + x * w)),
        (2.0 * (x * z + y * w), 2.0 * (y * z - x * w), 1 - 2.0 * (x * x + y * y)),
    )


@njit
def matrix_of(quaternion: NDArray) -> NDArray:
    """Return the (3, 3) matrix of a unit quaternion, (4,): its columns are the body's axes."""
    matrix = np.empty((3, 3))
    write_matrix(matrix, quaternion, 2.0)
    return matrix


@njit(error_model="numpy")
def matrices_of(quaternions: NDArray) -> NDArray:
    """Return the (N, 3, 3) matrices of quaternions (N, 4), which need not be of unit length."""
    out = np.empty((len(quaternions), 3, 3))
    for n in range(len(quaternions)):
        x, y, z, w = quaternions[n, 0], quaternions[n, 1], quaternions[n, 2], quaternions[n, 3]
        write_matrix(out[n], quaternions[n], 2.0 / (x * x + y * y + z * z + w * w))
    return out


@register_jitable
def write_matrix(out: NDArray, quaternion: NDArray, scale: float) -> None:
    """Write the matrix of a quaternion; `scale` is 2 over its squared length."""
    x, y, z, w = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    out[0, 0], out[0, 1], out[0, 2] = 1 - scale * (y * y + z * z), scale * (x * y - z * w), scale * (x * z + y * w)
    out[1, 0], out[1, 1], out[1, 2] = scale * (x * y + z * w), 1 - scale * (x * x + z * z), scale * (y * z - x * w)
    out[2, 0], out[2, 1], out[2, 2] = scale * (x * z - y * w), scale * (y * z + x * w), 1 - scale * (x * x + y * y)


@register_jitable
def write_quaternion(out: NDArray, matrix: NDArray) -> None:
    """Write the quaternion, (4,), of a rotation matrix, by way of its largest component (Shepperd 1978)."""
    trace = matrix[0, 0] + matrix[1, 1] + matrix[2, 2]
    i = 0 if matrix[0, 0] >= matrix[1, 1] and matrix[0, 0] >= matrix[2, 2] else 1 if matrix[1, 1] >= matrix[2, 2] else 2
    j, k = (i + 1) % 3, (i + 2) % 3
    if trace >= matrix[i, i]:
        twice = math.sqrt(1.0 + trace)
        for axis in range(3):
            before, behind = (axis + 1) % 3, (axis + 2) % 3
            out[axis] = (matrix[behind, before] - matrix[before, behind]) / (2.0 * twice)
        out[3] = twice / 2.0
    else:
        twice = math.sqrt(1.0 + matrix[i, i] - matrix[j, j] - matrix[k, k])
        out[i] = twice / 2.0
        out[j] = (matrix[j, i] + matrix[i, j]) / (2.0 * twice)
        out[k] = (matrix[k, i] + matrix[i, k]) / (2.0 * twice)
        out[3] = (matrix[k, j] - matrix[j, k]) / (2.0 * twice)


@njit(error_model="numpy")
def quaternions_of(matrices: NDArray) -> NDArray:
    """Return the (N, 4) quaternions of rotation matrices, (N, 3, 3)."""
    out = np.empty((len(matrices), 4))
    for n in range(len(matrices)):
        write_quaternion(out[n], matrices[n])
    return out


@njit(error_model="numpy")
def rotations_of(vectors: NDArray) -> NDArray:
    """Return the (N, 3, 3) matrices of rotation vectors, (N, 3) rad (Rodrigues)."""
    out = np.empty((len(vectors), 3, 3))
    for n in range(len(vectors)):
        write_rotation(out[n], vectors[n, 0], vectors[n, 1], vectors[n, 2])
    return out


@register_jitable
def write_rotation(out: NDArray, x: float, y: float, z: float) -> None:
    """Write the matrix, (3, 3), of a rotation vector, rad (Rodrigues)."""
    angle = math.sqrt(x * x + y * y + z * z)
    sine = math.sin(angle) / angle if angle > 1e-12 else 1.0
    versine = 2.0 * (math.sin(angle / 2) / angle) ** 2 if angle > 1e-12 else 0.5
    out[0, 0], out[1, 1], out[2, 2] = (
        1 - versine * (y * y + z * z),
        1 - versine * (x * x + z * z),
        1 - versine * (x * x + y * y),
    )
    out[0, 1], out[1, 0] = versine * x * y - sine * z, versine * x * y + sine * z
    out[0, 2], out[2, 0] = versine * x * z + sine * y, versine * x * z - sine * y
    out[1, 2], out[2, 1] = versine * y * z - sine * x, versine * y * z + sine * x


def norms(vectors: NDArray) -> NDArray:
    """Return (...) the lengths of vectors (..., K), several times as fast as numpy's norm where K is small."""
    return np.asarray(np.sqrt(np.einsum("...i,...i->...", vectors, vectors)))
