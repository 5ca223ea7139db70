"""The full state against numerical differentiation, Newton's law and RotorPy."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cfplan.errors import NotCertifiedError
from cfplan.geometry.min_snap import min_snap
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.airframes import AIRFRAMES
from cfplan.vehicle.flatness import flat_state
from cfplan.vehicle.trajectory import Trajectory

WAYPOINTS = [[0, 0, 1], [1.5, 1, 1.4], [1, -1.5, 0.6], [-1, 0.5, 1.2]]


@pytest.fixture(scope="module", params=["crazyflie-2.0", "crazyflie-2.1+", "crazyflie-2.1-brushless"])
def trajectory(request, make_profile):
    path, random = min_snap(WAYPOINTS), np.random.default_rng(3)
    profile = make_profile(path.end, random.uniform(0.8, 1.6, 40), random.uniform(-0.3, 0.3, 39).cumsum())
    return Trajectory(path, profile, AIRFRAMES[request.param])


@pytest.fixture(scope="module")
def inner_times(trajectory):
    """Times that are not near a grid point, where derivatives of higher order jump."""
    grid = trajectory.time_at(trajectory.profile.s)
    return grid[:-1] + np.diff(grid) * np.random.default_rng(4).uniform(0.2, 0.8, len(grid) - 1)


def difference(trajectory, name, times, step=1e-4):
    """Fourth-order central difference of a vector of the state."""
    values = [getattr(trajectory.at(times + k * step), name) for k in (-2, -1, 1, 2)]
    return (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * step)


@pytest.mark.parametrize(
    ("name", "derivative"),
    [
        ("position", "velocity"),
        ("velocity", "acceleration"),
        ("acceleration", "jerk"),
        ("jerk", "snap"),
        ("body_rate", "angular_acceleration"),
    ],
)
def test_each_quantity_is_the_derivative_of_the_one_before(trajectory, inner_times, name, derivative):
    expected = getattr(trajectory.at(inner_times), derivative)
    scale = 1 + np.abs(expected).max()
    np.testing.assert_allclose(difference(trajectory, name, inner_times), expected, atol=1e-7 * scale)


def test_body_rates_turn_the_quaternion(trajectory, inner_times):
    step = 1e-4
    before, after = (Rotation.from_quat(trajectory.at(inner_times + k * step).quaternion) for k in (-1, 1))
    turned = (before.inv() * after).as_rotvec() / (2 * step)
    np.testing.assert_allclose(turned, trajectory.at(inner_times).body_rate, atol=1e-5)


def test_thrust_weight_and_rotor_drag_accelerate_the_mass(trajectory, inner_times):
    state, airframe = trajectory.at(inner_times), trajectory.airframe
    attitude = Rotation.from_quat(state.quaternion)
    drag = np.array([airframe.drag[0], airframe.drag[0], airframe.drag[1]])
    force = attitude.apply(np.array([0, 0, 1.0])) * (airframe.mass * state.specific_thrust)[:, None]
    force -= attitude.apply(drag * attitude.inv().apply(state.velocity))
    force += np.array([0, 0, -GRAVITY * airframe.mass])
    np.testing.assert_allclose(force / airframe.mass, state.acceleration, atol=1e-12)


@pytest.mark.parametrize("moment", [(0.0, 0.0), (4.5e-4, 6.2e-4)], ids=["still air", "air that turns it"])
def test_motor_thrusts_give_the_thrust_and_the_torque_of_eulers_equation(trajectory, inner_times, moment):
    """Less the moment of the air, in proportion to the velocity along the body's axes."""
    airframe = replace(trajectory.airframe, velocity_moment=moment)
    state = Trajectory(trajectory.path, trajectory.profile, airframe).at(inner_times)
    inertia = np.array(airframe.inertia)
    torque = inertia * state.angular_acceleration + np.cross(state.body_rate, inertia * state.body_rate)
    along = Rotation.from_quat(state.quaternion).apply(state.velocity, inverse=True)
    air = np.column_stack([moment[0] * along[:, 1], -moment[1] * along[:, 0], np.zeros(len(along))])
    wrench = np.column_stack([airframe.mass * state.specific_thrust, torque - air])
    np.testing.assert_allclose(state.motor_thrust @ airframe.mixing.T, wrench, atol=1e-15)


def test_compiled_and_interpreted_flatness_agree(trajectory, inner_times):
    state = trajectory.at(inner_times)
    sample = trajectory.profile.at(state.s)
    derivatives = tuple(tuple(trajectory.path(state.s, order).T) for order in (1, 2, 3, 4))
    flat = flat_state(trajectory.airframe, derivatives, sample[:4], sample[4:], np.cos, np.sin)
    for name in ("velocity", "snap", "thrust_axis", "body_rate", "angular_acceleration", "torque", "motor_thrust"):
        expected = np.stack(getattr(flat, name), axis=-1)
        np.testing.assert_allclose(getattr(state, name), expected, atol=1e-12 * (1 + np.abs(expected).max()))
    np.testing.assert_allclose(state.specific_thrust, flat.specific_thrust, rtol=1e-13)
    np.testing.assert_array_equal(state.yaw, sample.yaw)


