"""Another implementation of the firmware takes the place of cfplan's own, in the stepped lab and in the process."""

import os
import re
import shutil
import socket
import struct
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from firmware_doubles import IN_C, Counting, Failing
from septic_flight import septic_payloads
from stepped_flight import fly_stepped
from waiting import PATIENCE, until

from cfplan.errors import ExitCode, InputError
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.radio.crtp import Port, pack
from cfplan.flight.radio.parameter_tables import TableCache
from cfplan.flight.radio.restart import POWER, POWER_CHANNEL, SYSTEM_OFF, SYSTEM_ON
from cfplan.flight.setpoints.packets import decode
from cfplan.flight.setpoints.stops import encode_stops
from cfplan.safety.limits import GroundManoeuvres
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.lab.lab import start_lab
from cfplan.simulation.lab.stepped_lab import SteppedLab
from cfplan.simulation.lab.stepped_link import connect
from cfplan.simulation.virtual_crazyflie.faults import VehicleFault, VehicleFaultKind
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_crazyflie.supervisor import State
from cfplan.simulation.virtual_crazyflie.vehicle import VirtualCrazyflie
from cfplan.simulation.virtual_crazyflie.virtual_firmware import VirtualFirmware
from cfplan.vehicle.airframes import AIRFRAMES
from cfplan.vehicle.motor_commands import compensated_pwm

pytestmark = pytest.mark.integration
AIRFRAME = AIRFRAMES["crazyflie-2.1+"]
REPOSITORY = Path(__file__).parents[3]
QUICK = GroundManoeuvres(take_off_height=0.5, take_off_speed=0.6, go_to_speed=0.6, land_speed=0.6)
LIMITS = replace(load_limits(REPOSITORY / "safety.yaml"), ground=QUICK)


def flown(mission, make):
    lab = SteppedLab(AIRFRAME, vehicle=VehicleSettings(make_firmware=make))
    return lab.vehicle, fly_stepped(mission, lab=lab)


def test_a_flight_needs_nothing_but_the_interface():
    moving = septic_payloads(1.2, 2.5, 0.6)
    payloads = np.concatenate([moving, np.repeat(moving[-1:], 30, axis=0)])
    mission = Mission(payloads, encode_stops(decode(payloads), 100.0), LIMITS, hold_time=0.3)
    _, ours = flown(mission, VirtualFirmware)
    vehicle, theirs = flown(mission, Counting)
    assert theirs.outcome.exit_code is ExitCode.OK
    assert theirs.truth.position[-1, 2] < 0.02
    assert np.array_equal(ours.truth.position, theirs.truth.position)
    assert np.array_equal(ours.truth.supervisor, theirs.truth.supervisor)
    assert ours.telemetry == theirs.telemetry
    calls, off = vehicle.firmware.calls, 1000
    assert calls["restart"] == 1
    assert vehicle.tick - calls["tick"] == pytest.approx(off, abs=20)
    assert calls["receive"] > 1000 < calls["sent"]


def test_its_tables_are_read_where_they_are_not_those_of_cfplans_own():
    def older(airframe, settings):
        return Counting(airframe, VehicleSettings(protocol=10, firmware="2025.12"))

    lab = SteppedLab(AIRFRAME, vehicle=VehicleSettings(make_firmware=older))
    begun = lab.now
    assert connect(lab, lambda message: None).firmware == "2025.12"
    took = lab.now - begun
    connect(lab, lambda message: None, TableCache())
    assert took == pytest.approx(lab.now - begun - took, rel=0.1)


def test_a_restart_takes_its_power_from_it_and_starts_it_anew():
    vehicle = VirtualCrazyflie(AIRFRAME, VehicleSettings(make_firmware=Counting))

    def switch(command):
        vehicle.receive(pack(Port.LINK, POWER_CHANNEL, bytes((POWER, command))))
        assert vehicle.sent() == [pack(Port.LINK, POWER_CHANNEL, bytes((POWER, command)))]

    vehicle.advance(200)
    switch(SYSTEM_OFF)
    vehicle.advance(500)
    vehicle.receive(pack(Port.LINK, 0, b"ping"))
    assert vehicle.supervisor_state is State.NOT_INITIALIZED
    assert vehicle.firmware.calls == Counter(tick=200)
    switch(SYSTEM_ON)
    switch(SYSTEM_ON)
    vehicle.advance(1000)
    assert vehicle.supervisor_state is State.READY_TO_FLY
    assert vehicle.firmware.calls == Counter(tick=1200, restart=1)


