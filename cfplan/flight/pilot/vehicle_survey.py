"""Survey of a vehicle without flying it: preflight's checks of firmware and parameters."""

from cfplan.flight.pilot.outcome import Check
from cfplan.flight.pilot.preflight import check_rule, firmware_check, timeouts_check
from cfplan.flight.pilot.vehicle_rules import PARAMETER_RULES, Action
from cfplan.flight.radio.link import Link
from cfplan.safety.limits import Limits


def survey_vehicle(link: Link, limits: Limits) -> tuple[Check, ...]:
    """Read what preflight checks, and change nothing. Parameters that each flight sets pass with any value.

    Raises LinkError if the vehicle does not answer.
    """
    values = link.read_parameters([rule.name for rule in PARAMETER_RULES])
    found = [firmware_check(link.firmware, limits), timeouts_check(link.firmware)]
    for rule in PARAMETER_RULES:
        value = values.get(rule.name)
        if rule.action is Action.SET and value is not None:
            found.append(Check(rule.name, f"{value:g}", f"each flight sets {rule.value(limits):g}", True))
        else:
            found.append(check_rule(rule, value, limits))
    return tuple(found)
