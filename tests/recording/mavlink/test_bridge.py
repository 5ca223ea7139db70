"""MAVLink: frames, what is told at which rate, which commands stop a flight, and that nothing else does anything."""

import math
import socket
import subprocess
import sys
from collections import Counter, deque
from pathlib import Path

import numpy as np
import psutil
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common
from scipy.spatial.transform import Rotation

from cfplan.errors import InputError
from cfplan.flight.clock import SteppedClock
from cfplan.flight.pilot.keys import Order
from cfplan.flight.radio.supervisor_bits import ARMED, FLYING, LOCKED
from cfplan.flight.telemetry import Estimate, Event, Level, Phase, PhaseEntered, SetpointSent, VehicleStatus
from cfplan.recording.importers.formats import read_log
from cfplan.recording.mavlink.bridge import GroundStation, Place, messages_in, parse_place
from cfplan.recording.mavlink.commands import FORCE, Result, answer
from cfplan.recording.mavlink.frames import attitude, euler, frd, in_body, ned
from cfplan.recording.mavlink.messages import RATES, Latest, status_texts

SCRIPTS = Path(sys.executable).parent
NED = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
FRD = Rotation.from_matrix([[1, 0, 0], [0, -1, 0], [0, 0, -1]])
triples = st.tuples(*[st.floats(-100, 100)] * 3)
turns = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)

LAND, TERMINATE, ARM, TAKE_OFF = 21, 185, 400, 22


# frames


@given(triples, turns)
def test_frames_are_those_of_rotation_matrices(vector, turn):
    q = Rotation.from_quat(turn)
    w, x, y, z = attitude(tuple(q.as_quat()))
    assert (Rotation.from_quat([x, y, z, w]) * (NED * q * FRD).inv()).magnitude() < 1e-7
    np.testing.assert_allclose(ned(vector), NED.apply(vector))
    np.testing.assert_allclose(frd(vector), FRD.apply(vector))
    np.testing.assert_allclose(in_body(vector, tuple(q.as_quat())), q.inv().apply(vector), atol=1e-9)


@given(st.floats(-3, 3), st.floats(-1.5, 1.5), st.floats(-3, 3))
def test_angles_are_those_of_the_attitude(roll, pitch, yaw):
    x, y, z, w = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_quat()
    np.testing.assert_allclose(euler((w, x, y, z)), (roll, pitch, yaw), atol=1e-6)


def test_what_turns_left_from_the_east_heads_north():
    level_east, level_north = (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))
    assert euler(attitude(level_east)) == pytest.approx((0, 0, math.pi / 2))
    assert euler(attitude(level_north)) == pytest.approx((0, 0, 0))


# commands


@pytest.mark.parametrize(
    ("command", "parameters", "order"),
    [(LAND, (0, 0), Order.LAND), (TERMINATE, (1, 0), Order.CUT), (ARM, (0, FORCE), Order.CUT)],
)
def test_what_stops_a_flight_is_accepted(command, parameters, order):
    found = answer(command, parameters)
    assert (found.result, found.order) == (Result.ACCEPTED, order)
    assert found.text


@pytest.mark.parametrize(
    ("command", "parameters"),
    [
        (ARM, (1, 0)), (ARM, (1, FORCE)), (ARM, (0, 0)), (ARM, (0, 1)), (ARM, (math.nan, FORCE)), (ARM, (0, math.nan)),
        (TERMINATE, (0, 0)), (TERMINATE, (math.nan, 0)), (TAKE_OFF, (0, 0)), (20, (0, 0)), (176, (1, 6)),
        (192, (0, 0)), (209, (1, 0)), (246, (1, 0)), (300, (0, 0)),
    ],
)  # fmt: skip
def test_what_arms_moves_or_is_half_a_stop_is_denied(command, parameters):
    found = answer(command, parameters)
    assert (found.result, found.order) == (Result.DENIED, None)


@given(st.integers(0, 65535), st.floats(width=32), st.floats(width=32))
def test_only_three_commands_give_orders_whatever_their_parameters(command, first, second):
    found = answer(command, (first, second))
    if found.order is not None:
        assert found.result is Result.ACCEPTED
        assert command in (LAND, TERMINATE, ARM)
        assert found.order is (Order.LAND if command == LAND else Order.CUT)
        assert command != ARM or (first == 0 and second == FORCE)
    elif found.result is Result.ACCEPTED:
        assert found.message is not None


