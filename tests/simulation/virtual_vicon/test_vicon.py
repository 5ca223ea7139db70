"""The virtual Vicon, looked at with cfplan's own client and with Vicon's."""

import contextlib
import math
import socket
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from stepped_vicon import SteppedFeed
from waiting import until

from cfplan.errors import InputError
from cfplan.flight.clock import SteppedClock
from cfplan.flight.mocap.datastream import PACKET_HEAD, WANTED, Block, Decoder, kinds, packet
from cfplan.flight.mocap.feed import Feed
from cfplan.flight.mocap.frames import Frame
from cfplan.flight.mocap.survey import survey
from cfplan.flight.mocap.uri import parse_uri
from cfplan.simulation.virtual_vicon.cameras import ViconSettings
from cfplan.simulation.virtual_vicon.faults import FaultKind, Faults, ViconFault
from cfplan.simulation.virtual_vicon.vicon import VirtualVicon, serve

LEVEL = (0.0, 0.0, 0.0, 1.0)
CLEAN = ViconSettings(position_noise=0.0, attitude_noise=0.0)


def stations(count=8, seed=3):
    """Places and attitudes anywhere in a large room."""
    chance = np.random.default_rng(seed)
    places, turns = chance.uniform(-5, 5, (count, 3)), Rotation.random(count, rng=chance).as_quat()
    return [(tuple(place), tuple(turn)) for place, turn in zip(places.tolist(), turns.tolist(), strict=True)]


def frames_of(uri, count):
    """So many frames in which something was seen."""
    found = []

    def enough():
        assert feed.failure() is None
        found.extend(m for m in feed.messages() if isinstance(m, Frame) and m.bodies)
        return len(found) >= count

    with Feed(parse_uri(uri, subject_needed=True)) as feed:
        feed.start()
        assert until(enough)
    return found


@pytest.mark.integration
@pytest.mark.parametrize("change", [{}, {"y_up": True}, {"spare": True}, {"rate": 300.0}], ids=str)
def test_both_clients_see_the_same_poses(change):
    """Each shows every station for some frames; what both see is where the body was, to 1e-6 m and rad."""
    there = stations()
    with serve(replace(CLEAN, **change), lambda t: there[int(t * 50) % len(there)]) as vicon:
        for system in ("vicon", "vicon-sdk"):
            frames = frames_of(vicon.uri_of("cf1", system), 60)
            seen = {frame.bodies[0].position: frame.bodies[0] for frame in frames}.values()
            assert len(seen) == len(there)
            for place, turn in there:
                body = min(seen, key=lambda b, place=place: math.dist(b.position, place))
                assert math.dist(body.position, place) < 1e-6
                assert (Rotation.from_quat(body.quaternion) * Rotation.from_quat(turn).inv()).magnitude() < 1e-6


@pytest.mark.integration
def test_frames_are_numbered_and_rated_and_tell_their_latency():
    with serve(replace(CLEAN, rate=200.0, latency=0.004, first_frame=500)) as vicon:
        frames = frames_of(vicon.uri, 50)
    assert [frame.number for frame in frames] == list(range(frames[0].number, frames[0].number + len(frames)))
    assert frames[0].number >= 500
    assert {frame.rate for frame in frames} == {200.0}
    assert [frame.latency for frame in frames] == pytest.approx([0.004] * len(frames))


def test_a_survey_tells_the_rate_and_the_bodies_that_stand_in_the_room_too():
    clock = SteppedClock()
    with serve(replace(CLEAN, segment="root", others=(("gate", (1.0, 2.0, 0.5)),)), clock=clock) as vicon:
        uri = parse_uri(vicon.uri, subject_needed=True)
        found = survey(uri, 2.0, clock=clock, make_feed=lambda uri: SteppedFeed(uri, clock))
    assert found.frames == pytest.approx(200, abs=2)
    assert found.seconds == pytest.approx(2.0, abs=0.02)
    assert found.rate == pytest.approx(100.0, abs=0.5)
    assert found.announced_rate == 100.0
    assert found.jitter < 0.0011
    assert found.dropouts == 0
    assert {body.name: body.position for body in found.bodies} == {"cf1": (0, 0, 0), "gate": (1.0, 2.0, 0.5)}
    assert "named 'root'" in found.bodies[0].remark
    assert found.bodies[1].counts["frozen"] > 190
    assert "good" in found.bodies[1].counts


