"""One of cflib's own examples on a lab's UDP port; those that fly are in test_examples_in_real_time.py."""

import pytest
from cflib_examples import run_example

from cfplan.errors import InputError
from cfplan.simulation.lab.lab import start_lab
from cfplan.simulation.lab.room import RoomSettings
from cfplan.vehicle.airframes import AIRFRAMES

AIRFRAME = AIRFRAMES["crazyflie-2.1+"]

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def served():
    with start_lab(AIRFRAME, room=RoomSettings(on_board=True), number=6) as lab:
        yield lab


def test_the_parameter_example_writes_and_reads_back(served, tmp_path):
    assert "Read back: pid_attitude.pitch_kd=0.1234" in run_example("parameters/basicparam.py", served, tmp_path)


def test_a_port_that_is_taken_is_an_error_with_a_hint(served):
    with pytest.raises(InputError, match=f"port {served.port}") as caught:
        start_lab(AIRFRAME, number=7, port=served.port)
    assert "--port" in caught.value.hint
