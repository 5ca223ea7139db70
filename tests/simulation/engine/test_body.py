"""The rigid body against limit cases, conservation and RotorPy."""

import numpy as np
import pytest
from numpy.typing import NDArray
from one_body import stepped as fly
from rotorpy.vehicles.multirotor import Multirotor
from scipy.spatial.transform import Rotation

from cfplan.simulation.engine.body import TIME_STEP
from cfplan.simulation.engine.layout import (
    BODY_RATE,
    MOTORS,
    POSITION,
    QUATERNION,
    VELOCITY,
    at_rest,
    hovering,
    pack_airframe,
)
from cfplan.vehicle.airframe import GRAVITY, MOTOR_TORQUE_SIGNS, Airframe
from cfplan.vehicle.rotations import matrix_of

NO_FLOOR = -np.inf


def airframe(**changes) -> Airframe:
    values = {
        "name": "test", "mass": 0.032, "inertia": (17e-6, 19e-6, 30e-6), "arm": 0.0325, "thrust_to_torque": 0.007,
        "motor_thrust_min": 0.0, "motor_thrust_max": 0.15, "motor_time_constant": 0.1, "drag": (0.0, 0.0), "source": "",
    }  # fmt: skip
    return Airframe(**(values | changes))


def test_it_falls_freely_without_thrust():
    state = fly(at_rest([1.0, 2.0, 0.0]), np.zeros(4), pack_airframe(airframe(), floor=NO_FLOOR), 1.0)
    assert state[VELOCITY] == pytest.approx([0.0, 0.0, -GRAVITY])
    assert state[POSITION] == pytest.approx([1.0, 2.0, -GRAVITY / 2], abs=GRAVITY * TIME_STEP)
    assert state[QUATERNION] == pytest.approx([0, 0, 0, 1])


def test_hover_thrust_holds_it_where_it_is():
    start = hovering(airframe(), [0.0, 1.0, 2.0], yaw=0.7)
    state = fly(start, np.full(4, airframe().hover_thrust), pack_airframe(airframe()), 5.0)
    assert state == pytest.approx(start, abs=1e-12)


def test_a_thrust_scale_is_made_up_for_by_the_command():
    frame = airframe(thrust_scale=1.25)
    start = hovering(frame, [0.0, 0.0, 2.0])
    state = fly(start, np.full(4, frame.hover_thrust / 1.25), pack_airframe(frame), 5.0)
    assert state == pytest.approx(start, abs=1e-12)


def test_a_thrust_that_curves_gives_hover_and_rises_more_slowly():
    frame = airframe(thrust_scale=1.5, thrust_curvature=1 / 3, motor_time_constant=0.0)
    hover = frame.hover_thrust / 1.5

    def given(asked):
        return fly(hovering(frame, [0.0, 0.0, 2.0]), np.full(4, asked), pack_airframe(frame), TIME_STEP)[13]

    assert given(hover) == pytest.approx(frame.hover_thrust)
    assert (given(1.01 * hover) - given(0.99 * hover)) / (0.02 * hover) == pytest.approx(1.0)  # 1.5 (1 - 1/3)
    assert given(0.0) == 0.0
    assert given(2.2 * hover) == pytest.approx(4 / 3 * frame.hover_thrust)  # its top


@pytest.mark.parametrize("yaw", [0.0, 1.1])
def test_air_tilts_a_vehicle_against_its_motion(yaw):
    frame = airframe(velocity_moment=(4.7e-4, 6.5e-4))
    start, heading = hovering(frame, [0.0, 0.0, 2.0], yaw=yaw), matrix_of(hovering(frame, np.zeros(3), yaw)[QUATERNION])
    start[VELOCITY] = heading @ [2.0, 0.5, 0.3]
    state = fly(start, np.full(4, frame.hover_thrust), pack_airframe(frame), TIME_STEP)
    torque = np.array(frame.inertia) * state[BODY_RATE] / TIME_STEP
    assert torque == pytest.approx([4.7e-4 * 0.5, -6.5e-4 * 2.0, 0.0], abs=1e-15)  # left side up, nose up
    still = fly(start, np.full(4, frame.hover_thrust), pack_airframe(frame), TIME_STEP, wind=heading @ [2.0, 0.5, 0.3])
    assert still[BODY_RATE] == pytest.approx(np.zeros(3), abs=1e-12)


