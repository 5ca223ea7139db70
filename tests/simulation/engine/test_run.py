"""Vehicles in a batch against each of them alone, to the last bit; what a batch is reduced to."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cfplan.flight.firmware import gains_for
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.engine.body import step_body
from cfplan.simulation.engine.layout import (
    ASKED,
    SETPOINT,
    SETPOINT_SIZE,
    SNAPSHOT_SIZE,
    WIDTH,
    new_vehicle,
    pack_airframe,
)
from cfplan.simulation.engine.mellinger import FULL_STATE, LEVEL_OUT, mixed, step_mellinger, store_commands
from cfplan.simulation.engine.run import NEVER, PART, Schedule, Vehicles, simulate

STEP = 4  # ms
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
    snapshots[:, 17:ASKED] = random.normal(0.0, 0.1, (WIDTH, ASKED - 17))
    setpoints[:, 0:9] = random.normal(0.0, 0.5, (WIDTH, 9))
    setpoints[:, 0:3] += snapshots[:, 0:3]
    setpoints[:, 9:13], setpoints[:, 13:16] = snapshots[:, 6:10], random.normal(0.0, 1.0, (WIDTH, 3))
    setpoints[::6, 2] -= 3.0  # these are asked to sink so fast that they get no thrust
    return snapshots, setpoints


def batch_of(snapshots, airframes, **changes):
    number = np.arange(len(snapshots))
    batch = Vehicles(snapshots, airframes, number, number, np.full(len(number), NEVER), np.zeros((len(number), 3)))
    return batch._replace(**changes)


def schedule_of(setpoints, gains, **changes):
    arrivals = np.zeros(len(setpoints), dtype=np.int64)
    return Schedule(setpoints, arrivals, gains, steps=END + 1, step=STEP, control=STEP)._replace(**changes)


def alone(snapshot, setpoint, gains, airframe):
    """The snapshot at the end of the same, one step after another."""
    vehicle, mode = new_vehicle(snapshot[:17], airframe), FULL_STATE
    vehicle[:SNAPSHOT_SIZE], vehicle[SETPOINT : SETPOINT + SETPOINT_SIZE] = snapshot, setpoint
    for step in range(END):
        if step == LEVELS:
            vehicle[SETPOINT + 15], mode = 0.0, LEVEL_OUT
        if step < STOPS:
            control = step_mellinger(vehicle, gains, mode, vehicle[:13], 0.001 * STEP)
            store_commands(vehicle, 1, 0, mixed(control))
        else:
            vehicle[ASKED : ASKED + 4] = 0.0
        step_body(vehicle, 0.001 * STEP)
    return vehicle[:SNAPSHOT_SIZE]


@pytest.mark.parametrize("count", [1, 2, 3, 8, 13, WIDTH])
@pytest.mark.parametrize("floor", [0.0, -np.inf])
def test_each_vehicle_flies_as_it_does_alone(count, floor, drawn, airframe):
    """With motor lags of their own."""
    highest = np.argsort(-drawn[0][:, 2])[:count]  # first, so that not all have landed at the end
    snapshots, setpoints = (each[highest] for each in drawn)
    gains = gains_for(airframe).pack()
    drawn_airframes = np.stack([
        pack_airframe(replace(airframe, motor_time_constant=0.07 + 0.002 * n), floor=floor) for n in range(count)
    ])  # fmt: skip
    schedule = schedule_of(setpoints, gains, level_after=LEVELS * STEP, off_after=STOPS * STEP)
    ended = simulate(batch_of(snapshots, drawn_airframes), schedule, trace=True).trace[:, END]
    expected = np.array([alone(snapshots[n], setpoints[n], gains, drawn_airframes[n]) for n in range(count)])
    assert np.isfinite(ended).all()
    np.testing.assert_array_equal(ended, expected)
    if count == WIDTH:
        assert (np.count_nonzero(ended[:, 2] == 0.0) > 3) == (floor == 0.0)


def test_a_sweep_in_parts_is_the_whole_sweep(drawn, airframe):
    snapshots, setpoints = drawn
    batch = batch_of(snapshots, np.tile(pack_airframe(airframe), (WIDTH, 1)))
    spread = np.linspace(0.0, 0.2, END + 1)
    schedule = schedule_of(setpoints, gains_for(airframe).pack(), off_after=STOPS * STEP, spread=spread)
    whole, parts = (simulate(batch, schedule, parts=parts).boxes for parts in (1, 3))
    np.testing.assert_array_equal(parts[:, :, 0].min(axis=1), whole[:, 0, 0])
    np.testing.assert_array_equal(parts[:, :, 1].max(axis=1), whole[:, 0, 1])
    assert np.all(parts[:, 0, 1] - parts[:, 0, 0] <= 2 * np.interp(PART / STEP, np.arange(END + 1), spread) + 3.0)


def test_what_an_estimate_misses_without_poses_moves_the_vehicle_by_as_much(airframe):
    """The controller holds the estimate, so the vehicle goes where that is wrong, a little late."""
    hover = np.zeros((1, SNAPSHOT_SIZE))
    hover[0, 9], hover[0, 13:17], hover[0, ASKED:] = 1.0, airframe.hover_thrust, airframe.hover_thrust
    setpoint = np.zeros((1, SETPOINT_SIZE))
    setpoint[0, 12] = 1.0
    batch = batch_of(hover, pack_airframe(airframe, floor=-np.inf)[None], blind=np.array([[0.1, 0.0, 0.2]]))
    schedule = schedule_of(setpoint, gains_for(airframe).pack(), steps=500, step=2, control=2)
    blind = simulate(batch, schedule)
    assert blind.boxes[0, 0, 1] == pytest.approx([0.05, 0.0, 0.1], abs=0.02)
    seen = simulate(batch, schedule._replace(blind_until=0))
    assert seen.deviation[0] < 1e-5 < blind.deviation[0]
