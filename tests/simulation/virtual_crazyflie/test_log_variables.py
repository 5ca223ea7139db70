"""Tables, parameters and log blocks, packet by packet."""

import errno
import struct

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cfplan.flight.radio.crtp import LARGEST_PAYLOAD, Port, pack
from cfplan.simulation.virtual_crazyflie.log_blocks import MAX_BYTES, log_toc
from cfplan.simulation.virtual_crazyflie.parameters import parameter_toc
from cfplan.simulation.virtual_crazyflie.toc import make_toc

LOG, PARAMETERS = log_toc(), parameter_toc()
_SETTINGS = 1
FLOAT, UINT16 = 7, 2


def log_id(name):
    return LOG.index()[name]


def parameter_id(name):
    return PARAMETERS.index()[name]


def log_command(rig, *data):
    """The error code of a command about log blocks."""
    return rig.send(Port.LOG, _SETTINGS, bytes(data))[-1][3]


def create(rig, number, *names, kind=FLOAT, command=6):
    items = b"".join(struct.pack("<BH", kind, log_id(name)) for name in names)
    return log_command(rig, command, number, *items)


def data_packets(rig):
    return [packet for packet in rig.received if packet[0] >> 4 == Port.LOG and packet[0] & 3 == 2]


def read(rig, name):
    answer = rig.send(Port.PARAMETERS, 1, struct.pack("<H", parameter_id(name)))[0][1:]
    assert answer[2] == 0
    return struct.unpack(PARAMETERS.variables[parameter_id(name)].format, answer[3:])[0]


def test_the_tables_are_as_long_as_a_real_crazyflies():
    assert 550 <= len(LOG.variables) <= 700
    assert 300 <= len(PARAMETERS.variables) <= 400


@pytest.mark.parametrize("toc", [LOG, PARAMETERS], ids=["log", "parameters"])
def test_each_entry_fits_a_packet_and_no_name_comes_twice(toc):
    for number in range(len(toc.variables)):
        assert len(toc.answer(struct.pack("<BH", 2, number))) <= LARGEST_PAYLOAD
    assert len(toc.index()) == len(toc.variables)


def test_another_table_has_another_checksum():
    assert make_toc(LOG.variables[1:]).checksum != make_toc(LOG.variables).checksum


@pytest.mark.parametrize(
    "name",
    [
        "stateEstimateZ.x", "stateEstimate.vz", "stateEstimate.qw", "kalman.varPX", "pm.vbat", "pm.vbatMV",
        "supervisor.info", "motor.m4", "locSrvZ.tick", "ctrltarget.x", "gyro.x", "acc.z", "stabilizer.yaw",
    ],
)  # fmt: skip
def test_the_log_variables_that_pilots_use_are_there(name):
    assert name in LOG.index()


@pytest.mark.parametrize(
    "name",
    [
        "stabilizer.controller", "stabilizer.estimator", "ctrlMel.mass", "ctrlMel.massThrust", "kalman.initialYaw",
        "kalman.resetEstimation", "locSrv.extPosStdDev", "locSrv.extQuatStdDev", "hlCommander.groupmask",
        "commander.enHighLevel", "supervisor.tmblChckEn", "stabilizer.stop", "flightmode.stabModeRoll",
    ],
)  # fmt: skip
def test_the_parameters_that_pilots_use_are_there(name):
    assert name in PARAMETERS.index()


def test_an_index_beyond_the_table_is_answered_by_the_command_alone(rig):
    assert rig.send(Port.LOG, 0, struct.pack("<BH", 2, 60000))[0][1:] == b"\x02"


def test_a_written_value_is_echoed_and_read_back(rig):
    payload = struct.pack("<Hf", parameter_id("ctrlMel.mass"), 0.0333)
    assert rig.send(Port.PARAMETERS, 2, payload)[0][1:] == payload
    assert read(rig, "ctrlMel.mass") == pytest.approx(0.0333)
    assert rig.vehicle.firmware.stabilizer.loop.gains[0] == pytest.approx(0.0333)


def test_a_read_only_parameter_is_left_alone_in_silence(rig):
    number = parameter_id("cpu.flash")
    assert rig.send(Port.PARAMETERS, 2, struct.pack("<HH", number, 7)) == []
    assert read(rig, "cpu.flash") == 0


