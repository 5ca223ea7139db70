"""Parameters that preflight knows take effect on the virtual Crazyflie, as they do in the firmware."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cfplan.simulation.engine.mellinger import ABSOLUTE, FULL_STATE, MODE_X, VELOCITY_MODE
from cfplan.simulation.virtual_crazyflie.catalogue import CAME_WITH, lacking
from cfplan.simulation.virtual_crazyflie.collision_avoidance import CollisionAvoidance
from cfplan.simulation.virtual_crazyflie.commander import Priority
from cfplan.simulation.virtual_crazyflie.log_blocks import log_toc
from cfplan.simulation.virtual_crazyflie.parameters import parameter_toc
from cfplan.simulation.virtual_crazyflie.setpoints import (
    ACCELERATION,
    BODY_RATE,
    POSITION,
    QUATERNION,
    VELOCITY,
    Setpoint,
)
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_crazyflie.supervisor import State
from tests.simulation.virtual_crazyflie.conftest import Rig

VECTORS = arrays(float, 3, elements=st.floats(-3.0, 3.0, width=32))
REACH = 0.5  # m: the default speed for the default horizon
SLACK = 1e-4


def full_state(position, velocity, acceleration=(1.0, 2.0, 3.0), body_rate=(0.1, 0.2, 0.3)):
    setpoint = Setpoint(mode=np.array(FULL_STATE))
    setpoint.values[POSITION], setpoint.values[VELOCITY] = position, velocity
    setpoint.values[ACCELERATION], setpoint.values[BODY_RATE] = acceleration, body_rate
    return setpoint


@given(here=VECTORS, position=VECTORS, velocity=VECTORS)
def test_collision_avoidance_keeps_place_and_speed_in_its_cell_and_leaves_feed_forward(here, position, velocity):
    asked = full_state(position, velocity)
    given = CollisionAvoidance(enable=True).rewrite(asked, here)
    assert np.all(np.abs(given.values[POSITION] - here) <= REACH + SLACK)
    assert np.all(np.abs(given.values[POSITION] + given.values[VELOCITY] - here) <= REACH + SLACK)
    for part in (ACCELERATION, BODY_RATE, QUATERNION):
        assert np.array_equal(given.values[part], asked.values[part])
    assert np.array_equal(given.mode, asked.mode)


@given(here=VECTORS, offset=VECTORS, velocity=VECTORS)
def test_what_stays_within_reach_for_its_horizon_is_not_touched(here, offset, velocity):
    offset, velocity = offset / 3.0 * 0.2, velocity / 3.0 * 0.25
    asked = full_state(here + offset, velocity)
    given = CollisionAvoidance(enable=True).rewrite(asked, here)
    assert given.values == pytest.approx(asked.values, abs=1e-9)


@given(here=VECTORS, position=VECTORS, velocity=VECTORS)
def test_switched_off_it_touches_nothing(here, position, velocity):
    asked = full_state(position, velocity)
    assert CollisionAvoidance().rewrite(asked, here) is asked


@given(velocity=VECTORS)
def test_a_velocity_is_cut_to_the_cell(velocity):
    asked = full_state(np.zeros(3), velocity)
    asked.mode[MODE_X] = VELOCITY_MODE
    given = CollisionAvoidance(enable=True).rewrite(asked, np.zeros(3))
    assert np.all(np.abs(given.values[VELOCITY]) <= REACH + SLACK)


def test_the_bounding_box_holds_the_place():
    box = CollisionAvoidance(enable=True, low=np.full(3, -0.1), high=np.full(3, 0.1))
    given = box.rewrite(full_state((0.4, 0.0, 0.0), (0.0, 0.0, 0.0)), np.zeros(3))
    assert np.all(np.abs(given.values[POSITION]) <= 0.1 + SLACK)
    assert given.mode[MODE_X] == ABSOLUTE


def test_a_vehicle_under_collision_avoidance_falls_behind_a_fast_stream(ready):
    assert lag_of(ready(colAv=1)) > 0.3
    assert lag_of(ready(colAv=0)) < 0.1


@pytest.fixture
def ready():
    def make(colAv):
        rig = Rig(VehicleSettings(stored={"colAv.enable": colAv}))
        rig.prepare()
        rig.take_off()
        rig.run(2.0)
        return rig

    return make


def lag_of(rig):
    """Return how far, m, the vehicle is behind after a second of setpoints that move away at 1.5 m/s."""
    start, begin = rig.belief[:3].copy(), rig.vehicle.tick
    worst = 0.0

    def send(tick):
        nonlocal worst
        time = (tick - begin) / 1000
        along = 1.5 * (time - (1 - np.exp(-3 * time)) / 3)
        place = start + np.array([along, 0.0, 0.0])
        worst = max(worst, float(np.abs(rig.truth[0] - place[0])))
        speed, pull = 1.5 * (1 - np.exp(-3 * time)), 4.5 * np.exp(-3 * time)
        setpoint = full_state(place, (speed, 0, 0), (pull, 0, 0), (0, 0, 0))
        rig.vehicle.firmware.commander.offer(setpoint, Priority.RADIO, tick)

    rig.run(1.0, send)
    return worst


def test_a_motor_test_turns_the_motors_of_an_armed_vehicle(rig):
    rig.set("motorPowerSet.m1", 9000)
    rig.set("motorPowerSet.m3", 7000)
    rig.set("motorPowerSet.enable", 1)
    rig.run(0.3)
    assert rig.vehicle.motors.tolist() == [9000, 0, 7000, 0]
    rig.set("motorPowerSet.enable", 2)
    rig.run(0.1)
    assert rig.vehicle.motors.tolist() == [9000] * 4
    rig.set("motorPowerSet.enable", 0)
    rig.run(0.1)
    assert not rig.vehicle.motors.any()


@pytest.mark.parametrize("locked", [False, True])
def test_a_motor_test_turns_the_motors_of_a_vehicle_that_is_disarmed_or_locked(locked):
    rig = Rig(VehicleSettings(auto_arming=False, stored={"motorPowerSet.enable": 1, "motorPowerSet.m1": 9000}))
    if locked:
        rig.vehicle.firmware.supervisor.emergency_stop()
    rig.run(1.0)
    assert rig.vehicle.firmware.supervisor.locked == locked
    assert not rig.vehicle.firmware.supervisor.armed
    assert rig.vehicle.motors.tolist() == [9000, 0, 0, 0]
    rig.set("motorPowerSet.enable", 0)
    rig.run(0.1)
    assert not rig.vehicle.motors.any()


@pytest.mark.parametrize(("auto_arming", "idle"), [(True, 0), (False, 5000)])
def test_idle_thrust_turns_motors_only_where_arming_is_asked_for(auto_arming, idle):
    rig = Rig(VehicleSettings(auto_arming=auto_arming, stored={"powerDist.idleThrust": 5000}))
    rig.run(0.2)
    rig.vehicle.firmware.supervisor.request_arming(True)
    rig.run(0.2)
    assert rig.vehicle.firmware.supervisor.state is State.READY_TO_FLY
    assert rig.vehicle.motors.tolist() == [idle] * 4
    rig.run(3.0)
    assert rig.vehicle.firmware.supervisor.state is State.READY_TO_FLY  # idle thrust is no flight


def test_stored_values_are_there_at_power_up_and_known_as_stored():
    rig = Rig(VehicleSettings(stored={"ctrlMel.kR_xy": 65000.0, "no.such": 1.0}))
    assert rig.vehicle.firmware.parameters["ctrlMel.kR_xy"] == 65000.0
    assert 65000.0 in rig.vehicle.firmware.stabilizer.loop.gains


def test_what_came_with_a_version_is_in_the_tables_of_the_newest():
    known = {entry.full_name for toc in (parameter_toc(), log_toc()) for entry in toc.variables}
    assert {name for names in CAME_WITH.values() for name in names} <= known
    assert lacking((2026, 8)) == frozenset()
    assert "supervisor.crashDetectGs" in lacking((2026, 4))
