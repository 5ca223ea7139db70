"""Packets from the network and the radio: MAVLink, DataStream and CRTP, for the real clients in this process.

An input is a file of packets, each preceded by its length.
"""

import contextlib
import logging
import math
import os
import queue
import socket
import struct
import threading
from dataclasses import replace
from functools import cache
from pathlib import Path
from random import Random
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cflib.crtp.crtpdriver import CRTPDriver
from cflib.crtp.crtpstack import CRTPPacket
from cflib.crtp.exceptions import WrongUriType
from pymavlink.dialects.v20 import common
from waiting import a_moment, until

from cfplan.errors import CfplanError, LinkError
from cfplan.flight.clock import SteppedClock
from cfplan.flight.mocap import child, datastream
from cfplan.flight.mocap.datastream_client import DataStreamClient
from cfplan.flight.mocap.frames import Frame, Scene
from cfplan.flight.mocap.pose_tracker import PoseTracker
from cfplan.flight.mocap.source import MocapSource
from cfplan.flight.mocap.survey import Surveyor
from cfplan.flight.mocap.uri import parse_uri
from cfplan.flight.radio import connection
from cfplan.flight.radio.crtp import LARGEST_PAYLOAD
from cfplan.flight.telemetry import Estimate, Event, Level, VehicleStatus
from cfplan.recording.mavlink.bridge import GroundStation, Place
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_crazyflie.vehicle import VirtualCrazyflie
from cfplan.simulation.virtual_vicon.server import Connection, Picture, Shown
from cfplan.vehicle.airframes import AIRFRAMES
from tests.bad_input.faults import FLOATS, TEXTS, spoil_bytes, spoil_packets
from tests.bad_input.files import MADE, SAFETY, Input

_LARGEST_DATAGRAM = 65_000  # bytes
_USES_POSES = {"stabilizer.estimator": 2.0}  # parameter stored in a vehicle
_SINGLES = [value for value in FLOATS if not 3e38 < abs(value) < math.inf]  # finite in 32 bits, or not finite at all


def _put(packets: list[bytes], folder: Path) -> None:
    (folder / "packets").write_bytes(b"".join(struct.pack("<I", len(packet)) + packet for packet in packets))


def _packets(folder: Path) -> list[bytes]:
    content, found = (folder / "packets").read_bytes(), []
    while content:
        end = 4 + int.from_bytes(content[:4], "little")
        found.append(content[4:end])
        content = content[end:]
    return found


# MAVLink, to the bridge

_ASKED = (
    common.MAVLINK_MSG_ID_COMMAND_LONG, common.MAVLINK_MSG_ID_COMMAND_INT, common.MAVLINK_MSG_ID_MISSION_REQUEST_LIST,
)  # fmt: skip
_COMMANDS = (0, 1, 20, 21, 22, 92, 176, 185, 246, 300, 400, 512, 520, 148, 21196)
_INTEGERS = {"uint8_t": 1, "int8_t": 1, "uint16_t": 2, "int16_t": 2, "uint32_t": 4, "int32_t": 4}  # bytes; others 8


def _spoil_mavlink(_: None, chance: Random, folder: Path) -> None:
    """Write datagrams: messages with absurd values in every field, and damaged bytes."""
    mav = common.MAVLink(None, srcSystem=chance.choice((0, 1, 255)), srcComponent=chance.choice((0, 1, 190)))
    found = []
    for _ in range(chance.randint(1, 6)):
        kind = common.mavlink_map[chance.choice((*_ASKED, chance.choice(sorted(common.mavlink_map))))]
        counts = dict(zip(kind.ordered_fieldnames, kind.array_lengths, strict=True))
        types = zip(kind.fieldnames, kind.fieldtypes, strict=True)
        message = kind(*(_field(type_, counts[name], chance) for name, type_ in types))
        content = message.pack(mav, force_mavlink1=kind.id < 256 and chance.randrange(4) == 0)
        found.append((spoil_bytes(content, chance) if chance.randrange(4) == 0 else content)[:_LARGEST_DATAGRAM])
    _put(found, folder)


