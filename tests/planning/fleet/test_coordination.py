"""Vehicles whose paths cross are kept apart, which a check that shares no code with the certificate finds too."""

import math
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from cfplan.flight.setpoints.encoding import RATE, encode_trajectory
from cfplan.flight.setpoints.stops import stop_clock, stop_motion
from cfplan.planning.fleet import coordination
from cfplan.planning.fleet.coordination import SLACKS, Blocked, coordinate
from cfplan.planning.fleet.separation import STOP, separations

APART, SKEW = 0.30, 0.03
WALLS = (-1.5, 1.5)


@pytest.fixture(scope="module")
def crossing(member):
    """Three ways through the middle of the room, all of which would be there at once."""
    low, high = WALLS
    return (
        member("east", (low, 0, 1), (high, 0, 1)),
        member("north", (0, low, 1.2), (0, high, 1.2)),
        member(
            "aslant", (low / math.sqrt(2), low / math.sqrt(2), 0.8), (high / math.sqrt(2), high / math.sqrt(2), 0.8)
        ),
    )


@pytest.fixture(scope="module")
def coordinated(crossing):
    made = coordinate(crossing, APART, SKEW, lambda slower: slower)
    assert not isinstance(made, Blocked)
    return made


def nearest(a, b, skew):
    """The least distance of two columns, by the states of the trajectories at every 4 ms and six skews."""
    times = np.arange(0.0, max(a.end, b.end) + 0.1, 0.004)
    of_a = a.plan.trajectory.at(np.clip(times - a.delay, 0.0, a.plan.trajectory.duration)).position[:, :2]
    least = math.inf
    for late in np.linspace(-skew, skew, 6):
        of_b = b.plan.trajectory.at(np.clip(times + late - b.delay, 0.0, b.plan.trajectory.duration)).position[:, :2]
        least = min(least, float(np.linalg.norm(of_a - of_b, axis=1).min()))
    return least


def test_vehicles_that_start_together_come_too_near(crossing):
    for each in separations(crossing, SKEW):
        assert not each.keeps(APART)
        assert np.linalg.norm(each.place) < 0.3  # in the middle of the room
        assert 0.0 < each.time < crossing[0].end


def test_the_certificate_is_never_above_the_dense_check_and_hardly_below(coordinated):
    of_pair = {each.pair: each for each in separations(coordinated, SKEW)}
    assert len(of_pair) == 3
    for a, b in combinations(coordinated, 2):
        certified = of_pair[a.name, b.name]
        assert certified.keeps(APART)
        dense = nearest(a, b, SKEW)
        assert certified.distance <= dense < certified.distance + 0.02


def test_coordinated_vehicles_keep_their_limits_and_lose_little_time(crossing, coordinated):
    assert all(each.plan.certificate.passed for each in coordinated)
    assert [each.plan.path for each in coordinated] == [each.plan.path for each in crossing]
    alone = max(each.end for each in crossing)
    assert alone <= max(each.end for each in coordinated) < 1.5 * alone


def joint_stop(a, b, space):
    """The least distance of two vehicles that brake at one tick, by the setpoints of their stops."""
    ticks = np.arange(0, int(max(a.end, b.end) * RATE), 2)
    places = []
    for each in (a, b):
        motion = encode_trajectory(each.plan.trajectory, space=space).motion
        rows = ticks - round(each.delay * RATE)
        stops, _ = stop_motion(motion, np.clip(rows, 0, len(motion.position) - 1), RATE)
        way = stops.position.reshape(len(ticks), -1, 3)[..., :2]
        places.append(np.where((rows < 0)[:, None, None], motion.position[0, :2], way))  # waiting, it stays
    return float(np.linalg.norm(places[0] - places[1], axis=2).min())


def test_joint_stops_keep_apart_from_every_tick(coordinated, limits):
    for a, b in combinations(coordinated, 2):
        assert joint_stop(a, b, limits.space) >= APART - 1e-3


@pytest.fixture(scope="module")
def leaving(member):
    """One that passes close by the start of another."""
    return member("by", (WALLS[0], 0, 1), (WALLS[1], 0, 1)), member("leaves", (0, 0.15, 1), (0, WALLS[1], 1))


def test_a_stop_before_a_vehicle_has_begun_counts(leaving, limits):
    """The waiting vehicle leaves before the other arrives, but not if both brake just before it begins."""
    by, leaves = leaving
    waits = replace(leaves, delay=0.5 * by.end - 0.55)
    assert nearest(by, waits, SKEW) >= APART
    (found,) = separations((by, waits), SKEW)
    dense = joint_stop(by, waits, limits.space)
    assert found.distance < dense + 1e-3
    assert dense < 0.2
    assert waits.delay <= found.time <= waits.delay + STOP + SKEW + 1e-2
    assert separations((waits, by), SKEW)[0].distance == pytest.approx(found.distance, abs=1e-3)


def test_coordination_regards_stops_before_a_vehicle_has_begun(leaving, member, limits):
    """The fastest clocks would let one wait for a third until the first is about to come by."""
    by, leaves = leaving
    third = member("third", (0.9, 0.65, 1), (WALLS[0], 0.65, 1))
    made = coordinate((by, third, leaves), APART, SKEW, lambda same: same)
    assert isinstance(made, Blocked) or min(joint_stop(*pair, limits.space) for pair in combinations(made, 2)) >= APART


def test_a_stop_goes_on_as_long_as_its_clock():
    assert pytest.approx(stop_clock(RATE)[0][-1] / RATE) == STOP


def test_a_wider_skew_needs_more_room(coordinated):
    narrow, wide = separations(coordinated[:2], 0.0)[0], separations(coordinated[:2], 0.2)[0]
    assert wide.distance < narrow.distance


def test_vehicles_that_meet_on_one_line_are_refused_with_pair_place_and_time(member):
    low, high = WALLS
    head_on = member("east", (low, 0, 1), (high, 0, 1)), member("west", (high, 0.05, 1), (low, 0.05, 1))
    blocked = coordinate(head_on, APART, SKEW, lambda slower: slower)
    assert isinstance(blocked, Blocked)
    assert set(blocked.pair) == {"east", "west"}
    assert all(low <= x <= high for x, y in blocked.places)
    assert [y for x, y in blocked.places] == pytest.approx([{"east": 0.0, "west": 0.05}[name] for name in blocked.pair])
    assert math.isfinite(blocked.time)


@pytest.fixture
def refused(monkeypatch):
    """Let the certificate refuse the first plans; return the numbers of those refused and of those looked at."""

    def refuse(first):
        looked = []

        def certify(members, skew):
            looked.append(members)
            found = separations(members, skew)
            return tuple(replace(each, distance=0.0) for each in found) if len(looked) <= first else found

        monkeypatch.setattr(coordination, "separations", certify)
        return looked

    return refuse


@pytest.fixture(scope="module")
def beside(member):
    """Three that never come near each other, so that the first order is the best."""
    low, high = WALLS
    return tuple(member(f"at {y}", (low, y, 1), (high, y, 1)) for y in (-1, 0, 1))


def test_the_search_goes_on_when_the_best_order_cannot_be_certified(beside, refused):
    refused(len(SLACKS))
    made = coordinate(beside, APART, SKEW, lambda slower: slower)
    assert not isinstance(made, Blocked)


def test_every_order_of_three_is_tried_before_they_are_refused(beside, refused):
    looked = refused(math.inf)
    assert isinstance(coordinate(beside, APART, SKEW, lambda slower: slower), Blocked)
    first_two = {(first.name, second.name) for second, first in looked}
    assert len(first_two) == math.factorial(3)
