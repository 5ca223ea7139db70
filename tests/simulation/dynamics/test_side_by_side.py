"""Vehicles side by side against each of them alone, to the last bit."""

from pathlib import Path

import numpy as np
import pytest

from cfplan.flight.firmware import gains_for
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.dynamics.body import FULL_EFFICIENCY, STILL_AIR, pack_body
from cfplan.simulation.dynamics.branching import SNAPSHOT_SIZE, THRUSTS, step_control, step_vehicle
from cfplan.simulation.dynamics.mellinger import FULL_STATE, SETPOINT_SIZE, level_out
from cfplan.simulation.dynamics.side_by_side import (
    WIDTH,
    level_out_all,
    move,
    new_panel,
    read_snapshot,
    step_controls,
    step_vehicles,
    stop_motors,
    unpacked_body,
    unpacked_gains,
    write_setpoint,
    write_snapshot,
)

PERIOD = 0.004  # s
LEVELS, STOPS, END = 30, 60, 110  # steps


@pytest.fixture(scope="module")
def airframe():
    return load_limits(Path(__file__).parents[3] / "safety.yaml").airframe


@pytest.fixture(scope="module")
def drawn(airframe):
    """Vehicles in the air at any attitude and speed, some about the floor; and setpoints near to them."""
    random = np.random.default_rng(7)
    snapshots, setpoints = np.zeros((WIDTH, SNAPSHOT_SIZE)), np.zeros((WIDTH, SETPOINT_SIZE))
    snapshots[:, 0:3] = random.normal((0.0, 0.0, 1.0), 1.0, (WIDTH, 3))
    snapshots[::5, 2] = random.normal(0.0, 0.02, len(snapshots[::5]))
    snapshots[:, 3:6] = random.normal(0.0, 1.0, (WIDTH, 3))
    attitude = random.normal((0.0, 0.0, 0.0, 1.0), 0.3, (WIDTH, 4))
    snapshots[:, 6:10] = attitude / np.linalg.norm(attitude, axis=1)[:, None]
    snapshots[:, 10:13] = random.normal(0.0, 3.0, (WIDTH, 3))
    snapshots[::7, 10:13] = 0.0
    snapshots[:, 13:17] = random.uniform(0.0, airframe.motor_thrust_max, (WIDTH, 4))
    snapshots[:, 17:THRUSTS] = random.normal(0.0, 0.1, (WIDTH, THRUSTS - 17))
    setpoints[:, 0:9] = random.normal(0.0, 0.5, (WIDTH, 9))
    setpoints[:, 0:3] += snapshots[:, 0:3]
    setpoints[:, 9:13], setpoints[:, 13:16] = snapshots[:, 6:10], random.normal(0.0, 1.0, (WIDTH, 3))
    setpoints[::6, 2] -= 3.0  # these are asked to sink so fast that they get no thrust
    return snapshots, setpoints


def alone(snapshot, setpoint, gains, body):
    now, setpoint, mode, control, motors = snapshot.copy(), setpoint.copy(), FULL_STATE.copy(), np.zeros(4), np.zeros(4)
    for step in range(END):
        if step == LEVELS:
            level_out(setpoint, mode)
        if step < STOPS:
            step_control(now, now, gains, setpoint, mode, body, PERIOD, control, motors)
        else:
            now[THRUSTS:] = 0.0
        step_vehicle(now, body, STILL_AIR, FULL_EFFICIENCY)
    return now


@pytest.mark.parametrize("count", [1, 2, 3, 8, 13, WIDTH])
@pytest.mark.parametrize("floor", [0.0, -np.inf])
def test_each_vehicle_flies_as_it_does_alone(count, floor, drawn, airframe):
    snapshots, setpoints = drawn
    gains, body = gains_for(airframe).pack(), pack_body(airframe, floor=floor, step=PERIOD)
    panel, spare, ended = new_panel(), np.empty((WIDTH, SNAPSHOT_SIZE)), np.empty((count, SNAPSHOT_SIZE))
    for n in range(count):
        write_snapshot(panel, n, snapshots[n])
        write_setpoint(panel, n, setpoints[n])
    for step in range(END):
        if step == LEVELS:
            level_out_all(panel, count)
        if step < STOPS:
            step_controls(panel, count, unpacked_gains(gains), unpacked_body(body), step >= LEVELS, PERIOD)
        else:
            stop_motors(panel, count)
        step_vehicles(panel, count, unpacked_body(body), body, spare)
    for n in range(count):
        read_snapshot(ended[n], panel, n)
    expected = np.array([alone(snapshots[n], setpoints[n], gains, body) for n in range(count)])
    np.testing.assert_array_equal(ended, expected)
    if count == WIDTH:
        assert np.isfinite(ended).all()
        assert (np.count_nonzero(ended[:, 2] == 0.0) > 3) == (floor == 0.0)


def test_a_vehicle_that_is_moved_flies_on_from_there(drawn, airframe):
    snapshots, setpoints = drawn
    gains, body = gains_for(airframe).pack(), pack_body(airframe, step=PERIOD)
    panel, spare, ended = new_panel(), np.empty((WIDTH, SNAPSHOT_SIZE)), np.empty((2, SNAPSHOT_SIZE))
    for place, n in enumerate((1, 2, 3)):
        write_snapshot(panel, place, snapshots[n])
        write_setpoint(panel, place, setpoints[n])
    for lanes in (3, 2):
        for _ in range(10):
            step_controls(panel, lanes, unpacked_gains(gains), unpacked_body(body), False, PERIOD)
            step_vehicles(panel, lanes, unpacked_body(body), body, spare)
        if lanes == 3:
            move(panel, 0, 2)
    for place in range(2):
        read_snapshot(ended[place], panel, place)
    for n, found in ((3, ended[0]), (2, ended[1])):
        now, control, motors = snapshots[n].copy(), np.zeros(4), np.zeros(4)
        for _ in range(20):
            step_control(now, now, gains, setpoints[n], FULL_STATE, body, PERIOD, control, motors)
            step_vehicle(now, body, STILL_AIR, FULL_EFFICIENCY)
        np.testing.assert_array_equal(found, now)