# packets


def packed(message, *, system=255, component=190, version_1=False):
    return message.pack(common.MAVLink(None, srcSystem=system, srcComponent=component), force_mavlink1=version_1)


def long(command, *parameters, target=(1, 1)):
    return common.MAVLink(None).command_long_encode(*target, command, 0, *parameters, *[0] * (7 - len(parameters)))


@settings(max_examples=300)
@given(st.binary(max_size=400), st.binary(max_size=400), st.booleans())
def test_a_command_is_found_whatever_garbage_lies_around_it(before, after, version_1):
    stop = packed(long(TERMINATE, 1), version_1=version_1)
    found = [packet for packet, _ in messages_in(before + stop + after)]
    assert stop in found


@given(st.binary(max_size=600))
def test_garbage_is_no_message(data):
    assert list(messages_in(data)) == []


@given(st.data())
def test_a_packet_with_one_changed_byte_is_no_command(data):
    stop = bytearray(packed(long(TERMINATE, 1)))
    place = data.draw(st.integers(1, len(stop) - 1))
    stop[place] ^= data.draw(st.integers(1, 255))
    assert [message for _, message in messages_in(bytes(stop)) if message.get_type() == "COMMAND_LONG"] == []


# the link


class Station:
    """A ground station made of a socket and pymavlink, on the clock of the vehicle's link."""

    def __init__(self, clock):
        self.clock = clock
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.setblocking(False)
        self.vehicle = None
        self.heard = []
        self.unseen = deque()

    @property
    def place(self):
        return Place("127.0.0.1", self.socket.getsockname()[1])

    def listen(self, duration):
        """Hear what comes in so long."""
        end = self.clock.now() + duration
        while self.clock.readable([self.socket], end - self.clock.now()):
            data, self.vehicle = self.socket.recvfrom(2048)
            messages = [message for _, message in messages_in(data)]
            self.heard += messages
            self.unseen += messages

    def wait_for(self, kind):
        """The first message of a kind that was not waited for yet; what came before it is done with."""
        end = self.clock.now() + 5.0
        while self.unseen or self.clock.now() < end:
            while self.unseen:
                message = self.unseen.popleft()
                if message.get_type() == kind:
                    return message
            self.listen(0.01)
        raise AssertionError(f"no {kind}")

    def send(self, data):
        while self.vehicle is None:
            self.listen(0.01)
        self.socket.sendto(data, self.vehicle)

    def command(self, command, *parameters):
        self.send(packed(long(command, *parameters)))
        return self.wait_for("COMMAND_ACK")


@pytest.fixture
def clock():
    return SteppedClock()


@pytest.fixture
def station(clock):
    made = Station(clock)
    yield made
    made.socket.close()


@pytest.fixture
def link(station, tmp_path):
    with GroundStation(station.place, tmp_path / "a.tlog", clock=station.clock) as made:
        yield made
    assert made.failure == ""


def hover(link, time, turn=(0.0, 0.0, 0.0, 1.0), bits=ARMED | FLYING):
    link.show(Estimate(time, (1.0, 2.0, 0.5), (0.1, 0.2, 0.3), (0.0, 0.0, 0.0), turn))
    link.show(VehicleStatus(time, (0.4, 0.5, 0.6), (30000,) * 4, 3.9, bits))


