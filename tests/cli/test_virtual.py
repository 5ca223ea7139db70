"""`cfplan virtual` says in words that its supervisor has locked, wherever its output goes."""

import pytest

from cfplan.cli.virtual import LOCKED, StateLine
from cfplan.simulation.virtual_crazyflie.supervisor import State

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
