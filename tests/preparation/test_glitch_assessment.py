"""Plans keep a margin for gaps in setpoints and poses; a file whose plan does not is refused."""

import math
from dataclasses import replace

import numpy as np
import pytest

from cfplan.errors import NotCertifiedError
from cfplan.flight.setpoints.encoding import encode_trajectory
from cfplan.flight.setpoints.rate_trade import gains_under
from cfplan.preparation.glitch_assessment import KEPT, assess_glitches
from cfplan.preparation.local_slowing import slow_locally
from cfplan.preparation.plan_flight import FlightOptions, plan_flight
from cfplan.preparation.prepare_flight import require_glitch_margin
from cfplan.simulation.glitches import TURNED_OVER, glitch_at_every_setpoint
from tests.least_snap import along_least_snap


def encoded_under(limits, trajectory):
    return encode_trajectory(trajectory, gains=gains_under(limits), space=limits.space)


@pytest.fixture(scope="module")
def limits(limits):
    """Limits of a vehicle whose motors and thrust are known exactly, so that it flies alone."""
    known = replace(limits.airframe.spread, thrust_scale=0.0, motor_time_constant=0.0)
    return replace(limits, airframe=replace(limits.airframe, spread=known))


@pytest.fixture(scope="module")
def loop(limits, tmp_path_factory):
    """A plan along a path of least snap, on which gaps lead farther off than on the fastest one."""
    least_snap = along_least_snap("loop3d", tmp_path_factory.mktemp("loop"))
    return plan_flight(least_snap, limits, FlightOptions(budget=math.inf)).plan


def cut_at(limits, deviation):
    """The limits with a vehicle that counts as lost from a smaller deviation on."""
    return replace(limits, flight=replace(limits.flight, deviation=replace(limits.flight.deviation, cut=deviation)))


def test_the_loop_is_flown_through_gaps_with_a_margin(loop, limits):
    encoded = encoded_under(limits, loop.trajectory)
    moments, assessed = glitch_at_every_setpoint(encoded.payloads, limits), assess_glitches(encoded, limits)
    assert assessed.passed
    assert not moments.lost.any()
    assert assessed.excess.max() + KEPT == pytest.approx(
        max(moments.deviation.max() / limits.flight.deviation.cut, moments.tilt.max() / TURNED_OVER)
    )
    assert len(assessed.excess) == len(encoded.times)
    assert f"{np.degrees(moments.tilt.max()):.0f}°" in assessed.describe(assessed.worst)


def test_a_plan_is_slowed_where_a_gap_nearly_loses_the_vehicle(loop, limits):
    moments = glitch_at_every_setpoint(encoded_under(limits, loop.trajectory).payloads, limits)
    strict = cut_at(limits, 0.98 * moments.deviation.max() / KEPT)
    assert not assess_glitches(encoded_under(limits, loop.trajectory), strict).passed
    slowed, _ = slow_locally(loop, lambda trajectory: [assess_glitches(encoded_under(limits, trajectory), strict)])
    assert assess_glitches(encoded_under(limits, slowed.trajectory), strict).passed
    assert 0.0 < slowed.time_lost < 0.03
    assert slowed.slowing.reasons[0].startswith("a gap near (")


def test_the_bytes_of_a_plan_without_that_margin_are_refused(loop, limits):
    encoded = encoded_under(limits, loop.trajectory)
    require_glitch_margin(encoded, limits)
    farthest = glitch_at_every_setpoint(encoded.payloads, limits).deviation.max()
    with pytest.raises(NotCertifiedError, match=r"a gap of 0\.2 s in .* takes the vehicle 0\.\d+ m off"):
        require_glitch_margin(encoded, cut_at(limits, farthest))
