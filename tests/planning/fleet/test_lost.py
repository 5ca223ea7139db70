"""Lost vehicles: the certificate against simulations of the lost one and stops of the others that share no code."""

from dataclasses import replace

import numpy as np
import pytest
from link_loss_oracle import fly_on

from cfplan.flight.setpoints.encoding import RATE, encode_trajectory
from cfplan.flight.setpoints.rate_trade import gains_under
from cfplan.flight.setpoints.stops import stop_clock, stop_motion
from cfplan.planning.fleet.coordination import Blocked, coordinate
from cfplan.planning.fleet.lost import BACK, NOTICED, LossModel, Tube
from cfplan.simulation.draws import draw_vehicles
from cfplan.simulation.dry_run import fly_drawn, rehearsed_flight
from cfplan.simulation.link_loss import TUBE_PART, link_loss_tubes

APART, SKEW, CLEARANCE = 0.30, 0.03, 0.20
STOP = stop_clock(RATE)[0] / RATE
OFF_BOX = 0.08  # m out of the swept box that drawn vehicles come to at most, as in tests/simulation/test_link_loss.py


@pytest.fixture(scope="module")
def encoded(limits):
    return lambda plan: encode_trajectory(plan.trajectory, gains=gains_under(limits), space=limits.space)


@pytest.fixture(scope="module")
def model(limits, encoded):
    """Make a model of lost vehicles, with those of one dongle."""

    def make(*together):
        def tube(plan):
            payloads = encoded(plan).payloads
            boxes = link_loss_tubes(payloads, limits, np.arange(len(payloads)))
            return Tube(boxes, RATE, 0.001 * TUBE_PART)

        return LossModel(tube, STOP, together, CLEARANCE)

    return make


@pytest.fixture(scope="module")
def crossing(member):
    return member("east", (-1.2, 0, 1), (1.2, 0, 1)), member("north", (0, -1.2, 1.2), (0, 1.2, 1.2))


@pytest.fixture(scope="module")
def coordinated(crossing, model):
    made = coordinate(crossing, APART, SKEW, lambda slower: slower, model())
    assert not isinstance(made, Blocked)
    return made


def distances(tube, lost, other):
    return LossModel(lambda plan: tube, STOP, (), CLEARANCE).distances(tube, lost, other, SKEW)


def stopping(member, encoded, loss: float, begins: float, late: float) -> np.ndarray:
    """The places, (M, 2) m at each 10 ms after a loss, of a vehicle that brakes then by a clock that is late."""
    motion = encoded(member.plan).motion
    own = np.round((loss + late - member.delay) * RATE) + np.arange(round(begins * RATE) + 1)
    if own[-1] < 0:
        return motion.position[:1, :2]  # it stays at its start
    rows = np.clip(own, 0, len(motion.position) - 1).astype(int)
    stops, _ = stop_motion(motion, rows[-1:], RATE)
    return np.concatenate([motion.position[rows[:-1]], stops.position])[:, :2]


def apart(way: np.ndarray, others: np.ndarray) -> float:
    """The least distance of a way down to the floor, (M, 3) m at 1 kHz, and (N, 2) m at 100 Hz; then both rest."""
    way = way[::10, :2]
    ticks = np.arange(max(len(way), len(others)))
    away = np.linalg.norm(way[np.minimum(ticks, len(way) - 1)] - others[np.minimum(ticks, len(others) - 1)], axis=1)
    return float(min(away[: len(way)].min(), away[-1]))  # others may pass over it while it lies


def test_vehicles_that_only_keep_apart_meet_a_lost_one_which_coordination_avoids(crossing, coordinated, model):
    near = coordinate(crossing, APART, SKEW, lambda slower: slower)
    assert not isinstance(near, Blocked)
    worst = model().losses(near, (0, 1), SKEW)[0]
    assert not worst.keeps(CLEARANCE)
    assert set(worst.pair) == {"east", "north"}
    for each in model().losses(coordinated, (0, 1), SKEW):
        assert each.keeps(CLEARANCE)
    assert max(each.end for each in coordinated) < sum(each.plan.trajectory.duration for each in crossing) + 0.5


