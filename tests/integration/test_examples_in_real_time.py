"""cflib's own examples fly the virtual Crazyflie, by its high-level commander, by setpoints and by velocities."""

import re

import numpy as np
import pytest
from cflib_examples import run_example

from cfplan.cli.virtual import FLOW_DECK
from cfplan.simulation.lab.lab import Truth, start_lab
from cfplan.simulation.lab.room import RoomSettings
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.vehicle.airframes import AIRFRAMES

SEQUENCE = [(0.0, 0.0, 1.2), (0.5, -0.5, 1.2), (0.5, 0.5, 1.2), (-0.5, 0.5, 1.2), (-0.5, -0.5, 1.2), (0.0, 0.0, 0.4)]

pytestmark = [pytest.mark.integration, pytest.mark.slow]


def stands_and_says_so(truth: Truth, said: str) -> None:
    heights = [float(value) for value in re.findall(r"stateEstimate\.z: (-?[\d.]+)", said)]
    assert len(heights) > 20
    assert np.abs(heights).max() < 0.05


def goes_to_each_place(truth: Truth, said: str) -> None:
    for place in SEQUENCE:
        assert np.linalg.norm(truth.position - place, axis=1).min() < 0.1


def flies_its_figure(truth: Truth, said: str) -> None:
    assert truth.position[:, 2].max() == pytest.approx(1.0, abs=0.1)
    assert np.ptp(truth.position[:, 0]) > 1.5
    assert truth.off_in_air[-1] == 0


def goes_by_velocities(truth: Truth, said: str) -> None:
    """By MotionCommander and the firmware's PID: 0.3 m up, 0.8 m ahead and back, 0.5 m up."""
    for place in ((0.0, 0.0, 0.3), (0.8, 0.0, 0.3), (0.0, 0.0, 0.8)):
        assert np.linalg.norm(truth.position - place, axis=1).min() < 0.2


def rises_where_there_is_a_flow_deck(truth: Truth, said: str) -> None:
    """By MotionCommander, half a metre up, which it does only where the vehicle says that it has the deck."""
    assert "Deck is attached!" in said
    assert truth.position[:, 2].max() == pytest.approx(0.5, abs=0.15)


@pytest.mark.parametrize(
    ("example", "holds"),
    [
        ("logging/basiclog.py", stands_and_says_so),
        ("autonomy/autonomous_sequence.py", goes_to_each_place),
        ("autonomy/autonomous_sequence_high_level.py", flies_its_figure),
        ("autonomy/motion_commander_demo.py", goes_by_velocities),
        ("step-by-step/sbs_motion_commander.py", rises_where_there_is_a_flow_deck),
    ],
)
def test_an_example_of_cflib_flies_and_lands(example, holds, tmp_path):
    vehicle = VehicleSettings(stored={FLOW_DECK: 1.0})
    with start_lab(AIRFRAMES["crazyflie-2.1+"], vehicle=vehicle, room=RoomSettings(on_board=True), number=6) as lab:
        said = run_example(example, lab, tmp_path)
        truth = lab.truth()
    holds(truth, said)
    assert truth.position[-1, 2] < 0.05
    assert not truth.locked
