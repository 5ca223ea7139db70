"""`cfplan virtual` says in words that its supervisor has locked, wherever its output goes, and who stands where."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from cfplan.cli.virtual import FLOW_DECK, LOCKED, StateLine, VirtualRoom, virtual
from cfplan.errors import InputError
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_crazyflie.supervisor import State
from cfplan.simulation.virtual_crazyflie.vehicle import VirtualCrazyflie

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
    assert ("(0.00, 1.00, 0.50) m, flying" in told) is terminal
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
    with pytest.raises(InputError, match="need ports to 65536"):
        VirtualRoom(load_limits(SAFETY), 65532, 5, None).require_ports()


def test_a_flow_deck_is_a_parameter_that_says_so():
    for flow_deck in (False, True):
        settings = VehicleSettings(stored={FLOW_DECK: 1.0} if flow_deck else {})
        vehicle = VirtualCrazyflie(load_limits(SAFETY).airframe, settings)
        assert vehicle.firmware.parameters[FLOW_DECK] == flow_deck


def test_no_vehicle_has_a_flow_deck_and_its_poses_by_radio_alone():
    ended = CliRunner().invoke(virtual, ["--flow-deck", "--vicon", "8010", "--safety", str(SAFETY), "--seconds", "0.1"])
    assert isinstance(ended.exception, InputError)
    assert "no flow deck" in str(ended.exception)


def test_without_a_safety_yaml_the_vehicle_of_the_examples_is_served(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ended = CliRunner().invoke(virtual, ["--port", "19958", "--seconds", "0.1"])
    assert ended.exit_code == 0, ended.output
    assert f"{load_limits(SAFETY).vehicle} cf1: --uri udp://127.0.0.1:19958" in ended.output
