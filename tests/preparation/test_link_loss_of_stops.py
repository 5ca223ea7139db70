"""Link loss within stops: what is sampled agrees with every setpoint of every stop, and harmful stops are found."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cfplan.errors import NotCertifiedError
from cfplan.preparation.link_loss_assessment import STOPS_EACH, STOPS_EVERY, assess_link_loss_of_stops
from cfplan.preparation.plan_flight import plan_flight
from cfplan.preparation.prepare_flight import encode_flight, prepare_mission, require_harmless_stops
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.link_loss import ALLOWANCE, link_loss_at_every_setpoint, link_loss_within_stops

REPOSITORY = Path(__file__).parents[2]


def link_loss_of_stops(payloads, stops, limits, *, every=1, each=1):
    """Return how far beyond the walls link loss ends, (K, W) m, in so many stops after so many setpoints."""
    plan, begin = link_loss_at_every_setpoint(payloads, limits), np.arange(0, len(payloads), every)
    forks = np.zeros((len(begin), stops.shape[1]), dtype=np.bool_)
    forks[:, ::each] = forks[:, -1] = True
    found = link_loss_within_stops(stops[begin], plan.snapshots[:, begin], limits, forks)
    return found.beyond.reshape(len(begin), -1)


@pytest.fixture(scope="module")
def limits():
    return load_limits(REPOSITORY / "safety.yaml")


@pytest.fixture(scope="module")
def encoded(limits):
    return encode_flight(plan_flight(REPOSITORY / "flights" / "line.yaml", limits))


def test_what_is_sampled_is_what_whole_stops_give(encoded, limits):
    plan = link_loss_at_every_setpoint(encoded.payloads, limits)
    assessed = assess_link_loss_of_stops(encoded, limits, plan, margin=0.0)
    stops = prepare_mission(REPOSITORY / "flights" / "line.yaml", limits).stops
    whole = link_loss_of_stops(encoded.payloads, stops, limits, every=STOPS_EVERY, each=STOPS_EACH)
    coarse = np.arange(0, len(encoded.payloads), STOPS_EVERY)
    worst = whole.max(axis=1)
    assert np.all(assessed.excess[coarse] >= worst - 1e-9)
    far = worst < -0.3  # where nothing was sampled more densely, nor simulated with every motor lag
    assert np.all(assessed.excess[coarse][far] <= worst[far] + ALLOWANCE + 0.03)
    assert np.isinf(assessed.excess).any()  # from most setpoints no stop is sampled
    assert assessed.passed


def test_stops_that_end_outside_are_found_and_refused(encoded, limits):
    narrow = replace(limits, space=replace(limits.space, low=(-2.25, -3.2, 0.0)))
    with pytest.raises(NotCertifiedError, match=r"link loss within a stop .* beyond the wall y = -3.2 m") as caught:
        require_harmless_stops(encoded, narrow)
    assert caught.value.hint
    require_harmless_stops(encoded, replace(narrow, link_loss=replace(narrow.link_loss, only_warn=True)))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "every"), [("line", 1), ("loop3d", 1), ("slalom", 2), ("scan", 16)])
def test_no_setpoint_of_any_stop_ends_outside(name, every, limits):
    mission = prepare_mission(REPOSITORY / "flights" / f"{name}.yaml", limits)
    assert link_loss_of_stops(mission.payloads, mission.stops, limits, every=every).max() < 0.0