def test_an_unknown_parameter_is_said_to_be_missing(rig):
    assert rig.send(Port.PARAMETERS, 1, struct.pack("<H", 9999))[0][3] == errno.ENOENT


def test_a_value_cut_short_changes_nothing(rig):
    before = read(rig, "ctrlMel.mass")
    assert rig.send(Port.PARAMETERS, 2, struct.pack("<HB", parameter_id("ctrlMel.mass"), 1)) == []
    assert read(rig, "ctrlMel.mass") == before


def test_defaults_stay_what_they_were(rig):
    rig.set("ctrlMel.mass", 0.05)
    answer = rig.send(Port.PARAMETERS, 3, struct.pack("<BH", 8, parameter_id("ctrlMel.mass")))[0][1:]
    assert answer[3] == 0
    assert struct.unpack("<f", answer[4:])[0] == pytest.approx(0.029)


def test_a_parameter_can_be_stored_looked_up_and_cleared(rig):
    number = struct.pack("<H", parameter_id("ctrlMel.mass"))
    rig.set("ctrlMel.mass", 0.04)
    assert rig.send(Port.PARAMETERS, 3, b"\x03" + number)[0][4] == 0
    state = rig.send(Port.PARAMETERS, 3, b"\x04" + number)[0][1:]
    assert state[3] == 1
    assert struct.unpack("<ff", state[4:]) == pytest.approx((0.029, 0.04))
    assert rig.send(Port.PARAMETERS, 3, b"\x05" + number)[0][4] == 0
    assert rig.send(Port.PARAMETERS, 3, b"\x04" + number)[0][4] == 0


def test_only_stored_parameters_say_so(rig):
    stored, plain = parameter_id("ctrlMel.mass"), parameter_id("locSrv.extPosStdDev")
    assert rig.send(Port.PARAMETERS, 3, struct.pack("<BH", 7, stored))[0][4:] == b"\x00\x01"
    assert rig.send(Port.PARAMETERS, 3, struct.pack("<BH", 7, plain))[0][4] == errno.ENOENT


def test_a_parameter_can_be_set_by_name(rig):
    assert rig.send(Port.PARAMETERS, 3, b"\x00ctrlMel\0mass\0\x06" + struct.pack("<f", 0.03))[0][-1] == 0
    assert read(rig, "ctrlMel.mass") == pytest.approx(0.03)
    assert rig.send(Port.PARAMETERS, 3, b"\x00ctrlMel\0none\0\x06" + bytes(4))[0][-1] == errno.ENOENT
    assert rig.send(Port.PARAMETERS, 3, b"\x00ctrlMel\0mass\0\x08\x01")[0][-1] == errno.EINVAL


def test_automatic_controller_and_estimator_are_one(rig):
    rig.set("stabilizer.controller", 0)
    rig.set("stabilizer.estimator", 0)
    assert read(rig, "stabilizer.controller") == read(rig, "stabilizer.estimator") == 1


def test_resetting_the_estimate_clears_itself(rig):
    rig.set("kalman.initialX", 3.0)
    rig.feeding = False
    rig.set("kalman.resetEstimation", 1)
    assert read(rig, "kalman.resetEstimation") == 0
    rig.run(0.01)
    assert rig.belief[0] == pytest.approx(3.0, abs=0.01)


def test_a_block_sends_its_values_every_period_by_the_vehicles_clock(rig):
    assert create(rig, 5, "stateEstimate.z", "kalman.varX") == 0
    assert log_command(rig, 3, 5, 1) == 0
    rig.run(1.0)
    packets = data_packets(rig)
    stamps = [int.from_bytes(packet[2:5], "little") for packet in packets]
    assert 99 <= len(packets) <= 100
    assert set(np.diff(stamps)) == {10}
    assert {packet[1] for packet in packets} == {5}
    assert struct.unpack("<f", packets[-1][5:9])[0] == pytest.approx(rig.belief[2], abs=1e-3)


def test_blocks_stop_start_and_go(rig):
    create(rig, 1, "pm.vbat")
    log_command(rig, 3, 1, 2)
    rig.run(0.5)
    assert log_command(rig, 4, 1) == 0
    before = len(data_packets(rig))
    rig.run(0.5)
    assert len(data_packets(rig)) == before == pytest.approx(25, abs=1)
    assert log_command(rig, 2, 1) == 0
    assert log_command(rig, 2, 1) == errno.ENOENT
    assert log_command(rig, 3, 1, 1) == errno.ENOENT