def test_the_certified_distance_is_never_above_that_of_simulations(coordinated, encoded, model, limits):
    """Motors that stop at once or after a second; brakes from the soonest to the latest, clocks early and late."""
    of_vehicle = {each.vehicles[0]: each for each in model().losses(coordinated, (0, 1), SKEW)}
    lag = limits.airframe.motor_time_constant
    for lost, other in (coordinated, coordinated[::-1]):
        payloads, least = encoded(lost.plan).payloads, np.inf
        for row in range(0, len(payloads), 20):
            ways = [fly_on(payloads, limits.airframe, row, lag=lag, off_after=off) for off in (0, 1040)]
            for begins, late in zip((NOTICED[0], 0.4, NOTICED[1]), (-SKEW, 0.0, SKEW), strict=True):
                others = stopping(other, encoded, lost.delay + row / RATE, begins, late)
                least = min(least, *(apart(way, others) for way in ways))
        assert CLEARANCE <= of_vehicle[lost.name].distance < least + 0.01


@pytest.mark.parametrize("gap", [0.35, 0.6])
def test_hovering_at_its_start_beside_a_lost_vehicle_counts(member, encoded, model, limits, gap):
    """Both paths lead away from each other, so that the two are nearest before they begin."""
    fleet = member("up", (0, gap, 1), (0, 1.6 + gap, 1)), member("down", (0, 0, 1), (0, -1.6, 1))
    (worst, _) = model().losses(fleet, (0, 1), SKEW)
    payloads, least = encoded(fleet[0].plan).payloads, np.inf
    for off in (0, 1040):
        way = fly_on(payloads, limits.airframe, 0, lag=limits.airframe.motor_time_constant, off_after=off)
        least = min(least, apart(way, stopping(fleet[1], encoded, -1.0, NOTICED[1], 0.0)))
    assert worst.distance < least + 0.01
    assert worst.keeps(CLEARANCE) is (gap == 0.6)


def test_a_vehicle_that_waits_when_told_to_brake_stays_at_its_start(crossing):
    """Long after the loss the tube is at the start of the other, which would have begun 0.3 s after the loss."""
    other = crossing[0].plan
    start = other.path(np.zeros(1))[0]
    boxes = np.full((1, 1, 60, 2, 3), 50.0)
    boxes[0, 0, 25:] = start  # from 1 s on
    tube = Tube(boxes, RATE, 0.04)
    braking = distances(tube, np.zeros(4), (other, np.array([-0.5, -0.3, -0.05, 0.5])))
    assert braking[:3] == pytest.approx(0.0, abs=0.02)
    assert braking[3] > 0.2


@pytest.mark.parametrize(("part", "stays"), [(6, False), (12, True)])
def test_a_link_that_comes_back_leaves_its_vehicle_where_its_tube_was(crossing, part, stays):
    """The other comes by 0.9 s after the loss, when the tube has left that place for long."""
    other = crossing[0].plan
    own = 0.5 * other.trajectory.duration - 0.5
    boxes = np.full((1, 1, 60, 2, 3), 50.0)
    boxes[0, 0, part] = other.trajectory.at(own + 0.9).position
    away = distances(Tube(boxes, RATE, 0.04), np.zeros(1), (other, np.array([own])))
    assert away[0] < 0.02 if stays else away[0] > 0.2


@pytest.mark.parametrize("skew", [0.03, 0.2])
def test_a_vehicle_that_brakes_by_a_late_clock_counts_where_it_comes_to_rest(crossing, skew):
    """From 1.6 to 2 s after the loss the tube is 5 cm behind the place where the other may rest; then it lies afar."""
    other, own = crossing[0].plan, 0.4 * crossing[0].plan.trajectory.duration

    def places(times):
        return other.trajectory.at(np.clip(times, 0.0, other.trajectory.duration)).position

    moments = np.arange(1.6, 2.0, 0.01)
    begins, late = np.meshgrid(np.linspace(*NOTICED, 31), np.linspace(-skew, skew, 21))
    braked = np.minimum(moments, begins[..., None]) + np.interp(
        moments - begins[..., None], np.arange(len(STOP)) / RATE, STOP
    )
    reached = places((own + late[..., None] + braked).ravel())[:, :2]
    boxes = np.full((1, 1, 60, 2, 3), 50.0)
    boxes[0, 0, 40:50] = places(np.array([own - skew + STOP[-1]]))[0] - [0.05, 0.0, 0.0]
    boxes[0, 0, 50:, :, 2] = 0.0
    least = np.linalg.norm(reached - boxes[0, 0, 40, 0, :2], axis=1).min()
    tube = Tube(boxes, RATE, 0.04)
    model = LossModel(lambda plan: tube, STOP, (), CLEARANCE)
    away = model.distances(tube, np.array([own]), (other, np.array([own])), skew)[0]
    assert least - 0.02 < away <= least