def _field(kind: str, count: int, chance: Random) -> Any:
    if kind == "char":
        return chance.choice((b"", b"\xff\xfe", b"x" * 50, b"\x1b[2J"))[: max(1, count)]
    if kind in ("float", "double"):
        choices: list[Any] = _SINGLES
    else:
        bits = 8 * _INTEGERS.get(kind, 8)
        low, high = (0, 2**bits - 1) if kind.startswith("u") else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
        choices = [low, high, *(min(number, high) for number in _COMMANDS)]
    return [chance.choice(choices) for _ in range(count)] if count else chance.choice(choices)


def _use_mavlink(folder: Path) -> None:
    """Run the bridge on the datagrams while the pilot reports."""
    clock = SteppedClock()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        station.bind(("127.0.0.1", 0))
        station.settimeout(10.0)
        place = Place(*station.getsockname())
        with GroundStation(place, folder / MADE / "bridge.tlog", clock=clock) as bridge:
            clock.sleep(2.0)
            _, vehicle = station.recvfrom(2048)
            for data in _packets(folder):
                station.sendto(data, vehicle)
                bridge.show(Estimate(clock.now(), (1, 2, 3), (0, 0, 0), (0, 0, 0), (0, 0, 0, 1)))
                bridge.show(VehicleStatus(clock.now(), (0, 0, 0), (0, 0, 0, 0), 4.0, 1))
                bridge.show(Event(clock.now(), Level.INFO, data[:200].decode("utf-8", "replace")))
                clock.sleep(0.1)
        assert not bridge.failure, bridge.failure


# DataStream, to the client and to the virtual server


def _pair() -> tuple[socket.socket, socket.socket]:
    """Return both ends of a connection within this computer."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        ours = socket.create_connection(listener.getsockname())
        return listener.accept()[0], ours


def _datastream(_: Path) -> list[bytes]:
    """Return the messages of a client, then those of a server: its offer, then frames."""
    theirs, ours = _pair()
    with theirs, ours:
        server = Connection(theirs, spare=False)
        wanted = datastream.packet(
            (datastream.Block.OBJECT_ENUMS, datastream.kinds(datastream.WANTED)),
            (datastream.Block.REQUEST_FRAME, struct.pack("<?", True)),
        )
        ours.sendall(wanted)
        server.read()
        for number in range(40):
            body = Shown("cf1", "cf1", ((0.1, -0.2, 0.3 + 1e-4 * number), (0.0, 0.0, 0.1, 0.99)))
            server.show(Picture(number, 200.0, 0.004, False, (body, Shown("gate", "root", None))))
        theirs.shutdown(socket.SHUT_WR)
        stream = ours.makefile("rb").read()
    found = [wanted]
    while stream:
        size = datastream.PACKET_HEAD.size + datastream.PACKET_HEAD.unpack_from(stream)[1]
        found.append(stream[:size])
        stream = stream[size:]
    return found


def _spoil_datastream(sound: list[bytes], chance: Random, folder: Path) -> None:
    """Write a stream of absurd blocks, mostly with correct lengths, so that they are read."""
    packets = [_spoiled_packet(packet, chance) if chance.randrange(25) == 0 else packet for packet in sound]
    _put(spoil_packets(packets, chance) if chance.randrange(3) == 0 else packets, folder)


def _spoiled_packet(content: bytes, chance: Random) -> bytes:
    blocks = [(kind, bytes(data)) for kind, data in datastream.read_blocks(memoryview(content)[8:])]
    number = chance.randrange(len(blocks))
    kind, data = blocks[number]
    how = chance.randrange(6)
    if how == 0 and len(data) >= 8:
        place = len(data) - 8 * chance.randint(1, len(data) // 8)
        data = data[:place] + struct.pack("<d", chance.choice(FLOATS)) + data[place + 8 :]
    elif how == 1 and len(data) >= 4:
        place = 4 * chance.randrange(len(data) // 4)
        count = chance.choice((0, 1, 2, 255, 2**31, 2**32 - 1, 2**32 // 12))
        data = data[:place] + struct.pack("<I", count) + data[place + 4 :]
    elif how == 2:
        name = chance.choice(TEXTS).encode("utf-8", "surrogatepass")
        data = data.replace(struct.pack("<I", 3) + b"cf1", struct.pack("<I", len(name)) + name)
    elif how == 3:
        kind = chance.choice((*map(int, datastream.Block), 0, 2**32 - 1))
    else:
        data = spoil_bytes(data, chance)
    blocks[number : number + 1] = [(kind, data)] * chance.choice((0, 1, 1, 1, 1, 30, 3000))
    return datastream.packet(*blocks)


class _Feed:
    """A feed of given messages."""

    stage, child_id = "", None

    def __init__(self, messages: list[Any]):
        self._messages = messages

    def start(self) -> None: ...
    def keep(self) -> None: ...
    def close(self) -> None: ...

    def messages(self) -> list[Any]:
        found, self._messages = self._messages, []
        return found

    def failure(self) -> CfplanError | None:
        return None


def _use_datastream(folder: Path) -> None:
    """Feed the client; survey, classify and gate its poses; and send the same bytes to the virtual server."""
    content = b"".join(_packets(folder))
    theirs, ours = _pair()
    with theirs, ours:
        server = Connection(theirs, spare=True)
        ours.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            ours.send(content)
        server.read()
    messages = _heard(content)
    surveyor = Surveyor()
    for message in messages:
        if isinstance(message, Scene):
            surveyor.scene = message
        elif isinstance(message, Frame):
            surveyor.add(message)
    for body in surveyor.report().bodies:
        str(body.remark)
    uri, limits = parse_uri("vicon://lab/cf1", subject_needed=True), load_limits(SAFETY).pose
    source = MocapSource(uri, limits, clock=SteppedClock(), make_feed=lambda _: _Feed(messages))
    source.open()
    tracker = PoseTracker(limits)
    for pose in source.poses():
        tracker.take(pose)
        tracker.to_send(pose.time + 0.01)


def _heard(content: bytes) -> list[Any]:
    """Return the messages that the driver's process makes of a stream, after a round trip through its pipe."""
    pipe, received = bytearray(), 1000.0
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def send() -> None:
            with contextlib.suppress(OSError), listener.accept()[0] as client:
                client.sendall(content)
                client.shutdown(socket.SHUT_WR)
                while client.recv(1 << 16):
                    pass

        sending = threading.Thread(target=send, daemon=True)
        sending.start()
        client = DataStreamClient(*listener.getsockname(), "vicon://lab/cf1")
        try:
            client.connect()
            while True:
                received += 0.005  # s, as if frames came at their rate
                frame = replace(client.wait(), received=received)
                if (scene := client.scene()) is not None:
                    pipe += child.encoded(scene)
                pipe += child.encoded(frame)
        except CfplanError as error:
            if "server closed" not in error.what or not error.hint:
                pipe += child.encoded(error)
        finally:
            client.close()
        sending.join()
    return child.decoded(pipe)