def test_rotorpy_moves_the_same_under_the_same_motor_thrusts(make_profile):
    from rotorpy.vehicles.crazyflie_params import quad_params
    from rotorpy.vehicles.multirotor import Multirotor

    path, random = min_snap(WAYPOINTS), np.random.default_rng(5)
    airframe = replace(AIRFRAMES["crazyflie-2.0"], drag=(0.0, 0.0))
    profile = make_profile(path.end, random.uniform(2.0, 3.0, 40), random.uniform(-0.3, 0.3, 39).cumsum())
    trajectory = Trajectory(path, profile, airframe)
    vehicle = Multirotor({**quad_params, "k_d": 0.0, "k_z": 0.0}, aero=False)
    state = trajectory.at(np.linspace(0.1, trajectory.duration - 0.1, 25))
    order = [3, 0, 1, 2]  # RotorPy's rotors: front left, front right, back right, back left
    for n in range(len(state.time)):
        # Rotors turn one way only, so that the sign goes with the square.
        thrusts = state.motor_thrust[n, order]
        assert np.all(thrusts > 0)
        speeds = np.sqrt(thrusts / quad_params["k_eta"])
        now = {
            "x": state.position[n], "v": state.velocity[n], "q": state.quaternion[n], "w": state.body_rate[n],
            "wind": np.zeros(3), "rotor_speeds": speeds,
        }  # fmt: skip
        moved = vehicle.statedot(now, {"cmd_motor_speeds": speeds}, 0.0)
        np.testing.assert_allclose(moved["vdot"], state.acceleration[n], atol=1e-9)
        np.testing.assert_allclose(moved["wdot"], state.angular_acceleration[n], atol=1e-6)


def test_before_the_start_and_after_the_end_it_hovers_there(trajectory):
    for time, s in ((-0.5, 0.0), (trajectory.duration + 1e-6, trajectory.path.end), (1e6, trajectory.path.end)):
        state = trajectory.at(time)
        np.testing.assert_allclose(state.position, trajectory.path(s), atol=1e-12)
        for name in ("velocity", "acceleration", "jerk", "snap", "body_rate", "angular_acceleration", "torque"):
            np.testing.assert_array_equal(getattr(state, name), np.zeros(3))
        np.testing.assert_allclose(state.motor_thrust, trajectory.airframe.hover_thrust)
        np.testing.assert_array_equal(state.quaternion[:2], [0.0, 0.0])
        assert 2 * np.arctan2(state.quaternion[2], state.quaternion[3]) == pytest.approx(state.yaw)


def test_at_a_rest_end_it_stands_level(trajectory):
    for time in (0.0, trajectory.duration):
        state = trajectory.at(time)
        for name in ("velocity", "acceleration", "jerk", "body_rate"):
            np.testing.assert_allclose(getattr(state, name)[:2], 0.0, atol=1e-9)
        np.testing.assert_allclose(state.thrust_axis, [0, 0, 1], atol=1e-12)


def test_a_scalar_time_gives_the_same_state_without_the_leading_axis(trajectory):
    one, many = trajectory.at(0.7), trajectory.at(np.array([0.7]))
    assert one.position.shape == (3,)
    assert one.yaw.shape == ()
    np.testing.assert_array_equal(one.motor_thrust, many.motor_thrust[0])


def test_the_quaternion_is_continuous(trajectory):
    quaternion = trajectory.at(np.linspace(0, trajectory.duration, 5000)).quaternion
    assert np.abs(np.diff(quaternion, axis=0)).max() < 0.1
    np.testing.assert_allclose(np.linalg.norm(quaternion, axis=1), 1.0, atol=1e-12)


def test_a_profile_of_another_path_is_refused(make_profile):
    with pytest.raises(NotCertifiedError, match="goes from s = 0 to 3"):
        Trajectory(min_snap(WAYPOINTS), make_profile(3.0, np.ones(20)), AIRFRAMES["crazyflie-2.1+"])


def test_times_may_come_in_any_order(trajectory):
    times = np.random.default_rng(6).uniform(-0.5, trajectory.duration + 0.5, 300)
    order = np.argsort(times)
    found, ordered = trajectory.at(times), trajectory.at(times[order])
    for name in ("position", "body_rate", "motor_thrust"):
        np.testing.assert_allclose(getattr(found, name)[order], getattr(ordered, name), rtol=1e-12, atol=1e-12)
