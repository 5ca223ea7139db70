"""A look at a vehicle without flying it: what preflight would say of its firmware and of what is set on board."""

from cfplan.flight.clock import REAL_CLOCK, Clock
from cfplan.flight.pilot.outcome import Check
from cfplan.flight.pilot.preflight import check_rule, firmware_check, timeouts_check
from cfplan.flight.pilot.vehicle_rules import PARAMETER_RULES, Action
from cfplan.flight.radio.link import Link
from cfplan.safety.limits import Limits

_FIRMWARE_WITHIN = 1.0  # s in which the vehicle tells its version
_LOOK_PERIOD = 0.02  # s


def survey_vehicle(link: Link, limits: Limits, clock: Clock = REAL_CLOCK) -> tuple[Check, ...]:
    """Read what preflight rests on, and change nothing. What each flight sets passes, whatever it is now.

    Raises LinkError if the vehicle does not answer.
    """
    end = clock.now() + _FIRMWARE_WITHIN
    while not link.firmware and clock.now() < end:
        clock.sleep(_LOOK_PERIOD)
    values = link.read_parameters([rule.name for rule in PARAMETER_RULES])
    found = [firmware_check(link.firmware, limits), timeouts_check(link.firmware)]
    for rule in PARAMETER_RULES:
        value = values.get(rule.name)
        if rule.action is Action.SET and value is not None:
            found.append(Check(rule.name, f"{value:g}", f"each flight sets {rule.value(limits):g}", True))
        else:
            found.append(check_rule(rule, value, limits))
    return tuple(found)
