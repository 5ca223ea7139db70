"""Descents without poses, by what the vehicle decodes: off the walls, at rest sideways before the floor."""

from pathlib import Path

import numpy as np
import pytest

from cfplan.flight.setpoints.descent import QUICK, descent, off_walls, sinking
from cfplan.flight.setpoints.encoding import RATE, encode_motion
from cfplan.flight.setpoints.hover_to_hover import hover_to_hover
from cfplan.flight.setpoints.packets import decode
from cfplan.safety.limits_file import load_limits
from cfplan.safety.space import Space
from cfplan.simulation.link_loss import link_loss_at_every_setpoint

LIMITS = load_limits(Path(__file__).parents[3] / "safety.yaml")
QUANTUM = 1e-3  # m, m/s
BESIDE = [(2.05, 0.0), (-2.05, 3.8), (1.6, -3.5)]  # m; the walls are at 2.25 and 4


def down(place, aside, lowest=-2.0):
    return descent(place, 0.7, 0.0, QUICK, 0.0, lowest, limits=LIMITS, rate=RATE, aside=aside)


@pytest.mark.parametrize("height", [0.3, 0.6, 1.2, 1.8])
@pytest.mark.parametrize("beside", BESIDE)
def test_a_descent_near_a_wall_goes_off_it_and_rests_sideways_before_the_floor(beside, height):
    place = (*beside, height)
    aside = off_walls(place, LIMITS.space)
    rows = decode(down(place, aside))
    moved = rows.position[:, :2] - beside
    assert (moved[-1] * np.sign(beside) <= QUANTUM).all()
    assert (np.abs(moved[-1]) <= np.abs(aside) + QUANTUM).all()
    low = rows.position[:, 2] < 0.1 - QUANTUM
    assert np.abs(rows.velocity[low, :2]).max() <= QUANTUM
    speeds = np.gradient(rows.position[:, :2], 1.0 / RATE, axis=0)
    assert np.abs(speeds - rows.velocity[:, :2])[1:-1].max() < 0.06 + QUANTUM  # a quantum of each place in 20 ms
    braking = np.linalg.norm(np.gradient(rows.velocity[:, :2], 1.0 / RATE, axis=0), axis=1)
    assert braking.max() < 1.5 + 0.15
    if height > 1.0:
        assert np.linalg.norm(moved[-1]) > 0.18


def test_a_higher_descent_goes_farther_off_the_wall():
    ways = [decode(down((2.05, 0.0, z), (-0.4, 0.0))).position[-1, 0] for z in (0.2, 0.4, 0.8, 1.6)]
    assert (np.diff(ways) < 0.0).all()


@pytest.mark.parametrize("place", [(2.05, 0.0, 0.4), (2.05, 3.8, 1.2)])
def test_link_loss_in_a_descent_that_goes_off_the_walls_ends_farther_inside(place):
    def beyond(aside):
        return link_loss_at_every_setpoint(down(place, aside, 0.0), LIMITS, RATE).worst.beyond

    goes_off = beyond(off_walls(place, LIMITS.space))
    assert goes_off < -0.1
    assert goes_off < beyond((0.0, 0.0)) - 0.1


def test_a_vehicle_stays_where_no_wall_is_near_and_between_near_walls_it_goes_to_the_middle():
    assert off_walls((0.0, 2.9, 1.0), LIMITS.space) == (0.0, 0.0)
    assert off_walls((0.2, -0.1, 1.0), Space((-0.5, -0.4, 0.0), (0.5, 0.4, 2.0), 0.1)) == pytest.approx((-0.2, 0.1))
    assert np.array_equal(
        down((0.0, 2.9, 1.0), (0.0, 0.0)), down((0.0, 2.9, 1.0), off_walls((0, 2.9, 1), LIMITS.space))
    )


def inwards(place):
    return off_walls(place, LIMITS.space)


def a_stop(end, duration=0.9):
    motion = hover_to_hover((end[0], end[1] - 0.5, end[2]), 0.3, end, 0.3, duration, RATE)
    return encode_motion(motion, motion.acceleration, space=LIMITS.space)


def test_a_stop_that_sinks_near_a_wall_ends_off_it_at_rest():
    stop = a_stop((2.05, 0.0, 1.0))
    rows, before = decode(sinking(stop, 0.4, QUICK.speed, RATE, inwards)), decode(stop)
    aside = rows.position[:, :2] - before.position[:, :2]
    assert aside[-1] == pytest.approx((-0.4, 0.0), abs=2 * QUANTUM)
    assert (np.diff(aside[:, 0]) <= 2 * QUANTUM).all()
    assert np.abs(rows.velocity[-1, :2]).max() <= QUANTUM
    assert np.array_equal(rows.quaternion, before.quaternion)  # and so what link loss makes of it
    assert np.array_equal(rows.body_rate, before.body_rate)


def test_a_stop_that_sinks_far_from_walls_only_sinks_and_one_row_stays_as_it_is():
    stop = a_stop((0.0, 0.0, 1.0))
    rows, before = decode(sinking(stop, 0.4, QUICK.speed, RATE, inwards)), decode(stop)
    assert np.array_equal(rows.position[:, :2], before.position[:, :2])
    assert rows.position[-1, 2] == pytest.approx(0.4, abs=0.05)
    last = stop[-1:]
    assert np.array_equal(sinking(last, 0.4, QUICK.speed, RATE, inwards), last)
