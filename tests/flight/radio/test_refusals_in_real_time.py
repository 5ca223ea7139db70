"""Hardware that is not there is known within five seconds."""

import time

import pytest
from click.testing import CliRunner

from cfplan.cli import cfplan
from cfplan.errors import LinkError
from cfplan.flight.radio.connection import connect

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("uri", ["radio://0/80/2M/E7E7E7E7E7", "udp://127.0.0.1:9", "nonsense"])
def test_a_vehicle_that_cannot_be_reached(uri):
    began = time.monotonic()
    with pytest.raises(LinkError):
        connect(uri, lambda message: None)
    assert time.monotonic() - began < 5.0


@pytest.mark.parametrize("system", ["vicon", "vicon-sdk"])
def test_a_vicon_that_is_not_there(tmp_path, system):
    (tmp_path / "path.yaml").write_text("waypoints: [[0, 0, 1], [1, 0, 1]]\n")
    words = ["fly", tmp_path / "path.yaml", "--records", tmp_path / "records", "--yes"]
    began = time.monotonic()
    result = CliRunner().invoke(cfplan, [*map(str, words), "--mocap", f"{system}://127.0.0.1:9/cf1"])
    assert time.monotonic() - began < 5.0
    assert isinstance(result.exception, LinkError)
    assert not (tmp_path / "records").exists()