def test_speed_in_the_rotor_plane_lifts():
    frame = airframe(lift_with_speed=0.008)
    start = hovering(frame, [0.0, 0.0, 2.0])
    for velocity, gained in (([1.5, 2.0, 0.0], 0.008 * 6.25), ([0.0, 0.0, 2.0], 0.0)):
        start[VELOCITY] = velocity
        state = fly(start, np.full(4, frame.hover_thrust), pack_airframe(frame), TIME_STEP)
        risen = (state[VELOCITY] - start[VELOCITY])[2] / TIME_STEP
        assert risen == pytest.approx(gained * GRAVITY, abs=1e-9)


@pytest.mark.parametrize(("upright", "coefficient"), [(True, 0.02), (False, 0.05)])
def test_a_fall_ends_at_the_speed_at_which_drag_carries_the_weight(upright, coefficient):
    frame = airframe(drag=(0.05, 0.02))
    start = at_rest([0, 0, 0])
    if not upright:
        start[QUATERNION] = Rotation.from_euler("y", 90, degrees=True).as_quat()
    state = fly(start, np.zeros(4), pack_airframe(frame, floor=NO_FLOOR), 30.0)
    assert state[5] == pytest.approx(-frame.mass * GRAVITY / coefficient, rel=1e-6)


def test_wind_carries_it_along():
    frame = airframe(drag=(0.05, 0.05))
    start = hovering(frame, [0, 0, 0])
    command = np.full(4, frame.hover_thrust)
    state = fly(start, command, pack_airframe(frame, floor=NO_FLOOR), 20.0, wind=[2.0, -1.0, 0.0])
    assert state[VELOCITY] == pytest.approx([2.0, -1.0, 0.0], abs=1e-6)


def test_torque_free_tumbling_keeps_angular_momentum_and_energy():
    inertia = np.array(airframe().inertia)
    start = at_rest([0, 0, 0])
    start[BODY_RATE] = 3.0, 2.0, -4.0
    end = fly(start, np.zeros(4), pack_airframe(airframe(), floor=NO_FLOOR), 2.0)
    momenta = [Rotation.from_quat(s[QUATERNION]).apply(inertia * s[BODY_RATE]) for s in (start, end)]
    energies = [np.sum(inertia * s[BODY_RATE] ** 2) / 2 for s in (start, end)]
    assert np.linalg.norm(end[BODY_RATE] - start[BODY_RATE]) > 1.0
    assert momenta[1] == pytest.approx(momenta[0], rel=5e-3)
    assert energies[1] == pytest.approx(energies[0], rel=5e-3)


def test_motor_thrust_follows_a_step_with_the_time_constant():
    state = fly(at_rest([0, 0, 5]), np.full(4, 0.1), pack_airframe(airframe()), 0.1)
    assert state[MOTORS] == pytest.approx(0.1 * (1 - np.exp(-1.0)), rel=5e-3)


def test_motors_without_lag_give_at_once_what_they_can_and_no_more():
    body = pack_airframe(airframe(motor_time_constant=0.0))
    assert fly(at_rest([0, 0, 5]), [-1.0, 0.05, 0.15, 9.0], body, 0.001)[MOTORS] == pytest.approx([0, 0.05, 0.15, 0.15])


