"""The lab as a process, and unmodified cflib on it; and its loop on the stepped clock."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import textwrap

import cflib.crtp
import numpy as np
import psutil
import pytest
from cflib.crazyflie import Crazyflie
from cflib.crazyflie.log import LogConfig
from cflib.crazyflie.syncCrazyflie import SyncCrazyflie
from cflib.crazyflie.syncLogger import SyncLogger
from waiting import PATIENCE, a_moment, until

from cfplan.errors import InputError, LinkError
from cfplan.flight.clock import SteppedClock
from cfplan.simulation.lab.lab import ROW_SIZE, start_lab
from cfplan.simulation.lab.process import LabLoop
from cfplan.simulation.lab.room import lab_address
from cfplan.simulation.lab.sim_driver import SimDriver, register_sim_driver
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_vicon.cameras import Cameras, ViconSettings
from cfplan.vehicle.airframes import AIRFRAMES

pytestmark = pytest.mark.integration
AIRFRAME = AIRFRAMES["crazyflie-2.1+"]
EMPTY = b"\xf3"  # an echo without data


def test_cflib_connects_and_sees_tables_parameters_and_supervisor(link):
    assert len([name for group in link.log.toc.toc.values() for name in group]) > 550
    assert len([name for group in link.param.toc.toc.values() for name in group]) > 300
    assert link.platform.get_protocol_version() == 12
    assert link.param.is_updated
    assert link.param.get_value("stabilizer.estimator") == "1"
    assert link.supervisor.can_fly
    assert link.supervisor.is_armed
    assert not link.supervisor.is_flying


def test_parameters_are_set_and_read_back_and_have_defaults(link, set_and_read_back):
    set_and_read_back("ctrlMel.mass", 0.031)
    answers = []
    link.param.get_default_value("ctrlMel.mass", lambda name, value: answers.append((name, value)))
    assert until(lambda: answers)
    assert answers[0][1] == pytest.approx(0.029)
    states = []
    link.param.persistent_store("ctrlMel.mass", lambda name, done: states.append(done))
    assert until(lambda: states)
    link.param.persistent_get_state("ctrlMel.mass", lambda name, state: states.append(state))
    assert until(lambda: len(states) == 2)
    assert states[1].is_stored
    assert states[1].stored_value == pytest.approx(0.031)


def test_log_blocks_come_at_100_hz_by_the_vehicles_clock(link):
    blocks, stamps = [], {"one": [], "two": []}
    for name, variables in (
        ("one", ["stateEstimateZ.x", "stateEstimateZ.quat", "stateEstimateZ.vz", "pm.vbatMV", "supervisor.info"]),
        ("two", ["stateEstimate.x", "stateEstimate.y", "stateEstimate.z", "kalman.varX", "locSrvZ.tick"]),
    ):
        block = LogConfig(name, 10)
        for variable in variables:
            block.add_variable(variable)
        link.log.add_config(block)
        block.data_received_cb.add_callback(lambda stamp, data, which: stamps[which.name].append(stamp))
        block.start()
        blocks.append(block)
    assert until(lambda: min(map(len, stamps.values())) > 100)
    for block in blocks:
        block.stop()
    for values in stamps.values():
        assert set(np.diff(values)) == {10}


def test_a_synchronous_logger_reads_values(link):
    block = LogConfig("battery", 50)
    block.add_variable("pm.vbat", "float")
    with SyncLogger(link, block) as logger:
        _, data, _ = next(iter(logger))
    assert 3.9 < data["pm.vbat"] < 4.3


def test_the_link_closes_and_opens_again(lab):
    for _ in range(2):
        with SyncCrazyflie(lab.uri, cf=Crazyflie()) as sync:
            sync.wait_for_params()
            assert sync.cf.param.is_updated


def test_a_lab_that_dies_is_a_lost_connection(doomed, doomed_link):
    cf, lost = doomed_link
    os.kill(doomed.process_id, signal.SIGKILL)
    assert lost.wait(PATIENCE)
    cf.close_link()
    with pytest.raises(LinkError):
        doomed.truth()


def refusal(uri):
    """Why cflib could not open the link."""
    reasons = []
    cf = Crazyflie()
    cf.connection_failed.add_callback(lambda link_uri, why: reasons.append(why))
    cf.open_link(uri)
    assert reasons
    return reasons[0]


def test_links_that_cannot_be_say_why(monkeypatch):
    register_sim_driver()
    monkeypatch.setenv("CFPLAN_SIM_7", "127.0.0.1:9")
    assert "no vehicle answers" in refusal("sim://7")
    monkeypatch.setenv("CFPLAN_SIM_7", "nonsense")
    assert "host:port" in refusal("sim://7")
    assert "no such virtual vehicle" in refusal("sim://one")


def test_the_driver_is_registered_once_and_finds_the_lab(lab):
    register_sim_driver()
    assert cflib.crtp.CLASSES.count(SimDriver) == 1
    assert ["sim://0", "virtual Crazyflie"] in SimDriver().scan_interface()


def test_a_link_without_a_lab_brings_its_own(monkeypatch):
    register_sim_driver()
    monkeypatch.delenv("CFPLAN_SIM_3", raising=False)
    before = set(psutil.Process().children())
    with SyncCrazyflie("sim://3", cf=Crazyflie()) as sync:
        (own,) = set(psutil.Process().children()) - before
        assert sync.cf.log.toc is not None
        sync.wait_for_params()  # else cflib's thread that asks for them ends in an exception
    assert not own.is_running()
    assert "CFPLAN_SIM_3" not in os.environ


@pytest.fixture
def stepped(monkeypatch):
    """Makes the loop of a lab, which runs on a stepped clock as sim://4; returns both."""

    def make(cameras=None, **settings):
        clock = SteppedClock()
        loop = LabLoop(AIRFRAME, VehicleSettings(**settings), on_board=cameras is not None, clock=clock)
        loop.cameras = Cameras(cameras, clock.now()) if cameras is not None else None
        monkeypatch.setenv("CFPLAN_SIM_4", f"127.0.0.1:{loop.port}")

        def serve():
            loop.serve()
            return loop.until_due()

        clock.repeat(serve, name="lab", wake=loop.link)
        opened.append(loop)
        return loop, clock

    opened = []
    yield make
    for loop in opened:
        loop.link.close()


