"""What a dry run strayed by is taken back, ahead of time, and the vehicle flies nearer to its plan for it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cfplan.flight.on_board.correction import correct
from cfplan.flight.setpoints.encoding import encode_trajectory
from cfplan.flight.setpoints.rate_trade import gains_under
from cfplan.preparation.export_flight import Form, fit_polynomials, plan_for_polynomials
from cfplan.preparation.plan_flight import FlightOptions
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.dry_run import dry_run
from cfplan.simulation.on_board_run import on_board_run

REPOSITORY = Path(__file__).parents[3]
TIMES, DURATION = np.arange(0.0, 9.0, 0.01), 8.0


def strayed(times=TIMES):
    """2 cm along x and -1 cm along z, for a while amid the flight, and nothing elsewhere."""
    hill = np.sin(np.pi * np.clip((times - 2.0) / 4.0, 0.0, 1.0)) ** 4
    return hill[:, None] * [0.02, 0.0, -0.01]


def test_it_is_the_opposite_of_what_was_strayed_by_and_ahead_of_it():
    rows = np.linspace(0.0, DURATION, 100)
    shift = correct(TIMES, strayed(), DURATION).at(rows, DURATION)[:, 0]
    np.testing.assert_allclose(shift, -strayed(rows + 0.1), atol=3e-4)


def test_it_begins_and_ends_at_rest_wherever_the_vehicle_was():
    correction = correct(TIMES, np.full((len(TIMES), 3), 0.05), DURATION)
    np.testing.assert_allclose(correction.at(np.array([0.0, DURATION]), DURATION), 0.0, atol=1e-9)
    assert not correction.at(np.array([-0.5, DURATION + 0.5]), DURATION).any()


def test_its_derivatives_are_those_of_its_shift_however_long_the_flight_is():
    correction, step, longer = correct(TIMES, strayed(), DURATION), 1e-4, 1.3 * DURATION
    rows = np.linspace(0.1, longer - 0.1, 50)
    before, here, after = (correction.at(rows + by, longer) for by in (-step, 0.0, step))
    np.testing.assert_allclose((after - before)[:, :4] / (2 * step), here[:, 1:], rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(here[:, 0], correction.at(rows / 1.3, DURATION)[:, 0], atol=1e-12)


@pytest.fixture(scope="module")
def limits():
    return load_limits(REPOSITORY / "safety.yaml")


@pytest.fixture(scope="module")
def loop(limits):
    planned = plan_for_polynomials(REPOSITORY / "flights" / "loop3d.yaml", limits, FlightOptions())
    return planned, fit_polynomials(planned, Form.MEMORY)


@pytest.mark.slow
def test_the_loop_is_flown_on_board_nearly_as_by_stream(loop, limits):
    planned, exported = loop
    plan = planned.plan.trajectory
    streamed = dry_run(encode_trajectory(plan, gains=gains_under(limits), space=limits.space), plan, limits)
    assert exported.on_board.reference.correction is not None
    assert exported.on_board.certificate.passed
    assert exported.dry_run.deviation < streamed.deviation + 0.015  # without a correction 0.029 m


@pytest.mark.parametrize("lag", [0.07, 0.13])
def test_it_helps_a_vehicle_with_other_motors_too(loop, limits, lag):
    planned, exported = loop
    other = replace(limits, airframe=replace(limits.airframe, motor_time_constant=lag))
    plain = fit_polynomials(planned, Form.MEMORY, leads=False)
    corrected, uncorrected = (on_board_run(each.on_board, other) for each in (exported, plain))
    assert corrected.deviation_median < 0.036
    assert corrected.deviation_median < uncorrected.deviation_median / 2
