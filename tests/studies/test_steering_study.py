"""The study of random requests: a flight passes, and faults of a flown sequence are found."""

import dataclasses

import numpy as np
import pytest

from cfplan.air.requests import PathVerdict, Wish
from cfplan.air.stepped import PlannerFault
from cfplan.flight.setpoints.packets import decode
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.steering.steered_vehicle import SteeredVehicle
from studies.flown_sequence import judge_sequence
from studies.runner.cases import run_study
from studies.steering import STUDY, Settings, WatchedSteering, fly_steered


@pytest.fixture(scope="module")
def flown(limits):
    """Return the verdict on a flight with some requests, its setpoints and its commitments."""
    kept = []

    def judge(*given):
        kept.append(given)
        return judge_sequence(*given)

    return fly_steered(4, limits, 14, 8.0, judge), *kept[0][:2]


def test_random_requests_are_flown_or_refused_within_every_limit(flown):
    flight, sent, commitments = flown
    assert not flight.bad, flight
    answered = flight.accepted + flight.refused + flight.late + flight.superseded + flight.invalid
    assert answered == flight.requests >= 14
    assert len(commitments) > 4
    assert len(sent) > 300
    assert 0.5 < flight.plan_usage <= 1.0
    assert 0.5 < flight.speed <= 2.001
    assert 0.0 < flight.deviation < 0.1
    assert flight.to_wall > 0.0


@pytest.mark.slow
def test_the_study_flies_the_same_by_the_same_seed(flown):
    result = run_study("steering", "studies.steering", STUDY, Settings(flights=1, requests=14, seconds=8.0, seed=4))
    (row,) = result.rows
    assert dataclasses.replace(row, faults=tuple(row.faults)) == flown[0]
    by_planner, together = result.table("requests").rows
    assert (by_planner["group"], together["group"]) == (f"{flown[0].planning:g} s", "all")
    assert together["requests"] == flown[0].requests
    assert result.table("sequence").rows[1]["plan_usage"] == flown[0].plan_usage
    assert result.table("bad").rows == ()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda one: {"position": (one.position[0] + 0.001, *one.position[1:])}, "not committed: 1"),
        (lambda one: {"velocity": (one.velocity[0] + 0.4, *one.velocity[1:])}, "acceleration by differences"),
        (lambda one: {"velocity": (2.5, 0.0, 0.0)}, "speed: 2.5"),
    ],
)
def test_a_setpoint_that_was_not_committed_is_found(flown, limits, change, words):
    _, sent, commitments = flown
    number = sorted(sent)[len(sent) // 2]
    spoilt = {**sent, number: dataclasses.replace(sent[number], **change(sent[number]))}
    assert any(words in fault for fault in judge_sequence(spoilt, commitments, limits).faults)


def test_what_is_wrong_with_a_commitment_is_found(flown, limits):
    _, sent, commitments = flown
    plans = [number for number, each in enumerate(commitments[:-1]) if not 0 < each.stop_from <= each.splice]
    at = next(  # the first that moves as it begins, and was flown
        number
        for number in plans
        if decode(commitments[number].payloads).velocity[0].any()
        and min(later.splice for later in commitments[number + 1 :]) > commitments[number].splice + 20
    )
    each = commitments[at]
    later = np.concatenate([each.payloads[1:], each.payloads[-1:]])
    none = np.repeat(each.stops[-1:], len(each.stops), axis=0)
    for change, words in (
        ({"payloads": later}, "jump at a splice"),
        ({"payloads": later}, "in the packet is not that of the trajectory"),
        ({"stops": none}, "without a committed stop"),
    ):
        spoilt = [*commitments[:at], dataclasses.replace(each, **change), *commitments[at + 1 :]]
        assert any(words in fault for fault in judge_sequence(sent, spoilt, limits).faults), words
    slower = dataclasses.replace(limits, plan=dataclasses.replace(limits.plan, acceleration=2.0))
    assert any("usage of a limit" in fault for fault in judge_sequence(sent, commitments, slower).faults)
    gone = {number: one for number, one in sent.items() if number != max(sent) // 2}
    assert any("left out: 1" in fault for fault in judge_sequence(gone, commitments, limits).faults)


def test_what_is_flown_later_than_proposed_is_judged_as_it_is_flown(limits):
    """In a hover, where the pilot accepts a plan that is delayed by three setpoints."""
    flight = WatchedSteering(limits, planning=0.1, seed=5, vehicle=VehicleSettings(seed=5))
    with SteeredVehicle(flight, limits, uri="sim://0") as vehicle:
        vehicle.take_off(1.0)
        vehicle.fly([[0.0, 0.5, 1.0]])
        vehicle.wait()
        vehicle.sleep(1.0)
        flight.planner.fault = PlannerFault.OTHER_JOINT
        accepted = vehicle.request(Wish.REPLACE, [[1.0, 1.0, 1.2]])
        vehicle.sleep(1.5)
        flight.planner.fault = None
        answers = [*vehicle.answers(), vehicle.answer_to(vehicle.request(Wish.REPLACE, [[0.0, 0.5, 1.0]]))]
        vehicle.land()
    assert [each.later for each in flight.commitments][-1] == 3
    assert judge_sequence(flight.sent, flight.commitments, limits).faults == ()
    # The planner does not know what the pilot is committed to: it answers each request once, and leaves none pending.
    assert [answer.verdict for answer in answers] == [PathVerdict.REFUSED] * 2
    assert flight.answered[accepted] == 1
    assert flight.planner.pending == frozenset()
