"""The restart by radio, by cflib's own code: to a virtual vehicle, and where nothing answers."""

import socket

import pytest
from waiting import until

from cfplan.errors import LinkError
from cfplan.flight.radio.connection import connect
from cfplan.flight.radio.restart import restart_vehicle
from cfplan.flight.radio.supervisor_bits import LOCKED
from cfplan.simulation.lab.lab import start_lab
from cfplan.simulation.lab.sim_driver import SimDriver
from cfplan.simulation.virtual_crazyflie.supervisor import State
from cfplan.vehicle.airframes import AIRFRAMES


@pytest.mark.parametrize("scheme", ["sim", "udp"])
def test_a_vehicle_that_its_watchdog_locked_is_there_again_after_a_restart(scheme):
    with start_lab(AIRFRAMES["crazyflie-2.1+"], number=7) as lab:
        uri = lab.uri if scheme == "sim" else f"udp://127.0.0.1:{lab.port}"
        link = connect(uri, lambda message: None, [SimDriver])
        link.keep_alive()
        assert until(lambda: lab.latest().supervisor[-1] == State.LOCKED)
        link.close()
        link.restart()
        again = connect(uri, lambda message: None, [SimDriver])
        again.start_logs()
        assert until(lambda: again.status is not None)
        assert not again.status.supervisor & LOCKED
        again.close()


def test_where_nothing_answers_it_says_what_to_do():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as silent:
        silent.bind(("127.0.0.1", 0))
        with pytest.raises(LinkError, match="cannot be restarted") as caught:
            restart_vehicle(f"udp://127.0.0.1:{silent.getsockname()[1]}")
    assert "by hand" in caught.value.hint
