"""In flight the air turns the body in proportion to its velocity; setpoints ask for what holds it, and for no more."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cfplan.flight.setpoints.byte_check import check_bytes
from cfplan.flight.setpoints.commitment import Commitment, propose, splice
from cfplan.flight.setpoints.encoding import encode_trajectory
from cfplan.flight.setpoints.packets import decode
from cfplan.flight.setpoints.rate_trade import gains_under, moment_rates
from cfplan.flight.setpoints.stops import encode_stops
from cfplan.geometry.min_snap import centripetal_times, min_snap
from cfplan.planning.plan import plan
from cfplan.preparation.plan_flight import plan_flight
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.dry_run import dry_run, rehearse_motion
from cfplan.vehicle.joint import JoinedTrajectory

REPOSITORY = Path(__file__).parents[3]
WAYPOINTS = np.array([[-1.0, -2.0, 0.8], [0.8, -1.0, 1.1], [-0.6, 0.6, 0.9], [0.7, 1.8, 1.1]])


@pytest.fixture(scope="module")
def turned():
    """The limits of the project's own safety.yaml, whose airframe the air turns."""
    return load_limits(REPOSITORY / "safety.yaml")


@pytest.fixture(scope="module")
def limits(turned):
    """The same without the moment."""
    return replace(turned, airframe=replace(turned.airframe, velocity_moment=(0.0, 0.0)))


@pytest.fixture(scope="module")
def planned(limits):
    path = min_snap(WAYPOINTS, times=centripetal_times(WAYPOINTS))
    return plan(path, limits.airframe, limits, planner="expert").trajectory


def encoded(planned, limits):
    return encode_trajectory(planned, gains=gains_under(limits), space=limits.space)


def test_the_rates_are_those_of_public_flights(turned):
    """0.19 rad/s of roll rate and 0.26 of pitch rate per m/s, with the firmware's gains."""
    about_x, about_y = moment_rates(turned.airframe)
    assert about_x == pytest.approx(-0.19, abs=0.02)
    assert about_y == pytest.approx(0.26, abs=0.02)


def test_a_vehicle_that_the_air_turns_follows_twice_as_closely(planned, limits, turned):
    motion = JoinedTrajectory((planned,), (0.0,))
    astray, near = (
        rehearse_motion(encoded(planned, each), motion, turned.airframe, limits.flight).deviation
        for each in (limits, turned)
    )
    assert astray > 0.03
    assert near < astray / 2.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["line", "figure8", "slalom", "helix", "random", "trefoil"])
def test_dry_runs_deviate_less_too(name, turned, limits):
    """Also with errors of the filter, on vehicles unlike their airframe: 2.4 to 3.4 cm against 3.4 to 5.5 cm."""
    flight = plan_flight(REPOSITORY / "flights" / f"{name}.yaml", turned)
    motion = flight.plan.trajectory
    astray, near = (dry_run(encoded(motion, each), motion, turned).deviation_median for each in (limits, turned))
    assert near == pytest.approx(0.029, abs=0.008)
    assert near < 0.85 * astray


def test_the_bytes_are_certified_and_the_pilot_accepts_them(planned, limits, turned):
    """As the motion that they make the vehicle fly is the same."""
    held = encoded(planned, turned)
    check_bytes(held, planned, turned.plan)
    stops = encode_stops(held.motion, 100.0, gains=held.gains, space=held.space)
    first = Commitment(0, held.payloads, stops)
    again = propose(first, 50, held.payloads[50:], stops[50:])
    assert isinstance(splice(first, again, 40, turned), Commitment)
    plain = encoded(planned, limits)
    assert (plain.payloads != held.payloads).any()
    for name in ("position", "velocity"):
        np.testing.assert_array_equal(getattr(plain.decoded, name), getattr(held.decoded, name))


def test_at_rest_nothing_is_held(planned, turned, limits):
    np.testing.assert_array_equal(encoded(planned, turned).payloads[-1], encoded(planned, limits).payloads[-1])
    assert not decode(encoded(planned, turned).payloads[-1:]).velocity.any()
