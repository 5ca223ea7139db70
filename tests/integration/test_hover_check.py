"""In the stepped lab the hover after take-off shows vehicles that are not as stated, streamed and on board."""

from dataclasses import replace

import pytest
from stepped_flight import fly_stepped

from cfplan.flight.telemetry import Phase
from cfplan.simulation.lab.stepped_lab import SteppedLab

pytestmark = pytest.mark.integration


def flown(mission, **factors):
    airframe = mission.limits.airframe
    true = replace(airframe, **{name: factor * getattr(airframe, name) for name, factor in factors.items()})
    return fly_stepped(mission, lab=SteppedLab(true))


def scale_of(flight):
    return next(float(text.split()[3].rstrip(",")) for text in flight.said if text.startswith("hover: thrust scale"))


@pytest.mark.parametrize(("name", "factor"), [("mass", 1.2), ("thrust_scale", 0.8)])
def test_a_vehicle_a_fifth_off_lands_before_the_path(mission, name, factor):
    flight = flown(mission, **{name: factor})
    assert "in hover the thrust scale is" in flight.outcome.reason
    assert flight.phases[-3:] == [Phase.LAND, Phase.DISARM, Phase.CLOSED]
    assert not {Phase.GO_TO_START, Phase.STREAM} & set(flight.phases)
    found = scale_of(flight) / mission.limits.airframe.thrust_scale
    assert found == pytest.approx(1 / factor if name == "mass" else factor, rel=0.02)


@pytest.mark.parametrize("factor", [0.94, 1.06])
def test_a_vehicle_within_the_spread_flies_as_planned(mission, factor):
    flight = flown(mission, thrust_scale=factor)
    assert flight.outcome.reason == "landed"
    assert scale_of(flight) == pytest.approx(factor * mission.limits.airframe.thrust_scale, rel=0.015)
