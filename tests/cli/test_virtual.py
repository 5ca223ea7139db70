"""`cfplan virtual` says in words that its supervisor has locked, wherever its output goes, and who stands where."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cfplan.cli.virtual import LOCKED, StateLine, VirtualRoom
from cfplan.errors import InputError
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.virtual_crazyflie.supervisor import State

SAFETY = Path(__file__).parents[2] / "safety.yaml"
FLIGHT = [State.READY_TO_FLY, State.FLYING, State.FLYING, State.WARNING_LEVEL_OUT, State.LOCKED, State.LOCKED]


@pytest.mark.parametrize("terminal", [False, True])
def test_a_locked_supervisor_is_said_once_with_what_to_do(capsys, monkeypatch, terminal):
    monkeypatch.setattr("sys.stderr.isatty", lambda: terminal, raising=False)
    line = StateLine()
    for state in FLIGHT:
        line.show(state, [0.0, 1.0, 0.5])
    told = capsys.readouterr().err
    assert told.count(LOCKED) == 1
    assert ("0.00 1.00 0.50 m, flying" in told) is terminal
    if not terminal:
        assert told.splitlines() == ["ready to fly", "flying", "warning level out", "locked", LOCKED]


def test_one_of_several_vehicles_is_named(capsys):
    line = StateLine("cf2")
    for state in FLIGHT:
        line.show(state, [0.0, 1.0, 0.5])
    assert capsys.readouterr().err.splitlines()[:2] == ["cf2: ready to fly", "cf2: flying"]


@pytest.mark.parametrize("wide", [8.0, 3.0])
@pytest.mark.parametrize("count", [1, 2, 5])
def test_vehicles_stand_apart_inside_the_space(count, wide):
    limits = load_limits(SAFETY)
    space = replace(limits.space, low=(-2.0, -wide / 2, 0.0), high=(2.0, wide / 2, 2.0))
    room = VirtualRoom(replace(limits, space=space), 19850, count, None)
    places = np.array(room.places())
    assert len(places) == count
    assert not places[0].any()
    assert (space.beyond(places)[:, :2] <= 1e-9).all()
    apart = np.linalg.norm(places[:, None] - places, axis=2) + 9.0 * np.eye(count)
    assert apart.min() >= 0.5


def test_vehicles_for_which_there_are_no_ports_are_refused():
    with pytest.raises(InputError, match="need ports to 65537"):
        VirtualRoom(load_limits(SAFETY), 65528, 5, None).require_ports()
