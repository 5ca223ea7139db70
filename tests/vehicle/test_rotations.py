"""Rotations against scipy, by tuple, by array and compiled alike."""

import numpy as np
import pytest
from numba import njit
from scipy.spatial.transform import Rotation

from cfplan.vehicle import rotations

ATTITUDES = Rotation.random(50, random_state=np.random.default_rng(4))


@njit
def compiled_yaw(quaternion):
    return rotations.yaw_of(quaternion)


def test_yaw_pitch_and_roll_are_the_euler_angles():
    angles, quaternions = ATTITUDES.as_euler("ZYX"), ATTITUDES.as_quat()
    np.testing.assert_allclose(rotations.yaw_of(quaternions.T), angles[:, 0], atol=1e-12)
    np.testing.assert_allclose(np.stack(rotations.roll_pitch_of(quaternions.T)), angles[:, [2, 1]].T, atol=1e-12)
    for quaternion, (yaw, _, _) in zip(quaternions, angles, strict=True):
        assert rotations.yaw_of(tuple(quaternion)) == pytest.approx(yaw)
        assert compiled_yaw(quaternion) == pytest.approx(yaw)


def test_tilt_is_the_angle_of_the_thrust_axis_from_the_vertical():
    expected = np.arccos(ATTITUDES.apply([0.0, 0.0, 1.0])[:, 2])
    np.testing.assert_allclose(rotations.tilt_of(ATTITUDES.as_quat().T), expected, atol=1e-7)


def test_products_and_matrices_are_those_of_scipy():
    first, second = ATTITUDES[:25], ATTITUDES[25:]
    made = np.stack(rotations.product(first.as_quat().T, second.as_quat().T), axis=1)
    np.testing.assert_allclose(Rotation.from_quat(made).as_matrix(), (first * second).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(rotations.matrix_of(first[0].as_quat()), first[0].as_matrix(), atol=1e-12)
    np.testing.assert_allclose(rotations.about_z(0.7), Rotation.from_euler("Z", 0.7).as_quat(), atol=1e-15)


def test_the_hopf_quaternion_is_a_turn_by_yaw_then_the_least_turn_to_the_thrust_axis():
    yaw, axes = np.linspace(-3.0, 3.0, 50), ATTITUDES.apply([0.0, 0.0, 1.0])
    made = np.stack(rotations.hopf_quaternion(tuple(axes.T), np.cos(yaw / 2), np.sin(yaw / 2)), axis=1)
    normal = np.cross([0.0, 0.0, 1.0], axes)
    least = normal / np.linalg.norm(normal, axis=1)[:, None] * np.arccos(axes[:, 2])[:, None]
    expected = Rotation.from_rotvec(least) * Rotation.from_euler("Z", yaw[:, None])
    np.testing.assert_allclose(Rotation.from_quat(made).as_matrix(), expected.as_matrix(), atol=1e-9)


def test_matrices_of_quaternions_of_any_length_lead_back_to_them():
    quaternions = ATTITUDES.as_quat()
    matrices = rotations.matrices_of(3.0 * quaternions)
    np.testing.assert_allclose(matrices, ATTITUDES.as_matrix(), atol=1e-12)
    for matrix, quaternion in zip(matrices, quaternions, strict=True):
        found = np.empty(4)
        rotations.write_quaternion(found, matrix)
        np.testing.assert_allclose(found * np.sign(found @ quaternion), quaternion, atol=1e-12)


def test_a_turn_about_a_level_axis_and_products_of_matrices_are_those_of_scipy():
    rng = np.random.default_rng(5)
    for (x, y), first, second in zip(rng.uniform(-1.5, 1.5, (20, 2)), ATTITUDES, ATTITUDES[20:], strict=False):
        angle = np.hypot(x, y)
        turn = rotations.turn_rows(x, y, np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle**2)
        np.testing.assert_allclose(turn, Rotation.from_rotvec([x, y, 0.0]).as_matrix(), atol=1e-12)
        a, b = (tuple(map(tuple, each.as_matrix())) for each in (first, second))
        np.testing.assert_allclose(rotations.matrix_product(a, b), (first * second).as_matrix(), atol=1e-12)
        np.testing.assert_allclose(rotations.transposed_product(a, b), (first * second.inv()).as_matrix(), atol=1e-12)