class Turns:
    """A virtual Vicon on a clock of its own and a client of it, which take turns in one thread."""

    def __init__(self, settings):
        self.now = 100.0
        self.vicon = VirtualVicon(settings, self.now)
        self._decoder, self._buffer = Decoder(), bytearray()
        self.socket = self.connect()

    def connect(self):
        """A connection to which frames are pushed."""
        client = socket.create_connection(("127.0.0.1", self.vicon.port))
        self.vicon.step(self.now)
        client.setblocking(False)
        client.recv(1 << 16)
        client.sendall(packet((Block.OBJECT_ENUMS, kinds(WANTED)), (Block.REQUEST_FRAME, b"\1")))
        self.vicon.step(self.now)
        return client

    def run(self, seconds):
        """Let time pass by milliseconds, the body at x = time; the frames that come, dated by that clock."""
        frames = []
        for _ in range(round(1000 * seconds)):
            self.now += 0.001
            while self.vicon.next_look <= self.now:
                at = self.vicon.next_look
                self.vicon.look(at, (at, 0.0, 1.0), LEVEL)
            self.vicon.step(self.now)
            frames += self._read()
        return frames

    def _read(self):
        with contextlib.suppress(BlockingIOError):
            self._buffer += self.socket.recv(1 << 16)
        frames = []
        while len(self._buffer) >= PACKET_HEAD.size:
            end = PACKET_HEAD.size + PACKET_HEAD.unpack_from(self._buffer)[1]
            frames.append(self._decoder.frame(memoryview(bytes(self._buffer[PACKET_HEAD.size : end])), self.now))
            del self._buffer[:end]
        return frames


@pytest.fixture
def turns():
    """A function from settings and faults to a server and a client that take turns."""
    made = []

    def make(settings=CLEAN, *faults):
        made.append(Turns(replace(settings, faults=faults)))
        return made[-1]

    yield make
    for each in made:
        each.socket.close()
        each.vicon.close()


def test_frames_leave_at_their_rate_and_after_their_latency(turns):
    frames = turns(replace(CLEAN, rate=300.0, latency=0.02)).run(1.0)
    assert len(frames) == pytest.approx(294, abs=2)
    for frame in frames:
        assert frame.received - frame.bodies[0].position[0] == pytest.approx(0.02, abs=0.0011)


def test_noise_is_as_large_as_it_is_said_to_be(turns):
    frames = turns(ViconSettings(position_noise=0.002, attitude_noise=0.01)).run(20.0)
    heights = np.array([frame.bodies[0].position[2] for frame in frames])
    angles = np.array([Rotation.from_quat(frame.bodies[0].quaternion).as_rotvec() for frame in frames])
    assert heights.std() == pytest.approx(0.002, rel=0.1)
    assert angles.std(axis=0) == pytest.approx(0.01, rel=0.1)


def test_a_stall_loses_frames_and_their_numbers_go_on(turns):
    frames = turns(CLEAN, ViconFault(FaultKind.STALL, start=0.5, duration=0.3)).run(1.5)
    numbers = [frame.number for frame in frames]
    assert max(np.diff(numbers)) == 31
    assert sorted(np.diff(numbers))[-2] == 1


def test_a_repeated_frame_bears_its_old_number(turns):
    frames = turns(CLEAN, ViconFault(FaultKind.REPEAT, start=0.5, duration=0.3)).run(1.5)
    assert sum(a.number == b.number for a, b in pairwise(frames)) == 30


def test_a_delay_keeps_the_order_and_loses_nothing(turns):
    frames = turns(CLEAN, ViconFault(FaultKind.DELAY, start=0.5, duration=0.3, size=0.2)).run(2.0)
    assert set(np.diff([frame.number for frame in frames])) == {1}
    ages = [frame.received - frame.bodies[0].position[0] for frame in frames]
    assert max(ages) == pytest.approx(0.21, abs=0.002)
    assert ages[-1] == pytest.approx(0.01, abs=0.002)