def test_rotors_that_speed_up_turn_the_body_the_other_way_round():
    """Angular momentum about z: what the rotors gain the body loses."""
    inertia_over_slope = 4e-4
    frame = airframe(thrust_to_torque=0.0, rotor_reaction=inertia_over_slope, arm=0.0)
    thrusts = np.array([0.02, 0.10, 0.03, 0.09])
    state = fly(at_rest([0, 0, 0]), thrusts, pack_airframe(frame, floor=NO_FLOOR), 0.07)
    gained = inertia_over_slope * MOTOR_TORQUE_SIGNS[2] @ state[MOTORS]
    assert state[12] == pytest.approx(gained / frame.inertia[2])


@pytest.mark.parametrize("motor", range(4))
def test_a_weak_motor_lets_its_corner_sink(motor):
    frame = airframe()
    efficiency = np.ones(4)
    efficiency[motor] = 0.5
    start = hovering(frame, [0, 0, 5])
    state = fly(start, np.full(4, frame.hover_thrust), pack_airframe(frame), 0.02, efficiency=efficiency)
    corner = np.array([[1, -1, 0], [-1, -1, 0], [-1, 1, 0], [1, 1, 0]])[motor]  # as motors are numbered, x forward
    corners = Rotation.from_quat(state[QUATERNION]).apply(np.array([corner, -corner]))
    assert corners[0, 2] < 0 < corners[1, 2]
    lost = -MOTOR_TORQUE_SIGNS[:, motor]
    assert np.sign(state[BODY_RATE]) == pytest.approx(lost)


def test_it_rests_on_the_floor_until_the_rotors_lift_it():
    frame = airframe()
    body = pack_airframe(frame)
    start = at_rest([0.5, 0.5, 0.0], yaw=0.4)
    assert fly(start, np.full(4, 0.9 * frame.hover_thrust), body, 2.0)[POSITION] == pytest.approx([0.5, 0.5, 0.0])
    assert fly(start, np.full(4, 1.1 * frame.hover_thrust), body, 2.0)[2] > 0.1


def dropped(euler: list[float], seconds: float = 1.0) -> tuple[NDArray, Rotation]:
    """Return how a body lies that fell onto the floor so turned (ZYX, degrees), and the turn that its gyros felt."""
    body = pack_airframe(airframe())
    state = at_rest([0, 0, 0.1])
    state[QUATERNION] = Rotation.from_euler("ZYX", euler, degrees=True).as_quat()
    state[VELOCITY] = 1.0, 0.0, 0.0
    felt = Rotation.from_quat(state[QUATERNION])
    for _ in range(round(seconds / TIME_STEP)):
        state = fly(state, np.zeros(4), body, TIME_STEP)
        felt *= Rotation.from_rotvec(TIME_STEP * state[BODY_RATE])
    return state, felt


@pytest.mark.parametrize("euler", [[50, 20, 10], [-120, 0, 70], [0, -74, 0], [10, 0, 0.01]])
def test_a_tilted_fall_ends_still_and_level_on_the_floor(euler):
    state, felt = dropped(euler)
    assert state[2] == 0.0
    assert state[VELOCITY] == pytest.approx(0.0)
    assert state[BODY_RATE] == pytest.approx(0.0)
    _, pitch, roll = Rotation.from_quat(state[QUATERNION]).as_euler("ZYX", degrees=True)
    assert (pitch, roll) == pytest.approx((0, 0), abs=1e-9)
    assert (felt.inv() * Rotation.from_quat(state[QUATERNION])).magnitude() < 1e-6


@pytest.mark.parametrize("euler", [[50, 80, 0], [0, 0, 120], [-20, 10, 180], [0, -100, 0]])
def test_a_body_that_falls_on_its_side_or_back_stays_on_its_back(euler):
    state, felt = dropped(euler)
    assert state[2] == 0.0
    up = Rotation.from_quat(state[QUATERNION]).apply([0, 0, 1])
    assert up == pytest.approx([0, 0, -1], abs=1e-6)
    assert (felt.inv() * Rotation.from_quat(state[QUATERNION])).magnitude() < 1e-6
    still = fly(state, np.full(4, airframe().motor_thrust_max), pack_airframe(airframe()), 1.0)
    assert still[: MOTORS.start] == pytest.approx(state[: MOTORS.start])  # its rotors press it down