def test_a_ground_station_learns_where_the_vehicle_is(station, link):
    hover(link, station.clock.now())
    link.show(PhaseEntered(station.clock.now(), Phase.STREAM))
    link.show(SetpointSent(0.0, 0.0, 5, (1.0, 2.0, 3.0), (4.0, 5.0, 6.0), (7.0, 8.0, 9.0), (0, 0, 0, 1.0), (0, 0, 0)))
    link.show(Event(0.0, Level.WARNING, "the battery is low"))
    station.listen(1.5)
    told = {message.get_type(): message for message in station.heard}
    place = told["LOCAL_POSITION_NED"]
    assert (place.x, place.y, place.z, place.vx, place.vy, place.vz) == pytest.approx((2, 1, -0.5, 0.2, 0.1, -0.3))
    turn = told["ATTITUDE_QUATERNION"]
    assert (turn.q1, turn.q2, turn.q3, turn.q4) == pytest.approx((math.sqrt(0.5), 0, 0, math.sqrt(0.5)))
    assert (turn.rollspeed, turn.pitchspeed, turn.yawspeed) == pytest.approx((0.4, -0.5, -0.6))
    assert told["ATTITUDE"].yaw == pytest.approx(math.pi / 2)
    odometry = told["ODOMETRY"]
    assert (odometry.frame_id, odometry.child_frame_id) == (1, 12)
    assert (odometry.vx, odometry.vy, odometry.vz) == pytest.approx((0.1, -0.2, -0.3))
    wanted = told["POSITION_TARGET_LOCAL_NED"]
    assert (wanted.x, wanted.y, wanted.z) == (2, 1, -3)
    assert (wanted.afx, wanted.afy, wanted.afz) == (8, 7, -9)
    assert told["BATTERY_STATUS"].voltages[0] == 3900
    assert told["SYS_STATUS"].voltage_battery == 3900
    assert told["EXTENDED_SYS_STATE"].landed_state == common.MAV_LANDED_STATE_IN_AIR
    assert told["HEARTBEAT"].base_mode & common.MAV_MODE_FLAG_SAFETY_ARMED
    texts = [(m.severity, m.text) for m in station.heard if m.get_type() == "STATUSTEXT"]
    assert (common.MAV_SEVERITY_WARNING, "the battery is low") in texts


def test_each_kind_comes_at_its_rate(station, link):
    sent = SetpointSent(0.0, 0.0, 5, (0.0,) * 3, (0.0,) * 3, (0.0,) * 3, (0, 0, 0, 1.0), (0.0,) * 3)
    estimate = Estimate(0.0, (0.0,) * 3, (0.0,) * 3, (0.0,) * 3, (0.0, 0.0, 0.0, 1.0))
    status = VehicleStatus(0.0, (0.0,) * 3, (0,) * 4, 4.0, 0)
    for message in (sent, estimate, status):
        link.show(message)
    station.listen(0.3)
    station.heard.clear()
    station.listen(3.0)
    kinds = [message.get_type() for message in station.heard]
    mav, latest = common.MAVLink(None), Latest(0.0, estimate=estimate, status=status, setpoint=sent)
    for make, rate in RATES:
        kind = make(mav, latest).get_type()
        assert abs(kinds.count(kind) - 3 * rate) <= 1, kind


@pytest.mark.parametrize(
    ("bits", "state"),
    [(0, common.MAV_STATE_STANDBY), (ARMED | FLYING, common.MAV_STATE_ACTIVE), (LOCKED, 8)],
)
def test_the_heartbeat_says_what_the_supervisor_says(bits, state):
    latest = Latest(0.0, status=VehicleStatus(0.0, (0.0,) * 3, (0,) * 4, 4.0, bits))
    heartbeat = RATES[0][0](common.MAVLink(None), latest)
    assert heartbeat.system_status == state
    assert bool(heartbeat.base_mode & common.MAV_MODE_FLAG_SAFETY_ARMED) == bool(bits & ARMED)


def test_before_the_vehicle_has_spoken_there_is_only_a_heartbeat(station, link):
    station.listen(1.2)
    assert {message.get_type() for message in station.heard} == {"HEARTBEAT", "EXTENDED_SYS_STATE"}


@pytest.mark.parametrize(
    ("command", "parameters", "order"),
    [(LAND, (), Order.LAND), (TERMINATE, (1,), Order.CUT), (ARM, (0, FORCE), Order.CUT)],
)
def test_a_stop_is_acknowledged_and_becomes_an_order(station, link, command, parameters, order):
    reply = station.command(command, *parameters)
    assert (reply.command, reply.result) == (command, common.MAV_RESULT_ACCEPTED)
    assert (reply.target_system, reply.target_component) == (255, 190)
    assert link.orders() == [order]
    assert link.orders() == []


