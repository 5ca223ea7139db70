"""How near the vehicle stays to a fast plan, on what its own filter believes, with poses and packets as in a room."""

from pathlib import Path

import numpy as np
import pytest
from stepped_flight import fly_stepped

from cfplan.preparation.prepare_flight import prepare_mission
from cfplan.simulation.lab import stepped_lab
from cfplan.simulation.lab.radio import RadioFault, RadioFaultKind
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_vicon.cameras import ViconSettings

REPOSITORY = Path(__file__).parents[2]

pytestmark = pytest.mark.integration


def test_flights_stay_near_their_plan_whatever_the_beat_of_the_filter(limits, monkeypatch):
    """The filter works every 10 ms, and poses come at any moment in between: that is worth 5 ms.

    Slalom has the sharpest turns of flights/. Five beats, each with sensors, radio and cameras of a seed of its own.
    """
    mission = prepare_mission(REPOSITORY / "flights" / "slalom.yaml", limits)
    deviations = []
    for seed in range(5):
        monkeypatch.setattr(stepped_lab, "_WARM_UP", 200 + 2 * seed)  # ms
        lab = stepped_lab.SteppedLab(
            limits.airframe, vehicle=VehicleSettings(seed=seed), cameras=ViconSettings(seed=seed), seed=seed
        )
        lab.disturb(RadioFault(RadioFaultKind.LOSS, size=0.05))
        deviations.append(fly_stepped(mission, lab=lab).outcome.deviation.max)
    assert np.mean(deviations) <= 0.03  # m
    assert max(deviations) <= 0.04