@pytest.mark.slow
def test_drawn_vehicles_without_link_and_poses_keep_the_distance(coordinated, encoded, limits):
    for lost, other in (coordinated, coordinated[::-1]):
        flight = rehearsed_flight(encoded(lost.plan), lost.plan.trajectory)
        for moment in np.arange(0.0, lost.plan.trajectory.duration, 0.15):
            others = [stopping(other, encoded, lost.delay + moment, begins, 0.0) for begins in NOTICED]
            for draw in draw_vehicles(limits.airframe, limits.pose, 4):
                flown = fly_drawn(replace(flight, duration=moment + 4.0), draw, limits, moment)
                way = flown.position[round(1000 * moment) :]
                down = np.flatnonzero(way[:, 2] <= limits.space.low[2])
                way = way[: down[0] + 1] if len(down) else way
                assert min(apart(way, each) for each in others) >= CLEARANCE - OFF_BOX


def test_the_vehicles_of_a_dongle_are_lost_together(crossing, coordinated, model):
    (alone,) = [each for each in model((0, 1)).losses(coordinated, (0, 1), SKEW) if len(each.vehicles) == 2]
    (together,) = [each for each in model((0, 1)).losses(crossing, (0, 1), SKEW) if len(each.vehicles) == 2]
    assert alone.vehicles == ("east", "north")
    assert alone.reaction == together.reaction == "all are lost"
    assert together.distance == 0.0  # they are in the middle at once
    assert alone.distance > 0.0


def test_a_tube_is_compared_with_each_place_that_the_other_may_be_at(crossing):
    """A still box of one part, and then one on the floor, beside a vehicle that passes by."""
    other, box = (
        crossing[0].plan,
        np.array([[[[-0.1, 0.5, 0.9], [0.1, 0.6, 1.1]], [[-0.1, 0.5, 0.0], [0.1, 0.6, 0.0]]]]),
    )
    tube, duration = Tube(box[None], RATE, 0.04), other.trajectory.duration
    own = np.array([-np.inf, 0.0, duration / 2, duration])
    braking = distances(tube, np.zeros(4), (other, own))
    end = np.hypot(1.1, 0.5)
    assert braking[0] == pytest.approx(end, abs=0.02)  # it waits where it starts
    assert braking[2] == pytest.approx(0.5, abs=0.02)
    box[..., 0, 0] = np.nan
    assert np.isnan(distances(Tube(box[None], RATE, 0.04), np.zeros(4), (other, own))).all()


def together(a, b):
    own, model = np.array([0.0, 0.02]), LossModel(lambda plan: a, STOP, (), CLEARANCE)
    return model.tubes_apart(a, own, b, own, SKEW)


def test_boxes_of_two_tubes_are_compared_part_by_part():
    still = np.zeros((1, 3, 2, 2, 3))
    moved = still + np.array([1.0, 0.0, 0.0])
    moved[0, :, 1, :, 0] = 0.3
    far = np.full_like(still, 50.0)  # of motors that stop at once, which these two do not do together
    a, b = (Tube(np.concatenate([far, lost]), RATE, 0.04) for lost in (still, moved))
    assert together(a, b) == pytest.approx([0.3, 0.3])
    assert together(b, a) == pytest.approx([0.3, 0.3])


@pytest.mark.parametrize(("first", "distance"), [(2, 100.0), (12, 0.0)])
def test_one_of_two_whose_link_comes_back_stays_where_the_other_may_come_by_later(first, distance):
    """Both pass the same point, one in a part before or behind BACK, the other later."""
    a, b, later = np.zeros((2, 1, 30, 2, 3)), np.zeros((2, 1, 30, 2, 3)), 20
    assert (0.04 * first < BACK) is (distance > 0.0)
    a[..., 0], b[..., 1] = 100.0, 100.0
    a[:, :, first] = b[:, :, later] = 0.0
    tubes = [Tube(boxes, RATE, 0.04) for boxes in (a, b)]
    assert together(*tubes) == pytest.approx([distance, distance])
    assert together(*tubes[::-1]) == pytest.approx([distance, distance])
