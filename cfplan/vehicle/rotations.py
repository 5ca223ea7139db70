"""Rotations: quaternions x, y, z, w from body to world, their matrices, yaw and tilt, and the Hopf fibration.

One function body serves numpy and numba, as both index a quaternion by component: a tuple, an array (4,), or for N
attitudes an array (4, N), the transpose of the (N, 4) of trajectories and packets.

The Hopf fibration (Watterson and Kumar, "Control of quadrotors using the Hopf fibration on SO(3)", 2017) maps a
thrust axis and a yaw to an attitude: a turn by yaw about the vertical, then the smallest turn to the axis. Euler yaw
(ZYX), the result of `yaw_of`, differs from it slightly, and not at all without tilt.
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
Matrix = tuple[Vector, Vector, Vector]  # a rotation by its rows


@register_jitable(forceinline=True)
def heading_of(quaternion: Quaternion) -> tuple[Scalar, Scalar]:
    """Return the horizontal components x, y of the body's x axis: cosine and sine of yaw, times the cosine of pitch."""
    x, y, z, w = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    return 1.0 - 2.0 * (y * y + z * z), 2.0 * (w * z + x * y)


@register_jitable
def direction(x: float, y: float) -> tuple[float, float]:
    """Return cosine and sine of atan2(y, x)."""
    size = math.sqrt(x * x + y * y)
    return (x / size, y / size) if size > 0.0 else (1.0, 0.0)


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


@register_jitable(forceinline=True)
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
    _write_rows(out, matrix_rows(quaternion, scale))


@register_jitable(forceinline=True)
def matrix_rows(quaternion: Quaternion, scale: float) -> Matrix:
    """Return the matrix of a quaternion as scalars; `scale` is 2 over its squared length."""
    x, y, z, w = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    return (
        (1 - scale * (y * y + z * z), scale * (x * y - z * w), scale * (x * z + y * w)),
        (scale * (x * y + z * w), 1 - scale * (x * x + z * z), scale * (y * z - x * w)),
        (scale * (x * z - y * w), scale * (y * z + x * w), 1 - scale * (x * x + y * y)),
    )


@register_jitable
def _write_rows(out: NDArray, rows: Matrix) -> None:
    (out[0, 0], out[0, 1], out[0, 2]), (out[1, 0], out[1, 1], out[1, 2]), (out[2, 0], out[2, 1], out[2, 2]) = rows


@register_jitable
def write_quaternion(out: NDArray, matrix: NDArray) -> None:
    """Write the quaternion, (4,), of a rotation matrix, see quaternion_of()."""
    rows = (
        (matrix[0, 0], matrix[0, 1], matrix[0, 2]),
        (matrix[1, 0], matrix[1, 1], matrix[1, 2]),
        (matrix[2, 0], matrix[2, 1], matrix[2, 2]),
    )
    out[0], out[1], out[2], out[3] = quaternion_of(rows)


@register_jitable(forceinline=True)
def quaternion_of(matrix: Matrix) -> tuple[float, float, float, float]:
    """Return the quaternion of a rotation matrix, by way of its largest component (Shepperd 1978).

    There are no branches, so that a compiler can vectorise it.
    """
    (a, b, c), (d, e, f), (g, h, i) = matrix
    trace = a + e + i
    largest = 0 if (a >= e) & (a >= i) else 1 if e >= i else 2
    diagonal = a if largest == 0 else e if largest == 1 else i
    largest = 3 if trace >= diagonal else largest
    of_x, of_y, of_z = 1.0 + a - e - i, 1.0 + e - i - a, 1.0 + i - a - e
    twice = math.sqrt(1.0 + trace if largest == 3 else of_x if largest == 0 else of_y if largest == 1 else of_z)
    half, double = twice / 2.0, 2.0 * twice
    x = (h - f if largest == 3 else d + b if largest == 1 else g + c) / double
    y = (c - g if largest == 3 else d + b if largest == 0 else h + f) / double
    z = (d - b if largest == 3 else g + c if largest == 0 else h + f) / double
    w = (h - f if largest == 0 else c - g if largest == 1 else d - b) / double
    return (
        half if largest == 0 else x,
        half if largest == 1 else y,
        half if largest == 2 else z,
        half if largest == 3 else w,
    )


@register_jitable(forceinline=True)
def turn_rows(x: Scalar, y: Scalar, sine: Scalar, versine: Scalar) -> Matrix:
    """Return the matrix of a turn about (x, y, 0); `sine` is that of its angle over the length of (x, y, 0), and
    `versine` 1 less the cosine over the square of that."""
    xy = versine * x * y
    return (
        (1 - versine * (y * y), xy, sine * y),
        (xy, 1 - versine * (x * x), -sine * x),
        (-sine * y, sine * x, 1 - versine * (x * x + y * y)),
    )


@register_jitable(forceinline=True)
def matrix_product(first: Matrix, second: Matrix) -> Matrix:
    """Return the product of two matrices."""
    return transposed_product(first, transpose(second))


@register_jitable(forceinline=True)
def transposed_product(first: Matrix, second: Matrix) -> Matrix:
    """Return the product of a matrix and the transpose of another."""
    a, b, c = first
    p, q, r = second
    return (dot(a, p), dot(a, q), dot(a, r)), (dot(b, p), dot(b, q), dot(b, r)), (dot(c, p), dot(c, q), dot(c, r))


@register_jitable(forceinline=True)
def transpose(matrix: Matrix) -> Matrix:
    """Return the transpose: a rotation's inverse, and its columns."""
    (a, b, c), (d, e, f), (g, h, i) = matrix
    return (a, d, g), (b, e, h), (c, f, i)


@register_jitable(forceinline=True)
def dot(first: Vector, second: Vector) -> Scalar:
    """Return the inner product."""
    return first[0] * second[0] + first[1] * second[1] + first[2] * second[2]


@register_jitable(forceinline=True)
def cross(first: Vector, second: Vector) -> Vector:
    """Return the cross product."""
    (a, b, c), (p, q, r) = first, second
    return b * r - c * q, c * p - a * r, a * q - b * p


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
        _write_rotation(out[n], vectors[n, 0], vectors[n, 1], vectors[n, 2])
    return out


@register_jitable
def _write_rotation(out: NDArray, x: float, y: float, z: float) -> None:
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
    """Return (...) the lengths of vectors (..., K), several times faster than numpy's norm for small K."""
    return np.asarray(np.sqrt(np.einsum("...i,...i->...", vectors, vectors)))