def test_a_closed_server_resets_its_clients_and_comes_back_on_its_port(turns):
    lab = turns(CLEAN, ViconFault(FaultKind.CLOSE, start=0.2, duration=0.2))
    with pytest.raises(ConnectionResetError):
        lab.run(0.3)
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", lab.vicon.port))
    for _ in range(200):
        lab.now += 0.001
        lab.vicon.step(lab.now)
    lab.socket = lab.connect()
    assert lab.run(0.1)


def test_a_client_that_says_nonsense_is_dropped_and_the_others_are_not(turns):
    lab = turns()
    with socket.create_connection(("127.0.0.1", lab.vicon.port)) as rude:
        rude.sendall(b"GET / HTTP/1.1\r\n\r\n")
        assert len(lab.run(0.5)) > 40
        rude.settimeout(1.0)
        while rude.recv(1 << 16):
            pass


def test_a_client_may_ask_for_single_frames(turns):
    lab = turns()
    lab.socket.sendall(packet((Block.REQUEST_FRAME, b"\0")))
    assert len(lab.run(0.5)) == 1
    assert lab.run(0.5) == []


def test_faults_do_what_they_are_named_after():
    truth = {"a": ((1.0, 0.0, 0.0), LEVEL), "b": ((2.0, 0.0, 0.0), LEVEL)}

    def seen(kind, time=1.5, **options):
        faults = Faults()
        faults.add(ViconFault(kind, start=1.0, duration=1.0, **options), now=0.0)
        faults.seen(0.5, {name: ((x - 0.5, y, z), q) for name, ((x, y, z), q) in truth.items()})
        return faults.seen(time, truth)

    assert seen(FaultKind.OCCLUDE) == {}
    assert seen(FaultKind.OCCLUDE, subject="a") == {"b": truth["b"]}
    assert seen(FaultKind.FREEZE, subject="a")["a"][0] == (0.5, 0.0, 0.0)
    assert seen(FaultKind.JUMP, size=0.05, subject="b")["b"][0] == pytest.approx((2.05, 0.0, 0.0))
    assert np.abs(seen(FaultKind.FLIP)["a"][1]) == pytest.approx((0.0, 0.0, 1.0, 0.0))
    assert all(map(math.isnan, seen(FaultKind.BREAK)["a"][0]))
    assert seen(FaultKind.SWAP) == {"a": truth["b"], "b": truth["a"]}
    for kind in FaultKind:
        assert seen(kind, time=2.5) == truth, "a fault ends"


def test_a_flip_turns_about_the_bodys_own_axis():
    tilted = Rotation.from_rotvec([0.4, 0.0, 0.0])
    faults = Faults()
    faults.add(ViconFault(FaultKind.FLIP, size=1.0), now=0.0)
    ((_, turned),) = faults.seen(1.0, {"a": ((0, 0, 0), tuple(tilted.as_quat()))}).values()
    assert (Rotation.from_quat(turned) * (tilted * Rotation.from_rotvec([0, 0, 1.0])).inv()).magnitude() < 1e-12


@pytest.mark.parametrize(
    "settings", [{"rate": 0.0}, {"rate": math.nan}, {"latency": -1.0}, {"position_noise": math.inf}]
)
def test_settings_that_make_no_sense_are_refused(settings):
    with pytest.raises(InputError):
        VirtualVicon(ViconSettings(**settings), 0.0)


def test_a_port_that_is_taken_is_an_error():
    with socket.create_server(("127.0.0.1", 0)) as taken, pytest.raises(InputError, match="not available"):
        VirtualVicon(ViconSettings(port=taken.getsockname()[1]), 0.0)


@pytest.mark.parametrize("options", [{"start": math.nan}, {"duration": 0.0}, {"size": math.inf}])
def test_faults_that_make_no_sense_are_refused(options):
    with pytest.raises(InputError):
        ViconFault(FaultKind.JUMP, **options)
