"""Vehicles that leave their paths to stop: how near they come to each other, and to one that is lost."""

from types import SimpleNamespace

import numpy as np
import pytest

from cfplan.planning.fleet.lost import NOTICED, LossModel, Tube
from cfplan.planning.fleet.separation import Stops, stop_separations

RATE, PART, SKEW = 100.0, 0.04, 0.03
SETPOINTS, PERIODS = 300, 101  # 3 s at 1 m/s, and a stop of one second


def eastwards(y: float, turn: float, x: float = 0.0) -> Stops:
    """Stops of a vehicle that flies east from x, y at 1 m/s: straight on for `turn` 0, north for 1, south for -1.

    Each stop takes a second at a constant speed, 1 m/s, so the places are simple.
    """
    along, across = 0.01 * np.arange(SETPOINTS), 0.01 * np.arange(PERIODS)
    places = np.empty((SETPOINTS, PERIODS, 2))
    places[..., 0] = x + along[:, None] + (1.0 - abs(turn)) * across
    places[..., 1] = y + turn * across
    return Stops(places, RATE, 1.0, 0.0)


def member(name: str, delay: float = 0.0):
    return SimpleNamespace(name=name, delay=delay, end=delay + 3.0, plan=SimpleNamespace())


def test_stops_towards_each_other_come_nearer_than_the_paths():
    pair = [member("a"), member("b")]
    (straight,) = stop_separations(pair, [eastwards(0.0, 0.0), eastwards(2.5, 0.0)], SKEW)
    (turned,) = stop_separations(pair, [eastwards(0.0, 1.0), eastwards(2.5, -1.0)], SKEW)
    assert straight.distance == pytest.approx(2.5, abs=0.03)
    assert turned.distance == pytest.approx(0.5, abs=0.03)
    assert turned.distance < 0.5  # between places too
    assert turned.braked
    assert "when all brake" in str(turned)


@pytest.mark.parametrize("ahead", [0.5, 1.2])
def test_a_vehicle_behind_another_that_turns_off_comes_as_near_as_its_stop_and_the_skew_let_it(ahead):
    pair = [member("first"), member("second")]
    (found,) = stop_separations(pair, [eastwards(0.0, 1.0, ahead), eastwards(0.0, 0.0)], SKEW)
    # Both at 1 m/s: u s after the order, the first is `ahead` in front and u aside, the second u nearer; and the skew
    # shifts rows and places, each by one more period as they are sampled.
    u = np.linspace(0.0, 1.0, 1001)
    exact = np.hypot(ahead - u, u).min()
    assert exact - 0.16 < found.distance < exact


def test_a_vehicle_that_waits_stays_at_its_start_when_all_brake():
    waits = member("waits", 1.5)
    (found,) = stop_separations([member("flies"), waits], [eastwards(0.0, 0.0), eastwards(0.4, 0.0)], SKEW)
    assert found.distance == pytest.approx(0.4, abs=0.03)
    assert found.time < 0.1  # both are at x = 0 only at the beginning


def away(boxes, stops, own):
    tube = Tube(np.asarray(boxes, dtype=float), RATE, PART)
    model = LossModel(lambda plan: tube, lambda plan: stops, (), 0.2)
    return model.distances(tube, np.zeros(1), (SimpleNamespace(), np.array([own])), SKEW)[0]


def point(x, y, part, parts=60):
    """A tube that is far away but for one part, in which it is a point above the floor."""
    boxes = np.full((1, 1, parts, 2, 3), 50.0)
    boxes[0, 0, part] = (x, y, 1.0)
    return boxes


def test_a_lost_vehicle_meets_another_on_its_path_until_the_loss_is_noticed_and_on_its_stops_from_then():
    own, stops = 1.0, eastwards(0.0, 1.0)
    assert away(point(own + 0.1, 0.0, 2), stops, own) < 0.02  # flies on for 0.1 s
    latest = NOTICED[1]
    assert away(point(own + latest, 0.3, round((latest + 0.3) / PART)), stops, own) < 0.02  # noticed at the latest
    assert away(point(own, 0.9, round(0.9 / PART)), stops, own) < 0.02  # noticed at once
    assert away(point(own + 0.9, 0.0, round(0.9 / PART)), stops, own) > 0.15  # it stops before it comes there
    assert away(point(own, 0.9, 2), stops, own) > 0.7  # it is not there so soon


def test_a_lost_vehicle_that_lies_is_met_only_by_those_that_rest_there():
    own, stops = 1.0, eastwards(0.0, 1.0)
    lies = np.full((1, 1, 3, 2, 3), 50.0)
    lies[0, 0, 0] = (own + 0.3, 0.5, 0.0)
    assert away(lies, stops, own) == pytest.approx(0.5, abs=0.03)  # it passes, and rests at y = 1
    lies[0, 0, 0] = (own + 0.3, 1.0, 0.0)
    assert away(lies, stops, own) < 0.02