def test_commands_in_the_other_form_and_of_the_first_version_are_obeyed(station, link):
    integer = common.MAVLink(None).command_int_encode(1, 1, 0, TERMINATE, 0, 0, 1, 0, 0, 0, 0, 0, 0)
    station.send(packed(integer))
    assert station.wait_for("COMMAND_ACK").result == common.MAV_RESULT_ACCEPTED
    station.send(packed(long(LAND), version_1=True))
    assert station.wait_for("COMMAND_ACK").result == common.MAV_RESULT_ACCEPTED
    assert link.orders() == [Order.CUT, Order.LAND]


@pytest.mark.parametrize(("command", "parameters"), [(ARM, (1,)), (ARM, (1, FORCE)), (ARM, (0,)), (TAKE_OFF, ())])
def test_arming_and_taking_off_are_denied_and_order_nothing(station, link, command, parameters):
    assert station.command(command, *parameters).result == common.MAV_RESULT_DENIED
    assert link.orders() == []


def test_every_command_is_answered_known_or_not(station, link):
    for command in (511, 31000, 65535):
        assert station.command(command).result == common.MAV_RESULT_UNSUPPORTED
    assert station.command(512, 148).result == common.MAV_RESULT_ACCEPTED
    assert station.wait_for("AUTOPILOT_VERSION")
    assert link.orders() == []


def test_a_command_for_another_vehicle_is_not_ours(station, link):
    station.send(packed(long(TERMINATE, 1, target=(2, 1))))
    station.listen(0.3)
    assert "COMMAND_ACK" not in [message.get_type() for message in station.heard]
    assert link.orders() == []


def test_messages_that_would_move_a_vehicle_do_nothing(station, link):
    mav = common.MAVLink(None)
    for message in (
        mav.set_position_target_local_ned_encode(0, 1, 1, 1, 0, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0, 0),
        mav.manual_control_encode(1, 0, 0, 1000, 0, 0),
        mav.set_mode_encode(1, 128, 0),
    ):
        station.send(packed(message))
    station.listen(0.3)
    assert link.orders() == []


def test_garbage_does_not_keep_a_stop_from_coming_through(station, link):
    rng = np.random.default_rng(1)
    for size in (0, 1, 7, 300, 1400):
        station.send(rng.bytes(size))
        station.send(b"\xfd\xff" + rng.bytes(size))  # begins as a packet that never ends
    assert station.command(TERMINATE, 1).result == common.MAV_RESULT_ACCEPTED
    assert link.orders() == [Order.CUT]


def test_values_that_cannot_be_packed_do_not_keep_a_stop_from_coming_through(station, tmp_path):
    with GroundStation(station.place, tmp_path / "a.tlog", clock=station.clock) as link:
        hover(link, station.clock.now())
        link.show(Estimate(0.0, (1e300, 0.0, 0.0), (math.inf,) * 3, (0.0,) * 3, (math.nan,) * 4))
        assert station.command(TERMINATE, 1).result == common.MAV_RESULT_ACCEPTED
        assert link.orders() == [Order.CUT]
    assert "fault" in link.failure


def test_nobody_who_listens_is_no_failure(tmp_path, clock):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        place = Place("127.0.0.1", probe.getsockname()[1])
    with GroundStation(place, tmp_path / "a.tlog", clock=clock) as link:
        hover(link, clock.now())
        clock.sleep(3.0)
    assert link.failure == ""
    assert (tmp_path / "a.tlog").stat().st_size > 0


def test_only_this_machine_is_heard_unless_told(station):
    def bound():
        return Counter(each.laddr.ip for each in psutil.Process().net_connections("udp"))

    before = bound()
    for place, heard in ((station.place, "127.0.0.1"), (Place("192.0.2.1", 14550), "0.0.0.0")):
        with GroundStation(place, clock=station.clock):
            assert list(bound() - before) == [heard]