def test_a_reset_forgets_all_blocks(rig):
    create(rig, 1, "pm.vbat")
    assert rig.send(Port.LOG, _SETTINGS, b"\x05")[0][1:] == b"\x05\x00\x00"
    assert log_command(rig, 3, 1, 1) == errno.ENOENT


def test_bad_blocks_have_the_firmwares_error_codes(rig):
    assert create(rig, 1, "pm.vbat") == 0
    assert create(rig, 1, "pm.vbat") == errno.EEXIST
    assert log_command(rig, 7, 9, FLOAT, 0, 0) == errno.ENOENT
    assert log_command(rig, 6, 2, FLOAT, 0xEE, 0xEE) == errno.ENOENT
    assert log_command(rig, 0, 2) == errno.ENOEXEC  # version 1 is gone
    six = ["stateEstimate.x", "stateEstimate.y", "stateEstimate.z", "stateEstimate.vx", "stateEstimate.vy"]
    assert create(rig, 3, *six, "stateEstimate.vz") == 0
    assert create(rig, 3, "pm.vbatMV", kind=UINT16, command=7) == 0
    assert create(rig, 3, "pm.vbatMV", kind=UINT16, command=7) == errno.E2BIG
    log_command(rig, 3, 3, 1)
    rig.run(0.05)
    assert max(len(packet) for packet in data_packets(rig)) == 1 + 4 + MAX_BYTES


def test_there_are_sixteen_blocks_and_no_more(rig):
    assert [create(rig, number, "pm.vbat") for number in range(17)] == [0] * 16 + [errno.ENOMEM]


def test_a_variable_can_be_fetched_in_another_type(rig):
    create(rig, 1, "pm.vbatMV", kind=FLOAT)
    log_command(rig, 3, 1, 1)
    rig.run(0.05)
    assert 4000 < struct.unpack("<f", data_packets(rig)[-1][5:])[0] < 4200


def logged_now(rig, *names):
    """{name: value as it is logged}, and what the vehicle believes at that moment."""
    blocks = [names[first : first + MAX_BYTES // 4] for first in range(0, len(names), MAX_BYTES // 4)]
    for number, block in enumerate(blocks):
        assert create(rig, number, *block) == 0
        log_command(rig, 3, number, 1)
    before = len(data_packets(rig))
    while len(data_packets(rig)) == before:
        belief = rig.belief.copy()
        rig.run(0.001)
    came = data_packets(rig)[before:]
    assert len(came) == len(blocks)
    values = {}
    for block, packet in zip(blocks, came, strict=True):
        values |= dict(zip(block, struct.unpack(f"<{len(block)}f", packet[5:]), strict=True))
    return values, belief


def test_values_have_the_firmwares_units_and_signs(hovering):
    hovering.go_to(0.5, 0.0, 1.0, yaw=0.6, duration=1.5)
    hovering.run(0.6)
    value, belief = logged_now(
        hovering, "stateEstimateZ.x", "stateEstimateZ.rateYaw", "stateEstimateZ.ratePitch", "gyro.z", "acc.z",
        "stateEstimate.az", "stateEstimateZ.az", "stabilizer.pitch", "stateEstimate.vx", "stateEstimate.yaw",
        "motor.m1", "pm.vbat", "ctrltarget.mode_x",
    )  # fmt: skip
    assert value["stateEstimateZ.x"] == pytest.approx(1000 * belief[0])
    assert value["stateEstimateZ.rateYaw"] == pytest.approx(1000 * belief[12])
    assert value["stateEstimateZ.ratePitch"] == pytest.approx(-1000 * belief[11])  # legacy sign
    assert value["gyro.z"] == pytest.approx(np.degrees(belief[12]))
    assert 0.8 < value["acc.z"] < 1.2  # g
    assert abs(value["stateEstimate.az"]) < 0.2  # g, gravity taken off
    assert 8000 < value["stateEstimateZ.az"] < 12000  # mm/s², gravity left in
    assert value["stabilizer.pitch"] * value["stateEstimate.vx"] < 0 or value["stateEstimate.vx"] < 0.05
    assert value["stateEstimate.yaw"] == pytest.approx(np.degrees(2 * np.arctan2(belief[8], belief[9])), abs=2)
    assert 30000 < value["motor.m1"] < 60000
    assert value["pm.vbat"] < 4.05  # it sags under load
    assert value["ctrltarget.mode_x"] == 1


def test_the_battery_empties_in_flight_and_not_on_the_floor(hovering):
    before = hovering.vehicle.battery.charge
    hovering.run(3.0)
    used = before - hovering.vehicle.battery.charge
    assert 240 < 3.0 / used < 900  # s of hover in a full battery: 4 to 15 minutes


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(header=st.integers(0, 255), payload=st.binary(max_size=40))
def test_no_packet_upsets_the_vehicle(rig, header, payload):
    rig.vehicle.receive(bytes((header,)) + payload)
    rig.vehicle.advance(20)
    assert all(1 <= len(packet) <= 1 + LARGEST_PAYLOAD for packet in rig.vehicle.sent())
    assert np.all(np.isfinite(rig.truth))
    assert np.all(np.isfinite(rig.belief))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e30])
