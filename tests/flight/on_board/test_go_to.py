"""A stop by go-to, as certified, is the one that the vehicle's commander flies, however fast yaw turns."""

import numpy as np
import pytest

from cfplan.flight.on_board import commands
from cfplan.flight.on_board.go_to import STOP_DURATION, go_to_states, stop_targets
from cfplan.flight.on_board.memory_format import raw_bytes
from cfplan.flight.on_board.pieces import Pieces
from cfplan.simulation.virtual_crazyflie.high_level import Goal, HighLevelCommander
from cfplan.simulation.virtual_crazyflie.setpoints import YAW


@pytest.mark.parametrize("rate", [0.0, 2.0, -6.2, 6.4, -8.0])
def test_a_stop_is_flown_as_certified(rate):
    begin = np.zeros((1, 3, 4))
    begin[0, :2] = (0.3, -0.2, 1.0, 2.5), (1.0, 0.5, 0.0, rate)
    target = stop_targets(begin)
    certified = go_to_states(begin, target, STOP_DURATION, 101)[0, :, 0, 3]
    steady = np.zeros((1, 4, 8))
    steady[0, :, :2] = begin[0, :2].T
    commander = HighLevelCommander(
        bytearray(raw_bytes(Pieces(np.array([5.0]), steady))), lambda: Goal(*np.zeros((4, 4)))
    )
    for command in (
        commands.define(1, compressed=False), commands.start(), commands.go_to(*target[0].tolist(), STOP_DURATION),
    ):  # fmt: skip
        assert commander.receive(command, 0.0, blocked=False)[3] == commands.DONE
    flown = np.unwrap([commander.setpoint(time).values[YAW] for time in np.linspace(0.0, STOP_DURATION, 101)])
    assert flown - flown[0] == pytest.approx(certified - certified[0], abs=1e-3)