# CRTP, to the virtual vehicle


def _values(chance: Random, layout: str) -> bytes:
    found = b""
    for code in layout:
        if code == "f":
            found += struct.pack("<f", chance.choice(_SINGLES))
        else:
            size = struct.calcsize("<" + code)
            number = chance.choice((0, 1, 2, 3, 5, 7, 8, 100, 2 ** (8 * size) - 1, 2 ** (8 * size - 1)))
            found += number.to_bytes(size, "little")
    return found


# Port, channel, first bytes, and layout of the rest, of the packets that a vehicle knows.
_COMMANDS_OF_VEHICLES = (
    (7, 0, b"\x06", "hhhhhhhhhIhhh"), (7, 0, b"\x01", "ffff"), (7, 0, b"\x02", "fffff"), (7, 0, b"\x04", "ffff"),
    (7, 0, b"\x05", "ffff"), (7, 0, b"\x07", "ffff"), (7, 0, b"\x09", "ffff"), (7, 0, b"\x0a", "ffff"),
    (7, 0, b"\x00", ""), (7, 0, b"\x08", "fffHB"), (7, 1, b"\x00", "I"), (3, 0, b"", "fffH"), (6, 0, b"", "fff"),
    (6, 1, b"\x08", "fffffff"), (6, 1, b"", "Bhhh"), (6, 2, b"", "BhhhBhhh"), (8, 0, b"\x07\0", "ffBf"),
    (8, 0, b"\x08\0", "ffBf"), (8, 0, b"\x0c\0", "BBfffff"), (8, 0, b"\x04\0", "Bfffff"), (8, 0, b"\x01\0", "ff"),
    (8, 0, b"\x02\0", "ff"), (8, 0, b"\x05\0", "BBBf"), (8, 0, b"\x06\0", "BBIB"), (8, 0, b"\x03\0", ""),
    (8, 0, b"\x00\0", "B"), (8, 0, b"\x0b\0", "BBBBf"), (8, 0, b"\x06", "BBBIB"), (2, 2, b"", "Hf"), (2, 2, b"", "HB"),
    (2, 2, b"", "HH"), (2, 2, b"", "HI"), (2, 1, b"", "H"), (2, 3, b"", "BH"),
    (2, 3, b"\0stabilizer\0controller\0", "BB"), (2, 0, b"", "BH"), (5, 0, b"", "BH"), (5, 1, b"\x06\0", "BHBHBHBH"),
    (5, 1, b"\x08\0", "H"), (5, 1, b"", "BBBH"), (4, 0, b"", "BIB"), (4, 1, b"", "BIB"), (4, 2, b"", "BIB"),
    (4, 2, b"\1", "Iffffff"), (9, 0, b"", "BB"), (9, 1, b"", "BB"), (13, 0, b"", "BB"), (13, 1, b"", "BB"),
    (15, 0, b"", "BBf"), (15, 3, b"", "BBf"),
)  # fmt: skip
_ARMED = [b"\x6d\x08" + struct.pack("<7f", 0, 0, 0.1, 0, 0, 0, 1), b"\x9d\x01\x01"]  # a pose, and arming


