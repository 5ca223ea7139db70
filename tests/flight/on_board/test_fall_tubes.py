"""Tubes of vehicles that are lost while they fly on board, against falls integrated step by step."""

import itertools
import math
from pathlib import Path

import numpy as np
import pytest

from cfplan.flight.firmware import Timeouts, estimate_errors
from cfplan.flight.on_board.fall import fall_tubes
from cfplan.geometry.min_snap import min_snap
from cfplan.planning.plan import plan
from cfplan.safety.limits_file import load_limits

REPOSITORY = Path(__file__).parents[3]
GRAVITY, STEP, PART, DEVIATION, STOPS = 9.81, 0.001, 0.04, 0.05, (0.4, 0.6)
TIMES = np.arange(0.0, 2.6, 0.2)


@pytest.fixture(scope="module")
def safety():
    """The limits of the project's own safety.yaml."""
    return load_limits(REPOSITORY / "safety.yaml")


@pytest.fixture(scope="module")
def trajectory(safety):
    points = [[-1.5, -1.0, 0.8], [0.0, 0.6, 1.4], [1.5, -0.8, 0.9]]
    return plan(min_snap(np.array(points)), safety.airframe, safety, planner="expert").trajectory


@pytest.fixture(scope="module")
def tubes(trajectory, safety):
    return fall_tubes(trajectory, TIMES, safety, deviation=DEVIATION, part=PART, stops=STOPS)


def fall(trajectory, begin, cut, safety, chance):
    """The places, (N, 3) m every STEP, of a vehicle whose motors stop `cut` s after `begin`, by Euler's method.

    It leaves its trajectory by constant errors: of its tilt, which pushes it, of its velocity, and of its vertical
    acceleration.
    """
    tilt, slip = (error * chance.uniform() for error in estimate_errors(safety))
    aside, along = chance.uniform(0.0, 2.0 * np.pi, 2)
    lag = chance.uniform(0.01, max(*safety.link_loss.motor_lags))
    push = GRAVITY * np.tan(tilt) * np.array([np.cos(aside), np.sin(aside), 0.0])
    push[2] = chance.uniform(-1.0, 1.0) * safety.link_loss.vertical_acceleration_error
    drift = slip * np.array([np.cos(along), np.sin(along), 0.0])
    places, offset = [], np.zeros(3)
    for n in range(round(cut / STEP)):
        places.append(trajectory.at(begin + n * STEP).position + offset)
        offset = offset + STEP * (drift + n * STEP * push)
    state = trajectory.at(begin + cut)
    place, velocity = state.position + offset, state.velocity + drift + cut * push
    thrust = state.acceleration + np.array([0.0, 0.0, GRAVITY])
    while place[2] > safety.space.low[2]:
        places.append(place)
        velocity = velocity + STEP * (thrust - np.array([0.0, 0.0, GRAVITY]))
        place, thrust = place + STEP * velocity, thrust * np.exp(-STEP / lag)
    return np.array([*places, place])


@pytest.mark.parametrize("way", [0, 3])
def test_a_vehicle_that_falls_is_in_its_tube_at_each_time_until_it_lies(way, trajectory, tubes, safety):
    chance, timeouts, nearest = np.random.default_rng(way), Timeouts(), np.inf
    for row, begin in enumerate(TIMES):
        for _ in range(4):
            cut = chance.uniform(timeouts.keep_alive - 0.1, timeouts.watchdog_at_latest) if way else 0.0
            places = fall(trajectory, begin, cut, safety, chance)
            parts = np.minimum((STEP * np.arange(len(places)) / PART).astype(int), tubes.shape[2] - 1)
            low, high = tubes[way, row, parts, 0], tubes[way, row, parts, 1]
            inside = np.minimum(places - low, high - places)[:, :2].min(axis=1)
            assert inside.min() > 0.0
            nearest = min(nearest, inside.min())
            touched = parts[-1]
            assert (tubes[way, row, : max(touched, 1), 1, 2] > 0.0).all()  # in the air, as this one is
    assert nearest < DEVIATION + 0.03  # the tube is not much wider than these


def test_a_vehicle_whose_motors_stop_lies_on_the_floor_in_the_last_part(tubes):
    assert (tubes[[0, 3], :, -1, 1, 2] == 0.0).all()


def test_a_vehicle_whose_link_comes_back_hovers_in_its_tube(trajectory, tubes):
    """It brakes as the commander does: to half a second ahead at its speed, and 5/56 of its acceleration."""
    for row, ordered, back in itertools.product(range(len(TIMES)), STOPS, (0.4, 0.7, Timeouts().watchdog_at_latest)):
        state = trajectory.at(TIMES[row] + ordered)
        stop = state.position + 0.5 * state.velocity + 5.0 / 56.0 * state.acceleration
        for place in (trajectory.at(TIMES[row] + back).position, stop):
            low, high = tubes[1:3, row, :, 0, :2], tubes[1:3, row, :, 1, :2]
            holds = ((low + DEVIATION < place[:2]) & (place[:2] < high - DEVIATION)).all(axis=2)
            assert holds[:, math.ceil(back / PART) :].any(axis=0).all()  # then and later, in one way or the other
            assert (tubes[1:3, row, math.ceil(back / PART) :, 1, 2] > 0.5).all()