def test_nonsense_numbers_leave_the_vehicle_finite(hovering, bad):
    create(hovering, 1, "ctrltargetZ.x", "ctrltargetZ.vy", "ctrltarget.yaw", kind=UINT16)
    create(hovering, 2, "stateEstimateZ.x", "controller.cmd_thrust", "stateEstimate.x", kind=8)
    for number in (1, 2):
        log_command(hovering, 3, number, 1)
    for port, channel, payload in (
        (Port.SETPOINT, 0, struct.pack("<Bffff", 7, bad, 0.0, 1.0, 0.0)),
        (Port.SETPOINT, 0, struct.pack("<Bffff", 8, 0.0, bad, 0.0, bad)),
        (Port.SETPOINT, 0, struct.pack("<BfffHB", 11, bad, 0.0, bad, 40000, 0)),
        (Port.SETPOINT, 1, struct.pack("<BI", 0, 0)),
        (Port.HIGH_LEVEL, 0, struct.pack("<BBBBfffff", 12, 0, 0, 0, bad, 0.0, 1.0, 0.0, 1.0)),
        (Port.HIGH_LEVEL, 0, struct.pack("<BBBBfffff", 12, 0, 0, 1, 0.0, 0.0, 1.0, bad, bad)),
        (Port.LOCALIZATION, 0, struct.pack("<fff", bad, 0.0, 1.0)),
        (Port.LOCALIZATION, 1, struct.pack("<B7f", 8, 0.0, 0.0, 1.0, bad, 0.0, 0.0, 1.0)),
        (Port.PARAMETERS, 2, struct.pack("<Hf", parameter_id("ctrlMel.mass"), bad)),
        (Port.PARAMETERS, 2, struct.pack("<Hf", parameter_id("kalman.initialX"), bad)),
        (Port.PARAMETERS, 2, struct.pack("<HB", parameter_id("kalman.resetEstimation"), 1)),
    ):
        hovering.send(port, channel, payload)
        hovering.run(0.1)
        assert np.all(np.isfinite(hovering.truth)), payload


def test_link_and_platform_answer_as_clients_expect(rig):
    assert rig.send(Port.LINK, 1, b"\0")[0][1:19] == b"Bitcraze Crazyflie"
    assert rig.send(Port.LINK, 0, b"ping")[0][1:] == b"ping"
    assert rig.send(Port.PLATFORM, 1, b"\0")[0][1:] == b"\0" + struct.pack("<i", 12)
    assert rig.send(Port.PLATFORM, 1, b"\1")[0][1:] == b"\0012026.08"
    assert pack(Port.SETPOINT, 0, b"")[0] == 0x7C


def test_memories_are_listed_written_and_read(rig):
    assert rig.send(Port.MEMORY, 0, b"\1")[0][1:] == b"\1\2"
    details = rig.send(Port.MEMORY, 0, b"\2\1")[0][1:]
    assert details[2] == 0x12
    assert struct.unpack("<I", details[3:7])[0] == 4096
    assert rig.send(Port.MEMORY, 2, struct.pack("<BI", 1, 100) + b"hello")[0][-1] == 0
    assert rig.send(Port.MEMORY, 1, struct.pack("<BIB", 1, 100, 5))[0][7:] == b"hello"
    assert rig.send(Port.MEMORY, 2, struct.pack("<BI", 1, 4095) + b"hello")[0][-1] != 0