def test_nobody_but_the_ground_station_stops_a_flight(station, link):
    station.listen(0.1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:  # as any user of this machine may open
        other.bind(("127.0.0.1", 0))
        other.sendto(packed(long(TERMINATE, 1)), station.vehicle)
        station.clock.sleep(0.3)
        assert link.orders() == []
        assert link.heard == 0
        assert station.clock.readable([other], 0.0) == []
    assert station.command(TERMINATE, 1).result == common.MAV_RESULT_ACCEPTED
    assert link.orders() == [Order.CUT]


# the log


PLACES = 25  # of the vehicle, in the log


@pytest.fixture
def log(station, tmp_path):
    """A .tlog of a turning vehicle with a ground station that speaks too."""
    file, clock = tmp_path / "flight.tlog", station.clock
    with GroundStation(station.place, file, boot=clock.now(), clock=clock) as link:
        for step in range(10 * PLACES):
            along = step / 1000
            turn = tuple(Rotation.from_euler("z", along).as_quat())
            now = clock.now()
            link.show(Estimate(now, (along, 2 * along, 0.5), (1.0, 2.0, 0.0), (0.0,) * 3, turn))
            link.show(VehicleStatus(now, (0.0, 0.0, 1.0), (30000,) * 4, 3.9, ARMED | FLYING))
            link.show(Event(now, Level.INFO, "a text that does not fit into one message, as it is too long ≤ ψ"))
            station.listen(0.01)
        station.command(ARM, 1)
    assert link.failure == ""
    return file


def test_mavlogdump_reads_the_log_and_nothing_is_lost(station, log):
    dumped = subprocess.run(
        [sys.executable, SCRIPTS / "mavlogdump.py", "--types", "LOCAL_POSITION_NED,COMMAND_LONG,COMMAND_ACK", log],
        capture_output=True, text=True, timeout=60, check=True,
    )  # fmt: skip
    lines = dumped.stdout.splitlines()
    assert sum("LOCAL_POSITION_NED" in line for line in lines) >= PLACES
    assert sum("COMMAND_LONG" in line for line in lines) == 1
    assert sum("COMMAND_ACK" in line for line in lines) == 1
    lost = subprocess.run(
        [sys.executable, SCRIPTS / "mavloss.py", log], capture_output=True, text=True, timeout=60, check=True
    )
    assert " 0 lost" in lost.stdout, lost.stdout


def test_the_log_reads_back_as_the_flight_that_it_was(log):
    subjects = {subject.name: subject for subject in read_log(log).subjects}
    for name in ("vehicle 1", "vehicle 1 odometry"):
        found = subjects[name]
        assert len(found.time) >= PLACES
        x, y, z = found.position.T
        np.testing.assert_allclose(y, 2 * x, atol=1e-5)
        np.testing.assert_allclose(z, 0.5, atol=1e-6)
    turned = Rotation.from_quat(subjects["vehicle 1 odometry"].quaternion).as_euler("ZYX")[:, 0]
    np.testing.assert_allclose(turned, subjects["vehicle 1 odometry"].position[:, 0], atol=1e-5)


@given(st.text(max_size=300))
def test_status_texts_come_together_again(text):
    parts = status_texts(common.MAVLink(None), 6, text, 7)
    assert b"".join(part._text_raw for part in parts).decode() == text
    assert all(len(part._text_raw) <= 50 for part in parts)
    assert len(parts) == 1 or [part.chunk_seq for part in parts] == list(range(len(parts)))


def test_a_log_is_not_overwritten(station, tmp_path):
    (tmp_path / "a.tlog").write_text("mine")
    with pytest.raises(InputError, match=r"a\.tlog: cannot be written"):
        GroundStation(station.place, tmp_path / "a.tlog")
    assert (tmp_path / "a.tlog").read_text() == "mine"


@pytest.mark.parametrize(
    "text",
    ["", "udp", "udp:", "udp:14550", "udp:127.0.0.1", "tcp:127.0.0.1:5760", "udp:127.0.0.1:0", "udp:h:99999", "14550"],
)  # fmt: skip
def test_what_is_no_place_is_an_error_with_an_example(text):
    with pytest.raises(InputError) as caught:
        parse_place(text)
    assert "udp:127.0.0.1:14550" in caught.value.hint


def test_without_the_extra_the_error_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "pymavlink.dialects.v20", None)
    with pytest.raises(InputError, match="pymavlink") as caught:
        GroundStation(Place("127.0.0.1", 14550))
    assert "cfplan[mavlink]" in caught.value.hint
