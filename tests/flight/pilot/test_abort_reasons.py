"""A message that ends a flight in the air is told by its reason, and says what to do."""

import pytest

from cfplan.errors import ExitCode
from cfplan.flight.pilot.abort_reasons import AbortReason
from cfplan.flight.pilot.outcome import Rung

pytestmark = pytest.mark.unit


def test_a_message_has_the_values_of_its_fields_and_the_cure_of_its_reason():
    abort = AbortReason.LATE_SETPOINT.abort(Rung.BRAKE, seconds=0.3)
    assert "0.30 s late" in abort.text
    assert abort.rung is Rung.BRAKE
    assert abort.exit_code is ExitCode.ENDED_BY_SAFETY
    assert abort.cure == AbortReason.LATE_SETPOINT.cure


def test_a_value_with_braces_is_not_a_field():
    assert "{seconds}" in AbortReason.PILOT_FAULT.abort(Rung.LAND, error=ValueError("{seconds}")).text


@pytest.mark.parametrize("reason", [reason for reason in AbortReason if reason is not AbortReason.OPERATOR_LAND])
def test_every_reason_but_the_operators_landing_has_a_cure(reason):
    assert reason.cure


def test_no_two_reasons_say_the_same():
    assert len({reason.text for reason in AbortReason}) == len(AbortReason)
