"""Fleets that have come down in the stepped lab."""

from cfplan.simulation.lab.stepped_fleet import FleetFlight
from cfplan.simulation.virtual_crazyflie.supervisor import State

DISARMED = (State.CHECKS_NOT_PASSED, State.CHECKS_PASSED, State.RESET, State.LOCKED, State.CRASHED)


def assert_all_down(flight: FleetFlight) -> None:
    """None touched another, and all are on the floor, disarmed, their motors off."""
    assert not flight.contacts
    for name, truth in flight.truths.items():
        assert truth.position[-1, 2] < 0.05, name
        assert not truth.motor[-1].any(), name
        assert truth.supervisor[-1] in DISARMED, name