def _uplink(chance: Random) -> bytes:
    """Return a packet to a vehicle: mostly of a known kind, with absurd numbers."""
    if chance.randrange(8) == 0:
        return bytes((chance.randrange(256),)) + chance.randbytes(chance.randrange(31))
    port, channel, first, layout = chance.choice(_COMMANDS_OF_VEHICLES)
    packet = bytes((port << 4 | channel,)) + first + _values(chance, layout)
    return spoil_bytes(packet, chance)[:64] if chance.randrange(5) == 0 else packet


def _spoil_uplink(_: None, chance: Random, folder: Path) -> None:
    begin = _ARMED if chance.randrange(3) else []
    _put([*begin, *(_uplink(chance) for _ in range(chance.choice((1, 3, 10, 40))))], folder)


def _use_uplink(folder: Path) -> None:
    """Send the packets to a virtual vehicle, 10 ms apart, and simulate one more second."""
    packets = _packets(folder)
    old = sum(map(len, packets)) % 4 == 0
    stored = _USES_POSES if len(packets) % 2 else {}
    settings = (
        VehicleSettings(firmware="2025.02", protocol=10, stored=stored) if old else VehicleSettings(stored=stored)
    )
    vehicle = VirtualCrazyflie(AIRFRAMES["crazyflie-2.1+"], settings)
    for packet in packets:
        vehicle.receive(packet)
        vehicle.advance(10)
        assert all(len(answer) <= 1 + LARGEST_PAYLOAD for answer in vehicle.sent())
    vehicle.advance(1000)
    vehicle.firmware.info()


# CRTP, from a vehicle


class _Driver(CRTPDriver):
    """A link to a virtual vehicle in this process; packets can be inserted between its answers, or spoiled."""

    needs_resending = False
    made: "_Driver"  # the last instance
    spoil = staticmethod(lambda packet: packet)  # applied to each packet from the vehicle

    def connect(self, uri: str, statistics: object, error: object) -> None:
        if not uri.startswith("spoiled://"):
            raise WrongUriType("not mine")
        self.vehicle = VirtualCrazyflie(AIRFRAMES["crazyflie-2.1+"], VehicleSettings(stored=_USES_POSES))
        self.coming: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self.idle = threading.Event()
        self._lock = threading.Lock()
        type(self).made = self

    def send_packet(self, packet: Any) -> None:
        with self._lock:
            self.vehicle.receive(bytes((packet.header,)) + bytes(packet.data))
        self.pump(0)

    def pump(self, ticks: int) -> None:
        with self._lock:
            self.vehicle.advance(ticks)
            for answer in self.vehicle.sent():
                self.coming.put(type(self).spoil(answer))

    def receive_packet(self, wait: float = 0) -> Any:
        try:
            data = self.coming.get_nowait()
        except queue.Empty:
            self.idle.set()
            a_moment(0.001)
            return None
        return CRTPPacket(data[0], bytearray(data[1:])) if data else None

    def close(self) -> None:
        pass


class _Tracebacks(logging.Handler):
    """Keeps the exceptions in cfplan's callbacks that cflib logs."""

    def __init__(self) -> None:
        super().__init__()
        self.ours: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        if "/cfplan/" in text and "Traceback" in text:
            self.ours.append(text)


