"""A CRTP session over a transport that loses, repeats, cuts and swallows packets; behind it a virtual Crazyflie."""

import itertools
import struct

import pytest

from cfplan.errors import LinkError
from cfplan.flight.clock import SteppedClock
from cfplan.flight.radio.connection import FIRST_ANSWER_TIMEOUT
from cfplan.flight.radio.crtp import Port, pack
from cfplan.flight.radio.parameter_tables import TableCache
from cfplan.flight.radio.session import TABLES_TIMEOUT, Session
from cfplan.simulation.virtual_crazyflie.vehicle import VirtualCrazyflie
from cfplan.vehicle.airframes import AIRFRAMES

URI = "test://0"
TABLE_ITEM = 2  # command on channel 0 of the log's and the parameters' ports


def is_item(packet: bytes) -> bool:
    return packet[0] >> 4 in (Port.LOG, Port.PARAMETERS) and packet[0] & 3 == 0 and packet[1] == TABLE_ITEM


class Wire:
    """A transport without delay; `up` and `down` return the packets that come of one."""

    def __init__(self):
        self.vehicle = VirtualCrazyflie(AIRFRAMES["crazyflie-2.1+"])
        self.up = self.down = lambda packet: [packet]
        self.sent: list[bytes] = []

    def listen(self, hear, fail):
        self._hear, self.fail = hear, fail

    def send(self, packet):
        self.sent.append(packet)
        for each in self.up(packet):
            self.vehicle.receive(each)
            for answer in self.vehicle.sent():
                for heard in self.down(answer):
                    self._hear(heard)

    def close(self):
        pass


@pytest.fixture
def wire():
    return Wire()


@pytest.fixture
def clock():
    return SteppedClock()


@pytest.fixture
def session(wire, clock):
    return Session(wire, URI, clock)


def test_it_opens_and_knows_versions_and_tables(wire, session):
    session.open(FIRST_ANSWER_TIMEOUT, TableCache())
    assert (session.protocol, session.firmware) == (12, "2026.08")
    for found, toc in (
        (session.parameters, wire.vehicle.firmware.parameters.toc),
        (session.log_variables, wire.vehicle.firmware.log.toc),
    ):
        assert found == {entry.full_name: (number, entry.code) for number, entry in enumerate(toc.variables)}


def test_where_each_packet_is_lost_once_and_then_doubled_everything_still_comes(wire, session):
    lost = set()

    def fitful(packet):
        if packet in lost:
            return [packet, packet]
        lost.add(packet)
        return []

    wire.up = wire.down = fitful
    known = TableCache()
    Session(fresh := Wire(), URI, SteppedClock()).open(
        FIRST_ANSWER_TIMEOUT, known
    )  # each item lost twice would take too long
    assert fresh.sent
    session.open(FIRST_ANSWER_TIMEOUT, known)
    session.write_parameter("ctrlMel.mass", 0.0345, 2.0)
    assert session.read_parameter("ctrlMel.mass", 2.0) == pytest.approx(0.0345)
    content = bytes(range(100))
    assert session.write_trajectory_memory(content) == content
    assert bytes(wire.vehicle.firmware.memories.trajectory[:100]) == content


def test_a_known_table_is_not_read_again_also_by_another_process(wire, session, tmp_path):
    session.open(FIRST_ANSWER_TIMEOUT, TableCache(tmp_path))
    items = sum(map(is_item, wire.sent))
    assert items > 100
    again = Session(wire, URI, SteppedClock())
    again.open(FIRST_ANSWER_TIMEOUT, TableCache(tmp_path))
    assert sum(map(is_item, wire.sent)) == items
    assert again.parameters == session.parameters


@pytest.mark.parametrize("spoil", [lambda path: path.write_text("{"), lambda path: path.write_text('{"a.b": [1, 2]}')])
def test_a_cached_table_that_is_damaged_is_read_from_the_vehicle(wire, session, tmp_path, spoil):
    session.open(FIRST_ANSWER_TIMEOUT, TableCache(tmp_path))
    for path in tmp_path.iterdir():
        spoil(path)
    again = Session(wire, URI, SteppedClock())
    again.open(FIRST_ANSWER_TIMEOUT, TableCache(tmp_path))
    assert again.parameters == session.parameters


def test_a_table_of_which_half_is_answered_is_an_error_within_its_time(wire, session, clock):
    count = itertools.count()
    wire.down = lambda packet: [] if is_item(packet) and next(count) >= 50 else [packet]
    began = clock.now()
    with pytest.raises(LinkError, match="its tables do not come through") as caught:
        session.open(FIRST_ANSWER_TIMEOUT, TableCache())
    assert clock.now() - began == pytest.approx(TABLES_TIMEOUT, abs=0.05)
    assert caught.value.hint


@pytest.mark.parametrize("length", [4, 5, 7])
def test_a_table_that_is_cut_short_is_named_as_damaged(wire, session, length):
    wire.down = lambda packet: [packet[: 1 + length] if is_item(packet) else packet]
    with pytest.raises(LinkError, match="tables are damaged"):
        session.open(FIRST_ANSWER_TIMEOUT, TableCache())


def test_a_link_that_goes_while_an_answer_is_awaited_is_an_error_at_once(wire, session, clock):
    session.open(FIRST_ANSWER_TIMEOUT, TableCache())
    wire.up = lambda packet: []
    began = clock.now()
    clock.at(began + 0.5, lambda: wire.fail("the cable is cut\nat a place"))
    with pytest.raises(LinkError, match="the cable is cut"):
        session.read_parameter("ctrlMel.mass", 60.0)
    assert clock.now() - began == pytest.approx(0.5, abs=0.05)
    assert session.lost == "the cable is cut"


def test_empty_and_unknown_packets_are_ignored(wire, session):
    session.open(FIRST_ANSWER_TIMEOUT, TableCache())
    for packet in (b"", pack(Port.LOG, 2, b""), pack(Port.LOG, 2, b"\x00"), pack(Port.LINK, 0, b""), b"\xff"):
        session.hear(packet)
    assert not session.lost


def test_answers_to_pings_tell_that_the_vehicle_lives_and_how_long_they_take(wire, session, clock):
    session.open(FIRST_ANSWER_TIMEOUT, TableCache())
    clock.sleep(1.0)
    assert clock.now() - session.acknowledged < 0.11
    wire.up = lambda packet: []
    clock.sleep(1.0)
    assert clock.now() - session.acknowledged == pytest.approx(1.0, abs=0.11)
    session.close()
    sent = len(wire.sent)
    clock.sleep(1.0)
    assert len(wire.sent) == sent


def test_a_read_only_parameter_and_one_that_is_lacking_cannot_be_set(session):
    session.open(FIRST_ANSWER_TIMEOUT, TableCache())
    session.parameters = {**session.parameters, "made.up": (7, 0x48)}
    for name in ("made.up", "no.such"):
        with pytest.raises(LinkError, match="can be set"):
            session.write_parameter(name, 1.0, 2.0)


def test_a_log_that_another_client_left_half_created_is_created_anew(wire, session):
    session.open(FIRST_ANSWER_TIMEOUT, TableCache())
    wire.send(pack(Port.LOG, 1, struct.pack("<BBBH", 6, 0, 7, 0)))
    heard = []
    session.start_log([("kalman.varX", "float")], 10, lambda stamp, values: heard.append(values))
    for _ in range(10):
        wire.vehicle.advance(10)
        wire.send(b"\xff")
    assert heard
    assert set(heard[0]) == {"kalman.varX"}