def test_its_own_faults_are_refused_unless_it_simulates_them_and_those_of_the_body_are_not():
    for make, simulates in ((Counting, False), (Failing, True)):
        vehicle = VirtualCrazyflie(AIRFRAME, VehicleSettings(make_firmware=make))
        vehicle.advance(200)
        vehicle.inject(VehicleFault(VehicleFaultKind.MOTOR, 0.0, 1.0, 0.5))
        lock = VehicleFault(VehicleFaultKind.LOCK, 0.0)
        if simulates:
            vehicle.inject(lock)
        else:
            with pytest.raises(InputError, match="Counting: this firmware does not simulate"):
                vehicle.inject(lock)
        vehicle.advance(20)
        assert vehicle.efficiency[0] == 0.5
        assert vehicle.locked is simulates


def test_the_environment_names_it_for_all_vehicles_and_settings_overrule_it(monkeypatch):
    monkeypatch.setenv("CFPLAN_FIRMWARE", "firmware_doubles:Counting")
    assert isinstance(SteppedLab(AIRFRAME).vehicle.firmware, Counting)
    own = VehicleSettings(make_firmware=VirtualFirmware)
    assert isinstance(SteppedLab(AIRFRAME, vehicle=own).vehicle.firmware, VirtualFirmware)


@pytest.mark.parametrize("name", ["firmware_doubles", "firmware_doubles:NoSuch", "no_such_module:make", ":", "a b:c"])
def test_a_name_that_is_none_is_refused(name, monkeypatch):
    monkeypatch.setenv("CFPLAN_FIRMWARE", name)
    with pytest.raises(InputError, match="CFPLAN_FIRMWARE") as caught:
        VirtualCrazyflie(AIRFRAME)
    assert "package.module:factory" in caught.value.hint


def test_the_labs_process_runs_it(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join((str(REPOSITORY / "tests"), str(REPOSITORY))))
    monkeypatch.setenv("CFPLAN_FIRMWARE", "firmware_doubles:Reversed")
    with start_lab(AIRFRAME, number=8) as lab, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.settimeout(PATIENCE)
        client.sendto(pack(Port.LINK, 0, b"abc"), ("127.0.0.1", lab.port))
        assert client.recv(64) == pack(Port.LINK, 0, b"cba")
        assert until(lambda: State.READY_TO_FLY in lab.latest().supervisor)
    monkeypatch.setenv("CFPLAN_FIRMWARE", "firmware_doubles:NoSuch")
    with pytest.raises(InputError, match="NoSuch"):
        start_lab(AIRFRAME, number=8)


@pytest.fixture
def library(tmp_path, monkeypatch):
    """The module of the page docs/virtual.md beside a library, chosen by the environment."""
    compiler = shutil.which("gcc")
    if compiler is None:
        pytest.skip("there is no gcc")
    (tmp_path / "firmware.c").write_text(IN_C)
    subprocess.run([compiler, "-shared", "-fPIC", "-o", "firmware.so", "firmware.c"], cwd=tmp_path, check=True)
    page = (REPOSITORY / "docs" / "virtual.md").read_text(encoding="utf-8")
    (module,) = re.findall(r"^```python\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    (tmp_path / "my_firmware.py").write_text(module)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("CFPLAN_FIRMWARE", "my_firmware:make")
    yield
    sys.modules.pop("my_firmware", None)


def pwm_packet(thrust: float) -> bytes:
    """A packet that asks for a fraction of the weight."""
    share = thrust * AIRFRAME.hover_thrust / AIRFRAME.motor_thrust_max
    return b"\x00" + struct.pack("<H", round(compensated_pwm(share, 3.95, AIRFRAME)))


@pytest.mark.usefixtures("library")
def test_a_library_in_c_flies_and_lands_in_the_stepped_lab():
    lab = SteppedLab(AIRFRAME)
    heard = []
    lab.heard = heard.append
    for thrust, seconds in ((1.2, 1.5), (0.9, 3.0), (0.0, 0.5)):
        lab.radio.send(b"\x00\x00\x00" if not thrust else pwm_packet(thrust))
        lab.clock.sleep(seconds)
    truth = lab.truth()
    assert len(heard) == 3
    assert truth.position[:, 2].max() > 0.5
    assert truth.position[-1, 2] == 0.0
    assert np.abs(truth.quaternion[:, :2]).max() < 0.05
    assert not truth.motor[-1].any()
    assert State.FLYING in truth.supervisor
    assert truth.supervisor[-1] == State.LANDED


@pytest.mark.usefixtures("library")
def test_vehicles_that_load_the_same_library_share_none_of_its_variables():
    one, other = VirtualCrazyflie(AIRFRAME), VirtualCrazyflie(AIRFRAME)
    one.receive(pwm_packet(1.2))
    one.advance(10)
    other.advance(10)
    assert one.motors.all()
    assert not other.motors.any()