def test_a_vehicle_with_poses_on_board_knows_where_it_stands(stepped):
    loop, clock = stepped(ViconSettings(latency=0.03), position=(1.0, 2.0, 0.0))
    clock.sleep(5.0)
    assert loop.vehicle.firmware.stabilizer.loop.belief[:2].tolist() == pytest.approx([1.0, 2.0], abs=0.02)


class StallingClock:
    """The clock of a computer that stalls for 30 ms before every reading."""

    def __init__(self):
        self.time = 0.0

    def now(self):
        self.time += 0.03
        return self.time


def test_the_cameras_see_all_vehicles_at_one_moment_even_if_the_computer_stalls():
    clock = StallingClock()
    loop, other = (LabLoop(AIRFRAME, VehicleSettings(), clock=clock) for _ in range(2))
    ticks = []

    class RecordingCameras(Cameras):
        def look(self, *seen):
            ticks.append((loop.vehicle.tick, other.vehicle.tick))
            super().look(*seen)

    with loop.link, other.link:
        loop.companions, loop.cameras = {"other": other}, RecordingCameras(ViconSettings(), 0.0)
        for _ in range(10):
            loop.serve()
    assert len(ticks) > 20
    assert all(first == second for first, second in ticks)


def test_a_vehicle_that_stands_still_is_recorded_a_hundred_times_a_second(stepped):
    loop, clock = stepped()
    clock.sleep(1.0)
    rows = np.frombuffer(loop.record.rows()).reshape(-1, ROW_SIZE)
    assert len(rows) == pytest.approx(100, abs=1)
    assert np.allclose(np.diff(rows[:, 0]), 0.01, atol=1e-6)


def test_a_client_that_falls_silent_is_forgotten_after_two_seconds(stepped):
    loop, clock = stepped()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.setblocking(False)
        client.sendto(EMPTY, ("127.0.0.1", loop.port))
        told = b""
        for wait, text in ((1.9, "soon"), (0.15, "late")):
            clock.sleep(wait)
            loop.vehicle.firmware.say(text)
            clock.sleep(0.05)
            with contextlib.suppress(BlockingIOError):
                while packet := client.recv(64):
                    told += packet
        assert b"soon" in told
        assert b"late" not in told


def test_a_lab_whose_computer_stood_still_loses_the_time_that_it_cannot_catch_up(stepped):
    loop, clock = stepped()
    clock.sleep(0.5)
    before = loop.vehicle.tick
    clock.reach(clock.now() + 0.2)  # is caught up with
    clock.sleep(0.1)
    assert loop.vehicle.tick - before == pytest.approx(300, abs=2)
    before = loop.vehicle.tick
    clock.reach(clock.now() + 5.0)
    clock.sleep(0.1)
    assert loop.vehicle.tick - before == pytest.approx(100, abs=11)


def test_a_second_lab_of_a_number_hides_the_first_until_it_closes(lab):
    with start_lab(AIRFRAME) as second:
        assert lab_address(0) == ("127.0.0.1", second.port)
        second.close()
    assert lab_address(0) == ("127.0.0.1", lab.port)


def test_an_address_that_is_none_is_refused(monkeypatch):
    assert lab_address(9) is None
    monkeypatch.setenv("CFPLAN_SIM_9", "somewhere")
    with pytest.raises(InputError):
        lab_address(9)


def process_runs(number):
    return subprocess.run(["ps", "-o", "stat=", "-p", str(number)], capture_output=True, text=True).stdout[:1] not in (
        "",
        "Z",
    )


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM, None])
def test_the_lab_ends_with_the_process_that_started_it(end):
    program = textwrap.dedent(
        """
        import time
        from cfplan.simulation.lab.lab import start_lab
        from cfplan.vehicle.airframes import AIRFRAMES
        lab = start_lab(AIRFRAMES["crazyflie-2.1+"])
        print(lab.process_id, flush=True)
        time.sleep({0})
        """
    ).format(0 if end is None else 60)
    parent = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    number = int(parent.stdout.readline())
    if end is not None:
        assert process_runs(number)
        parent.send_signal(end)
    parent.wait()
    parent.stdout.close()
    assert until(lambda: not process_runs(number))


def test_ctrl_c_is_not_the_labs_to_obey(lab):
    os.kill(lab.process_id, signal.SIGINT)
    a_moment()
    assert lab.alive