@cache
def _tracebacks() -> _Tracebacks:
    handler = _Tracebacks()
    logging.getLogger("cflib").addHandler(handler)
    logging.getLogger("cflib").propagate = False
    return handler


@cache
def _connected() -> Any:
    """Return the link that all inputs share: connecting takes longer than an input."""
    heard: list[Any] = []
    link = connection.connect("spoiled://0", heard.append, [_Driver])
    link.start_logs()
    return SimpleNamespace(link=link, driver=_Driver.made, heard=heard)


def _downlink(chance: Random) -> bytes:
    """Return a packet from a vehicle, mostly of a kind that a link reads."""
    known = (
        (5, 2, bytes((chance.randrange(4), 0, 0, 0)), chance.choice(("fff", "hhhhhhhhhI", "hhhHHHHHH", "BBB", ""))),
        (5, 1, b"", "BBB"), (5, 0, b"", "BHB"), (2, chance.randrange(4), b"", "HBf"), (8, 0, b"", "BBBB"),
        (13, 1, chance.choice((b"\1", b"\1\xff\xfe", b"\1" + b"9" * 30, b"\0", b"\2", b"")), ""),
        (15, 0, b"\x05" + struct.pack("<d", chance.choice(FLOATS)), ""),
        (chance.randrange(16), chance.randrange(4), chance.randbytes(chance.randrange(31)), ""),
    )  # fmt: skip
    port, channel, first, layout = chance.choice(known)
    packet = bytes((port << 4 | channel,)) + first + _values(chance, layout)
    return (spoil_bytes(packet, chance) or packet)[:32] if chance.randrange(5) == 0 else packet


def _spoil_downlink(_: None, chance: Random, folder: Path) -> None:
    _put([_downlink(chance) for _ in range(chance.choice((1, 3, 10, 40)))], folder)


def _use_downlink(folder: Path) -> None:
    """Insert packets between a vehicle's answers; the link's values must stay finite, and its thread alive."""
    at, tracebacks = _connected(), _tracebacks()
    at.heard.clear()
    at.driver.pump(10)
    for packet in _packets(folder):
        at.driver.coming.put(packet)
    at.driver.idle.clear()
    at.driver.coming.put(b"")
    assert until(at.driver.idle.is_set), "the thread that reads the link has ended"
    assert not tracebacks.ours, tracebacks.ours.pop()
    for message in list(at.heard):
        if isinstance(message, Estimate | VehicleStatus):
            values = np.concatenate([np.ravel(getattr(message, name)) for name in message.__slots__])
            assert np.isfinite(values.astype(float)).all(), message
    at.link.send_pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    assert isinstance(at.link.round_trip, float)
    assert at.link.firmware is not None


def _use_connecting(folder: Path) -> None:
    """Connect to a vehicle with some spoiled answers, set a parameter and start the logs."""
    chance, tracebacks, looks = Random((folder / "packets").read_bytes()), _tracebacks(), 0
    fraction = chance.choice((0.002, 0.02, 0.3))

    def spoil(packet: bytes) -> bytes:
        return (spoil_bytes(packet, chance) or b"\xff")[:32] if chance.random() < fraction else packet

    def waiting() -> None:
        nonlocal looks
        looks += 1
        if looks > 100:
            raise LinkError("given up", where="spoiled://1", hint="wait for longer")

    driver = type("SpoiledDriver", (_Driver,), {"spoil": staticmethod(spoil)})
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(os.environ, "XDG_CACHE_HOME", str(folder / MADE))
        link = connection.connect("spoiled://1", lambda _: None, [driver], waiting=waiting)
        try:
            link.set_parameter("stabilizer.controller", 2, patience=0.2)
            link.start_logs()
        finally:
            link.close()
    assert not tracebacks.ours, tracebacks.ours.pop()


PACKETS = {
    "MAVLink": Input(lambda _: None, _spoil_mavlink, _use_mavlink, 2.0),
    "DataStream": Input(_datastream, _spoil_datastream, _use_datastream),
    "CRTP to the vehicle": Input(lambda _: None, _spoil_uplink, _use_uplink),
    "CRTP from the vehicle": Input(lambda _: None, _spoil_downlink, _use_downlink),
    "CRTP while connecting": Input(lambda _: None, _spoil_downlink, _use_connecting, 0.02),
}
