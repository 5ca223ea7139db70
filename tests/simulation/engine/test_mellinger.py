"""The controller against the firmware's own outputs, and in the modes that those do not reach."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cfplan.flight.firmware import MellingerGains
from cfplan.simulation.engine.layout import (
    BODY_RATE,
    MEMORY,
    MEMORY_SIZE,
    POSITION,
    QUATERNION,
    SETPOINT,
    SETPOINT_SIZE,
    VEHICLE_SIZE,
    VELOCITY,
    at_rest,
)
from cfplan.simulation.engine.mellinger import (
    ABSOLUTE,
    CONTROL_PERIOD,
    FULL_COMMAND,
    FULL_STATE,
    LEVEL_OUT,
    MODE_PITCH,
    MODE_ROLL,
    MODE_YAW,
    NOTHING,
    ON_BOARD,
    VELOCITY_MODE,
    level_out,
    mixed,
    step_mellinger,
)
from cfplan.vehicle.airframe import GRAVITY, MOTOR_TORQUE_SIGNS
from cfplan.vehicle.rotations import yaw_of

MASS = 0.0318
GAINS = MellingerGains(mass=MASS).pack()


def hover_setpoint(position, yaw=0.0):
    setpoint = np.zeros(SETPOINT_SIZE)
    setpoint[0:3] = position
    setpoint[9:13] = 0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)
    setpoint[18] = yaw
    return setpoint


def control_of(setpoint, mode, state, memory=None, gains=GAINS):
    """The control, (4,); `memory`, (10,), changes in place."""
    vehicle, memory = np.zeros(VEHICLE_SIZE), np.zeros(MEMORY_SIZE) if memory is None else memory
    vehicle[MEMORY : MEMORY + MEMORY_SIZE], vehicle[SETPOINT : SETPOINT + SETPOINT_SIZE] = memory, setpoint
    control = step_mellinger(vehicle, gains, mode, state, CONTROL_PERIOD)
    memory[:] = vehicle[MEMORY : MEMORY + MEMORY_SIZE]
    return np.array(control)


def motors_of(control):
    return np.array(mixed(tuple(float(each) for each in control)))


def test_control_and_motors_are_the_firmwares(firmware):
    recorded = firmware("mellinger")
    gains = MellingerGains(mass=float(recorded["mass"])).pack()
    for setpoints, states, controls, thrusts in zip(
        recorded["setpoint"], recorded["state"], recorded["control"], recorded["motor_thrust_N"], strict=True
    ):
        memory = np.zeros(MEMORY_SIZE)
        ours, our_thrusts = np.empty((300, 4)), np.empty((300, 4))
        for k in range(300):
            setpoint = np.append(setpoints[k].astype(float), np.zeros(4))
            ours[k] = control_of(setpoint, FULL_STATE, states[k].astype(float), memory, gains)
            our_thrusts[k] = motors_of(ours[k]) / FULL_COMMAND * 0.12
        assert np.all(np.abs(ours - controls) <= 1e-3 * np.ptp(controls, axis=0))
        assert np.all(np.abs(our_thrusts - thrusts) <= 1e-3 * np.ptp(thrusts, axis=0))


def test_at_the_setpoint_it_asks_for_the_weight_and_nothing_else():
    for mode in (FULL_STATE, ON_BOARD):
        control = control_of(hover_setpoint([1, 2, 3], yaw=0.5), mode, at_rest([1, 2, 3], yaw=0.5))
        assert control == pytest.approx([132000 * MASS * GRAVITY, 0, 0, 0], abs=1e-6)


def test_nothing_else_of_the_setpoints_quaternion_than_its_yaw_is_used():
    state = at_rest([0, 0, 1])
    level, tilted = hover_setpoint([0.2, 0.1, 1.1], yaw=0.6), hover_setpoint([0.2, 0.1, 1.1])
    tilted[9:13] = Rotation.from_euler("ZYX", [0.6, 0.4, -0.3]).as_quat()
    assert control_of(level, FULL_STATE, state) == pytest.approx(control_of(tilted, FULL_STATE, state))


def test_yaw_of_a_quaternion_is_the_first_euler_angle():
    for rotation in Rotation.random(20, rng=2):
        assert yaw_of(rotation.as_quat()) == pytest.approx(rotation.as_euler("ZYX")[0])


@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.5])
def test_the_acceleration_field_sets_the_attitude(yaw):
    """At the attitude that gives the asked thrust vector and yaw, the controller is content."""
    setpoint = hover_setpoint([0, 0, 1], yaw)
    setpoint[6:9] = 2.0, -3.0, 1.0
    force = setpoint[6:9] + np.array([0, 0, GRAVITY])
    z = force / np.linalg.norm(force)
    y = np.cross(z, [np.cos(yaw), np.sin(yaw), 0])
    y /= np.linalg.norm(y)
    state = at_rest([0, 0, 1])
    state[QUATERNION] = Rotation.from_matrix(np.column_stack([np.cross(y, z), y, z])).as_quat()
    control = control_of(setpoint, FULL_STATE, state)
    assert control == pytest.approx([132000 * MASS * np.linalg.norm(force), 0, 0, 0], abs=1e-6)


@pytest.mark.parametrize(
    ("part", "value", "axis"), [(POSITION, [0.1, 0, 0], 1), (POSITION, [0, 0.1, 0], 0), (VELOCITY, [0, 0.5, 0], 0)]
)
def test_it_tilts_back_towards_the_setpoint(part, value, axis):
    state = at_rest([0, 0, 0])
    state[part] = value
    torque = MOTOR_TORQUE_SIGNS @ motors_of(control_of(hover_setpoint([0, 0, 0]), FULL_STATE, state))
    # Too far forward: nose up, negative about y. Too far left: right side down, positive about x.
    assert np.sign(torque[axis]) == (1 if axis == 0 else -1)
    assert abs(torque[1 - axis]) < 1e-3 * abs(torque[axis])


@pytest.mark.parametrize("axis", range(3))
def test_it_brakes_a_turn(axis):
    state = at_rest([0, 0, 0])
    state[BODY_RATE][axis] = 0.2
    memory = np.zeros(MEMORY_SIZE)
    memory[6], memory[7] = state[10], -state[11]  # turning so for some time
    torque = MOTOR_TORQUE_SIGNS @ motors_of(control_of(hover_setpoint([0, 0, 0]), FULL_STATE, state, memory))
    assert torque[axis] < 0


def test_a_stop_setpoint_stops_the_motors_and_clears_the_integrals():
    memory = np.ones(MEMORY_SIZE)
    control = control_of(np.zeros(SETPOINT_SIZE), NOTHING, at_rest([0, 0, 1]), memory)
    assert motors_of(control) == pytest.approx(0.0)
    assert memory[:6] == pytest.approx(0.0)


def test_level_out_lets_go_of_place_and_keeps_height_and_heading():
    state = at_rest([1.0, 1.0, 1.0], yaw=0.8)
    setpoint, mode = hover_setpoint([0.0, 0.0, 1.2], yaw=0.0), np.array(FULL_STATE)
    setpoint[15] = 2.0
    level_out(setpoint, mode)
    assert tuple(mode) == LEVEL_OUT
    control = control_of(setpoint, mode, state)
    lift = MASS * GRAVITY + 1.25 * 0.2 + 0.05 * 0.2 * 0.002
    assert control == pytest.approx([132000 * lift, 0, 0, 0], abs=1e-6)


def test_a_manual_setpoint_sets_attitude_and_thrust():
    setpoint, mode = np.zeros(SETPOINT_SIZE), np.array(NOTHING)
    mode[[MODE_ROLL, MODE_PITCH]], mode[MODE_YAW] = ABSOLUTE, VELOCITY_MODE
    setpoint[16], setpoint[17], setpoint[19] = 0.2, 0.1, 30000.0  # right side down, nose up
    state = at_rest([0, 0, 1])
    torque = MOTOR_TORQUE_SIGNS @ motors_of(control_of(setpoint, mode, state))
    assert torque[0] > 0 > torque[1]
    state[QUATERNION] = Rotation.from_euler("ZYX", [0.0, -0.1, 0.2]).as_quat()
    assert control_of(setpoint, mode, state) == pytest.approx([30000, 0, 0, 0], abs=1e-6)


def test_a_vertical_mode_alone_is_hover_at_that_height():
    mode = np.array(NOTHING)
    mode[2] = ABSOLUTE
    control = control_of(hover_setpoint([5, 5, 1]), mode, at_rest([0, 0, 1]))
    assert control == pytest.approx([132000 * MASS * GRAVITY, 0, 0, 0], abs=1e-6)


def test_power_is_mixed_for_the_motors_places():
    assert motors_of([30000, 2000, 0, 0]) == pytest.approx([29000, 29000, 31000, 31000])
    assert motors_of([30000, 0, 2000, 0]) == pytest.approx([31000, 29000, 29000, 31000])
    assert motors_of([30000, 0, 0, 1000]) == pytest.approx([31000, 29000, 31000, 29000])


def test_too_much_power_lowers_all_motors_alike():
    assert motors_of([65000, 4000, 0, 0]) == pytest.approx([61535, 61535, 65535, 65535])
    assert motors_of([2000, 8000, 0, 0]) == pytest.approx([0, 0, 6000, 6000])
