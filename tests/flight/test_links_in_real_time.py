"""How soon a link is known to fail, and how soon it closes."""

import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from cflib.crazyflie import Crazyflie
from cflib.crazyflie.syncCrazyflie import SyncCrazyflie
from hanging_server import hanging_server
from waiting import PATIENCE

from cfplan.cli import cfplan
from cfplan.errors import LinkError
from cfplan.flight.mocap.source import pose_source
from cfplan.flight.radio.connection import connect
from cfplan.safety.limits import PoseLimits
from cfplan.simulation.lab.lab import start_lab
from cfplan.simulation.lab.sim_driver import register_sim_driver
from cfplan.vehicle.airframes import AIRFRAMES

pytestmark = [pytest.mark.integration, pytest.mark.slow]

AIRFRAME = AIRFRAMES["crazyflie-2.1+"]
LIMITS = PoseLimits(
    rate=100.0, rate_min=80.0, latency=0.01, age_warning=0.05, age_brake=0.15, age_land=0.5, jump=0.15,
    agreement=0.05, yaw_agreement=0.17,
)  # fmt: skip


def seconds_to_fail(act: Callable[[], object], match: str = "") -> float:
    began = time.monotonic()
    with pytest.raises(LinkError, match=match):
        act()
    return time.monotonic() - began


def no_vehicle(uri: str) -> Callable[[Path], float]:
    return lambda _: seconds_to_fail(lambda: connect(uri, lambda message: None))


def no_vicon(system: str) -> Callable[[Path], float]:
    def fly(folder: Path) -> float:
        (folder / "path.yaml").write_text("waypoints: [[0, 0, 1], [1, 0, 1]]\n")
        words = ["fly", folder / "path.yaml", "--records", folder / "records", "--yes"]
        words += ["--mocap", f"{system}://127.0.0.1:9/cf1"]
        seconds = seconds_to_fail(lambda: cfplan.main([*map(str, words)], standalone_mode=False))
        assert not (folder / "records").exists()
        return seconds

    return fly


def vendors_client_hangs(then_close: bool) -> Callable[[Path], float]:
    def open_source(_: Path) -> float:
        with hanging_server(then_close) as uri:
            return seconds_to_fail(pose_source(uri, LIMITS).open, r"no answer|no frame")

    return open_source


def lab_hangs(_: Path) -> float:
    register_sim_driver()
    lost = threading.Event()
    with start_lab(AIRFRAME, number=5) as lab, SyncCrazyflie(lab.uri, cf=Crazyflie()) as sync:
        sync.wait_for_params()
        sync.cf.connection_lost.add_callback(lambda uri, why: lost.set())
        began = time.monotonic()
        os.kill(lab.process_id, signal.SIGSTOP)
        try:
            assert lost.wait(PATIENCE)
            return time.monotonic() - began
        finally:
            os.kill(lab.process_id, signal.SIGCONT)


def link_closes(_: Path) -> float:
    register_sim_driver()
    longest = 0.0
    with start_lab(AIRFRAME, number=5) as lab:
        for _ in range(2):
            with SyncCrazyflie(lab.uri, cf=Crazyflie()) as sync:
                sync.wait_for_params()
                began = time.monotonic()
            longest = max(longest, time.monotonic() - began)
    return longest


@pytest.mark.parametrize(
    ("attempt", "within"),
    [
        pytest.param(no_vehicle("radio://0/80/2M/E7E7E7E7E7"), 5.0, id="no radio"),
        pytest.param(no_vehicle("udp://127.0.0.1:9"), 5.0, id="no vehicle"),
        pytest.param(no_vehicle("nonsense"), 5.0, id="no URI"),
        pytest.param(no_vicon("vicon"), 5.0, id="no vicon"),
        pytest.param(no_vicon("vicon-sdk"), 5.0, id="no vicon for the vendor's client"),
        pytest.param(vendors_client_hangs(False), 5.0, id="the vendor's client gets no frame"),
        pytest.param(vendors_client_hangs(True), 5.0, id="the vendor's client looks for its server for ever"),
        pytest.param(lab_hangs, 5.0, id="a lab hangs"),
        pytest.param(link_closes, 0.5, id="a link closes"),
    ],
)
def test_a_link_fails_or_closes_soon(attempt, within, tmp_path):
    assert attempt(tmp_path) < within