def test_the_rotation_matrix_is_that_of_scipy():
    for quaternion in Rotation.random(20, rng=1).as_quat():
        assert matrix_of(quaternion) == pytest.approx(Rotation.from_quat(quaternion).as_matrix())


def rotorpy_vehicle(frame: Airframe, hover_speed: float, *, aero: bool) -> tuple[Multirotor, float]:
    """RotorPy's vehicle with our numbers, and its thrust coefficient."""
    k_eta = 2.3e-8
    jx, jy, jz = frame.inertia
    arm = frame.arm
    parameters = {
        "mass": frame.mass, "Ixx": jx, "Iyy": jy, "Izz": jz, "Ixy": 0.0, "Ixz": 0.0, "Iyz": 0.0, "num_rotors": 4,
        "rotor_pos": {
            "r1": np.array([arm, -arm, 0.0]), "r2": np.array([-arm, -arm, 0.0]),
            "r3": np.array([-arm, arm, 0.0]), "r4": np.array([arm, arm, 0.0]),
        },
        "rotor_directions": np.array([-1, 1, -1, 1]), "rotor_speed_min": 0.0, "rotor_speed_max": 4000.0,
        "k_eta": k_eta, "k_m": k_eta * frame.thrust_to_torque, "tau_m": 0.1,
        "k_d": frame.drag[0] / (4 * hover_speed), "k_z": frame.drag[1] / (4 * hover_speed),
    }  # fmt: skip
    vehicle = Multirotor(parameters, aero=aero, integrator_kwargs={"rtol": 1e-9, "atol": 1e-12})
    return vehicle, k_eta


@pytest.mark.parametrize(
    ("thrusts", "drag"),
    [((0.080, 0.083, 0.078, 0.081), (0.0, 0.0)), ((0.09, 0.09, 0.09, 0.09), (0.0135, 0.0168))],
    ids=["tumbling in vacuum", "sliding through air"],
)
def test_it_moves_as_rotorpy_says(thrusts, drag):
    frame = airframe(drag=drag)
    thrusts = np.array(thrusts)
    vehicle, k_eta = rotorpy_vehicle(frame, np.sqrt(thrusts[0] / 2.3e-8), aero=any(drag))
    start = at_rest([0.0, 0.0, 1.0])
    start[VELOCITY] = 2.0, -1.0, 0.5
    start[QUATERNION] = Rotation.from_euler("ZYX", [0.5, 0.3, -0.4]).as_quat()
    start[BODY_RATE] = (0.0, 0.0, 0.0) if any(drag) else (1.0, -2.0, 0.5)
    start[MOTORS] = thrusts
    speeds = np.sqrt(thrusts / k_eta)
    theirs = {
        "x": start[POSITION], "v": start[VELOCITY], "q": start[QUATERNION], "w": start[BODY_RATE],
        "wind": np.zeros(3), "rotor_speeds": speeds,
    }  # fmt: skip
    theirs = vehicle.step(theirs, {"cmd_motor_speeds": speeds}, 0.5)
    ours = fly(start, thrusts, pack_airframe(frame, floor=NO_FLOOR), 0.5)
    # First order in the time step: 1 ms of the change over half a second.
    assert ours[POSITION] == pytest.approx(theirs["x"], abs=0.005)
    assert ours[VELOCITY] == pytest.approx(theirs["v"], abs=0.02)
    assert ours[BODY_RATE] == pytest.approx(theirs["w"], abs=0.02)
    between = Rotation.from_quat(ours[QUATERNION]).inv() * Rotation.from_quat(theirs["q"])
    assert between.magnitude() < 0.01
