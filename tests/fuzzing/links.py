"""What comes over the network and the radio: MAVLink, DataStream and CRTP, fed to the real clients without sockets.

An input is a file of packets, each behind its length, so that it can be kept and read again.
"""

import contextlib
import logging
import math
import queue
import socket
import struct
import threading
import time
from functools import partial
from pathlib import Path
from random import Random
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
from cflib.crtp.crtpdriver import CRTPDriver
from cflib.crtp.crtpstack import CRTPPacket
from cflib.crtp.exceptions import WrongUriType
from pymavlink.dialects.v20 import common

from cfplan.errors import CfplanError, InputError, LinkError
from cfplan.flight.mocap import child, datastream, datastream_client
from cfplan.flight.mocap.pose_gate import PoseGate
from cfplan.flight.mocap.pose_predictor import PosePredictor
from cfplan.flight.mocap.source import pose_source
from cfplan.flight.mocap.survey import Surveyor
from cfplan.flight.radio import connection
from cfplan.flight.telemetry import Estimate, Event, Level, VehicleStatus
from cfplan.recording.mavlink.bridge import GroundStation, parse_place
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_crazyflie.vehicle import VirtualCrazyflie
from cfplan.simulation.virtual_crazyflie.wire import LARGEST_PAYLOAD
from cfplan.simulation.virtual_vicon.server import Connection
from cfplan.vehicle.airframes import AIRFRAMES
from tests.fuzzing.files import SAFETY, Reader
from tests.fuzzing.mutations import NUMBERS, TEXTS, spoil_bytes

_FILE = "packets"


def _written(folder: Path, packets: list[bytes]) -> None:
    (folder / _FILE).write_bytes(b"".join(struct.pack("<I", len(packet)) + packet for packet in packets))


def _packets(folder: Path) -> list[bytes]:
    content, found, place = (folder / _FILE).read_bytes(), [], 0
    while place < len(content):
        size = int.from_bytes(content[place : place + 4], "little")
        found.append(content[place + 4 : place + 4 + size])
        place += 4 + size
    return found


def _float(chance: Random) -> float:
    """Return an absurd number that 32 bits hold."""
    return chance.choice([float(x) for x in NUMBERS if not abs(x) < math.inf or abs(x) < 3e38] + [0.5, 1.0, 3e38])


# MAVLink, to the bridge


def _spoil_mavlink(_: None, chance: Random, folder: Path) -> None:
    """Write datagrams of messages whose every field is absurd, and of spoiled bytes."""
    link = common.MAVLink(None, srcSystem=chance.choice((0, 1, 255)), srcComponent=chance.choice((0, 1, 190)))
    found = []
    for _ in range(chance.randint(1, 6)):
        kind = chance.choice((*_ASKED, chance.choice(sorted(common.mavlink_map))))
        made = common.mavlink_map[kind](*_fields(common.mavlink_map[kind], chance))
        content = b""
        with contextlib.suppress(struct.error, OverflowError):  # a field that its type cannot hold
            content = bytes(made.pack(link, force_mavlink1=chance.random() < 0.3 and kind < 256))
        found.append((spoil_bytes(content, chance) if chance.random() < 0.3 else content)[:_LARGEST_DATAGRAM])
    _written(folder, found)


_LARGEST_DATAGRAM = 65_000  # bytes
_ASKED = (
    common.MAVLINK_MSG_ID_COMMAND_LONG,
    common.MAVLINK_MSG_ID_COMMAND_INT,
    common.MAVLINK_MSG_ID_MISSION_REQUEST_LIST,
)


def _fields(kind: Any, chance: Random) -> list[Any]:
    """Return a value for each field that its type can hold."""
    counts = dict(zip(kind.ordered_fieldnames, kind.array_lengths, strict=True))
    return [_field(type_, counts[name], chance) for name, type_ in zip(kind.fieldnames, kind.fieldtypes, strict=True)]


def _field(kind: str, count: int, chance: Random) -> Any:
    if kind == "char":
        return chance.choice((b"", b"\xff\xfe", b"x" * 50, b"\x1b[2J"))[: max(1, count)]
    if kind in ("float", "double"):
        one = partial(_float, chance)
    else:
        bits = 8 * {"uint8_t": 1, "int8_t": 1, "uint16_t": 2, "int16_t": 2}.get(kind, 8 if "64" in kind else 4)
        low = 0 if kind.startswith("u") else -(1 << bits - 1)
        known = (0, 1, 20, 21, 22, 92, 176, 185, 246, 300, 400, 512, 520, 148, 21196)

        def one() -> int:
            number = chance.choice((low, low + (1 << bits) - 1, *known))
            return min(max(number, low), low + (1 << bits) - 1)

    return [one() for _ in range(count)] if count else one()


class _Stream(socket.socket):
    """One end of a pair of sockets, which knows no options of TCP."""

    def setsockopt(self, *_: Any) -> None:
        pass


def _streams() -> tuple[_Stream, _Stream]:
    one, other = socket.socketpair()
    return _Stream(fileno=one.detach()), _Stream(fileno=other.detach())


class _Datagrams:
    """What the bridge uses of a UDP socket, over a pair of sockets within this process."""

    def __init__(self) -> None:
        self.outside, self._inside = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._inside.setblocking(False)

    def fileno(self) -> int:
        return self._inside.fileno()

    def recvfrom(self, size: int) -> tuple[bytes, tuple[str, int]]:
        return self._inside.recv(size), ("127.0.0.1", 14550)

    def sendto(self, data: bytes, target: Any) -> int:
        return len(data)

    def close(self) -> None:
        self.outside.close()
        self._inside.close()


def _use_mavlink(folder: Path) -> None:
    """Let the bridge hear and answer, as its thread does, while the pilot reports."""
    station = GroundStation(parse_place("udp:127.0.0.1:14550"), folder / "bridge.tlog")
    station._socket.close()
    link = station._socket = _Datagrams()
    try:
        for data in _packets(folder):
            link.outside.send(data)
            station._listen()
            station.show(Estimate(time.monotonic(), (1, 2, 3), (0, 0, 0), (0, 0, 0), (0, 0, 0, 1)))
            station.show(VehicleStatus(time.monotonic(), (0, 0, 0), (0, 0, 0, 0), 4.0, 1))
            station.show(Event(time.monotonic(), Level.INFO, data[:200].decode("utf-8", "replace")))
            station._send_due()
        assert not station.failure, station.failure
    finally:
        link.close()
        if station._log is not None:
            station._log.close()


# DataStream, to the client and to the virtual server


def _datastream(_: Path) -> list[bytes]:
    """Return what a server sends: what it offers, then frames."""
    from cfplan.simulation.virtual_vicon.server import Picture, Shown

    theirs, ours = _streams()
    with theirs, ours:
        server = Connection(theirs, spare=False)
        wanted = datastream.packet(
            (datastream.Block.OBJECT_ENUMS, datastream.kinds(datastream.WANTED)),
            (datastream.Block.REQUEST_FRAME, struct.pack("<?", True)),
        )
        ours.sendall(wanted)
        server.read()
        bodies = (Shown("cf1", "cf1", ((0.1, -0.2, 0.3), (0.0, 0.0, 0.1, 0.99))), Shown("gate", "root", None))
        for number in range(8):
            server.show(Picture(number, 200.0, 0.004, False, bodies))
        ours.setblocking(False)
        stream = memoryview(ours.recv(1 << 20))
    found = []
    while stream:
        size = datastream.PACKET_HEAD.size + datastream.PACKET_HEAD.unpack_from(stream)[1]
        found.append(bytes(stream[:size]))
        stream = stream[size:]
    return [wanted, *found]


def _spoil_datastream(sound: list[bytes], chance: Random, folder: Path) -> None:
    """Write a stream with absurd blocks whose lengths mostly fit, so that they are read."""
    packets = list(sound)
    for _ in range(chance.choice((1, 2, 4))):
        number = chance.randrange(len(packets))
        kind = chance.randrange(6)
        if kind == 0:
            packets[number] = spoil_bytes(packets[number], chance)
        elif kind == 1:
            packets[number:number] = [packets[number]] * chance.choice((1, 5, 100))
        elif kind == 2:
            del packets[number]
        else:
            packets[number] = _spoiled_packet(packets[number], chance)
        if not packets:
            break
    _written(folder, packets)


def _spoiled_packet(content: bytes, chance: Random) -> bytes:
    try:
        blocks = [(kind, bytes(data)) for kind, data in datastream.read_blocks(memoryview(content)[8:])]
    except datastream.MalformedError:
        return content
    if not blocks:
        return content
    number = chance.randrange(len(blocks))
    kind, data = blocks[number]
    changed = bytearray(data)
    how = chance.randrange(6)
    if how == 0 and len(data) >= 8:
        place = len(data) - 8 * chance.randint(1, len(data) // 8)
        changed[place : place + 8] = struct.pack("<d", chance.choice([float(x) for x in NUMBERS]))
    elif how == 1 and len(data) >= 4:
        place = 4 * chance.randrange(len(data) // 4)
        changed[place : place + 4] = struct.pack("<I", chance.choice((0, 1, 2, 255, 2**31, 2**32 - 1, 2**32 // 12)))
    elif how == 2:
        name = chance.choice(TEXTS).encode("utf-8", "surrogatepass")
        changed = bytearray(data.replace(struct.pack("<I", 3) + b"cf1", struct.pack("<I", len(name)) + name))
    elif how == 3:
        blocks[number:number] = [blocks[number]] * chance.choice((1, 30, 3000))
    elif how == 4:
        del blocks[number]
        return datastream.packet(*blocks)
    else:
        changed = bytearray(spoil_bytes(data, chance))
    blocks[number] = (
        kind if chance.random() < 0.9 else chance.choice((*map(int, datastream.Block), 0, 2**32 - 1)),
        bytes(changed),
    )
    return datastream.packet(*blocks)


def _use_datastream(folder: Path) -> None:
    """Feed the client; survey, classify and gate what it gives; and let the virtual server hear the same bytes."""
    content = b"".join(_packets(folder))
    theirs, ours = _streams()
    with theirs:
        theirs.setblocking(False)
        server = Connection(theirs, spare=True)
        with ours, contextlib.suppress(BlockingIOError, BrokenPipeError):
            ours.setblocking(False)
            ours.sendall(content)
            server.read()
        server.close()
    messages = _heard(content)
    surveyor, gate, predictor = Surveyor(), PoseGate(0.1), PosePredictor()
    source = pose_source("vicon://lab/cf1", load_limits(SAFETY).pose)
    source._feed = SimpleNamespace(messages=lambda: messages)
    for message in messages:
        if isinstance(message, child.Scene):
            surveyor.scene = message
        elif isinstance(message, child.Frame):
            surveyor.add(message)
    for body in surveyor.report().bodies:
        str(body.remark)
    for pose in source.poses():
        if not gate.fault(pose):
            predictor.add(pose)
            predictor.position(pose.time + 0.01)
    source._check_subject()


def _heard(content: bytes) -> list[Any]:
    """Return what the driver's process sends of this stream, through its pipe and back."""
    theirs, ours = _streams()

    def send() -> None:
        with contextlib.suppress(OSError), theirs:
            theirs.sendall(content)
            theirs.shutdown(socket.SHUT_WR)
            while theirs.recv(1 << 16):
                pass

    sending = threading.Thread(target=send, daemon=True)
    pipe = bytearray()
    client = datastream_client.DataStreamClient("lab", 801, "vicon://lab/cf1")
    with pytest.MonkeyPatch.context() as patch, ours:
        patch.setattr(datastream_client, "open_connection", lambda *_: ours)
        sending.start()
        try:
            client.connect()
            while True:
                frame = client.wait()
                if (scene := client.scene()) is not None:
                    pipe += child.encoded(scene)
                pipe += child.encoded(frame)
        except (LinkError, InputError) as error:
            _checked(error)
            pipe += child.encoded(error)
        finally:
            client.close()
    sending.join()
    found = child.decoded(pipe)
    if isinstance(found[-1], CfplanError) and "server closed" in found[-1].what:
        found.pop()
    return found


def _checked(error: CfplanError) -> None:
    assert error.hint, f"no hint: {error}"


# CRTP, to the virtual vehicle


def _uplink(chance: Random) -> bytes:
    """Return a packet to a vehicle: mostly of a known kind, with absurd numbers."""
    port, channel, payload = chance.choice(_KINDS)(chance)
    packet = bytes((port << 4 | channel,)) + payload
    if chance.random() < 0.2:
        packet = spoil_bytes(packet, chance)[: chance.choice((1, 2, 5, 31, 31, 64))]
    return packet


def _values(chance: Random, layout: str) -> bytes:
    found = b""
    for code in layout:
        if code == "f":
            found += struct.pack("<f", _float(chance))
        else:
            bits = 8 * struct.calcsize("<" + code)
            numbers = (0, 1, 2, 3, 5, 7, 8, 100, (1 << bits) - 1, 1 << bits - 1)
            found += chance.choice(numbers).to_bytes(16, "little")[: bits // 8]
    return found


_KINDS = (
    *(lambda c, kind=kind, layout=layout: (7, 0, bytes((kind,)) + _values(c, layout)) for kind, layout in (
        (6, "hhhhhhhhhIhhh"), (1, "ffff"), (2, "fffff"), (4, "ffff"), (5, "ffff"), (7, "ffff"), (9, "ffff"),
        (10, "ffff"), (0, ""), (8, "fffHB"),
    )),
    lambda c: (7, 1, b"\0" + _values(c, "I")),
    lambda c: (3, 0, _values(c, "fffH")),
    lambda c: (6, 0, _values(c, "fff")),
    lambda c: (6, 1, b"\x08" + _values(c, "fffffff")),
    lambda c: (6, 1, _values(c, "Bhhh")),
    lambda c: (6, 2, _values(c, "BhhhBhhh")),
    *(lambda c, kind=kind, layout=layout: (8, 0, bytes((kind, 0)) + _values(c, layout)) for kind, layout in (
        (7, "ffBf"), (8, "ffBf"), (12, "BBfffff"), (4, "Bfffff"), (1, "ff"), (2, "ff"), (5, "BBBf"), (6, "BBIB"),
        (3, ""), (0, "B"), (11, "BBBBf"),
    )),
    lambda c: (2, 2, _values(c, "H") + _values(c, c.choice(("f", "B", "H", "I", "b")))),
    lambda c: (2, 2, struct.pack("<H", c.randrange(300)) + _values(c, "f")),
    lambda c: (2, 1, _values(c, "H")),
    lambda c: (2, 3, _values(c, "BH")),
    lambda c: (2, 3, b"\0" + b"stabilizer\0controller\0" + _values(c, "BB")),
    lambda c: (2, 0, _values(c, "BH")),
    lambda c: (5, 0, _values(c, "BH")),
    lambda c: (5, 1, bytes((6, c.randrange(3))) + _values(c, "BHBHBHBH")),
    lambda c: (5, 1, bytes((8, c.randrange(3))) + _values(c, "H")),
    lambda c: (5, 1, _values(c, "BBBH")),
    lambda c: (4, c.randrange(4), _values(c, "BIB")),
    lambda c: (4, 2, b"\1" + struct.pack("<I", c.randrange(0, 4100, 132)) + _values(c, "ffffff")),
    lambda c: (8, 0, struct.pack("<BBBBIB", 6, c.randrange(3), 1, 0, 0, c.randrange(40))),
    lambda c: (9, c.randrange(3), _values(c, "BB")),
    lambda c: (13, c.randrange(3), _values(c, "BB")),
    lambda c: (15, c.randrange(4), _values(c, "BBf")),
    lambda c: (c.randrange(16), c.randrange(4), c.randbytes(c.randrange(31))),
)  # fmt: skip


def _started(folder: Path) -> None:
    """Fly for a moment, so that everything is compiled."""
    for packets in ([], [b"\x6d\x08" + struct.pack("<7f", 0, 0, 0.1, 0, 0, 0, 1), b"\x9d\x01\x01"]):
        _written(folder, packets)
        _use_uplink(folder)


def _spoil_uplink(_: Any, chance: Random, folder: Path) -> None:
    start = (
        [b"\x6d" + b"\x08" + struct.pack("<7f", 0, 0, 0.1, 0, 0, 0, 1), b"\x9d\x01\x01"]
        if chance.random() < 0.7
        else []
    )
    _written(folder, [*start, *(_uplink(chance) for _ in range(chance.choice((1, 3, 10, 40))))])


def _use_uplink(folder: Path) -> None:
    """Send the packets to a virtual vehicle, 10 ms apart, and fly on for a second."""
    packets = _packets(folder)
    old = sum(map(len, packets)) % 4 == 0
    settings = VehicleSettings(firmware="2025.02", protocol=10) if old else VehicleSettings()
    vehicle = VirtualCrazyflie(AIRFRAMES["crazyflie-2.1+"], settings)
    if len(packets) % 2:
        vehicle.use_kalman()
    for packet in packets:
        vehicle.receive(packet)
        vehicle.advance(10)
        _check_answers(vehicle)
    vehicle.advance(1000)
    _check_answers(vehicle)
    vehicle.info()


def _check_answers(vehicle: VirtualCrazyflie) -> None:
    for answer in vehicle.sent():
        assert len(answer) <= 1 + LARGEST_PAYLOAD, answer


# CRTP, from a vehicle


class _Driver(CRTPDriver):
    """A link to a virtual vehicle in this process, with packets slipped in between its answers, or spoiled ones."""

    needs_resending = True
    spoil = staticmethod(lambda packet: packet)  # of what comes from the vehicle
    opened: ClassVar["list[_Driver]"] = []  # the drivers that cflib has made

    def connect(self, uri: str, statistics: object, error: object) -> None:
        if not uri.startswith("fuzz://"):
            raise WrongUriType("not mine")
        self.vehicle = VirtualCrazyflie(AIRFRAMES["crazyflie-2.1+"])
        self.vehicle.use_kalman()
        self.coming: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self.idle = threading.Event()
        self._lock = threading.Lock()
        _Driver.opened.append(self)

    def send_packet(self, packet: Any) -> None:
        with self._lock:
            self.vehicle.receive(bytes((packet.header,)) + bytes(packet.data))
            self.pump(0)

    def pump(self, ticks: int) -> None:
        self.vehicle.advance(ticks)
        for answer in self.vehicle.sent():
            self.coming.put(type(self).spoil(answer))

    def receive_packet(self, wait: float = 0) -> Any:
        try:
            data = self.coming.get_nowait()
        except queue.Empty:
            self.idle.set()
            try:
                data = self.coming.get(timeout=max(0.001, wait) if wait >= 0 else 1.0)
            except queue.Empty:
                return None
        return CRTPPacket(data[0], bytearray(data[1:])) if data else None

    def close(self) -> None:
        pass


class _Tracebacks(logging.Handler):
    """Keeps what cflib logs of exceptions in callbacks that are cfplan's."""

    def __init__(self) -> None:
        super().__init__()
        self.ours: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        if "/cfplan/" in text and "Traceback" in text:
            self.ours.append(text)


def _vehicle(_: Path) -> Any:
    return SimpleNamespace(link=None, driver=None, heard=[], tracebacks=None)


_MOST_THREADS = 40  # cflib has one for each packet that it repeats until it is answered, and some never are
_CONNECTED: Any = None  # the link that all inputs share: connecting takes longer than an input


def _connected() -> Any:
    global _CONNECTED
    if _CONNECTED is not None and threading.active_count() > _MOST_THREADS:
        _CONNECTED.link._crazyflie.link = None  # which ends its threads
        _CONNECTED = None
    if _CONNECTED is None or _CONNECTED.link.lost:
        logger = logging.getLogger("cflib")
        logger.propagate = False
        tracebacks = _Tracebacks()
        logger.handlers = [tracebacks]
        heard: list[Any] = []
        link = connection.connect("fuzz://0", heard.append, [_Driver])
        link.start_logs()
        _CONNECTED = SimpleNamespace(link=link, driver=_Driver.opened[-1], heard=heard, tracebacks=tracebacks)
    return _CONNECTED


def _downlink(chance: Random) -> bytes:
    """Return a packet from a vehicle, mostly of a kind that a link reads."""

    def block() -> bytes:
        return bytes((chance.randrange(4),))

    port, channel, payload = chance.choice(
        (
            (5, 2, block() + chance.randbytes(3) + chance.randbytes(chance.choice((22, 16, 12, 26, 3, 0)))),
            (5, 2, block() + b"\0\0\0" + _values(chance, chance.choice(("fff", "hhhhhhhhhI", "hhhHHHHHH")))),
            (5, 1, _values(chance, "BBB")),
            (5, 0, _values(chance, "BHB")),
            (2, chance.randrange(4), _values(chance, "HBf")),
            (8, chance.randrange(2), _values(chance, "BBBB")),
            (13, 1, chance.choice((b"\1", b"\1\xff\xfe", b"\1" + b"9" * 30, b"\0", b"\2", b""))),
            (15, 0, b"\x05" + struct.pack("<d", chance.choice([float(x) for x in NUMBERS]))),
            (15, chance.randrange(4), chance.randbytes(chance.randrange(31))),
            (0, 0, chance.randbytes(chance.randrange(31))),
            (chance.randrange(16), chance.randrange(4), chance.randbytes(chance.randrange(31))),
        )
    )  # fmt: skip
    packet = bytes((port << 4 | channel,)) + payload
    return (spoil_bytes(packet, chance) or packet)[:32] if chance.random() < 0.2 else packet


def _spoil_downlink(_: Any, chance: Random, folder: Path) -> None:
    _written(folder, [_downlink(chance) for _ in range(chance.choice((1, 3, 10, 40)))])


def _use_downlink(folder: Path) -> None:
    """Slip packets in between the answers of a vehicle; what the link tells must stay finite, and its thread alive."""
    at = _connected()
    at.heard.clear()
    at.tracebacks.ours.clear()
    at.driver.pump(10)
    for packet in _packets(folder):
        at.driver.coming.put(packet)
    at.driver.idle.clear()
    at.driver.coming.put(b"")
    assert at.driver.idle.wait(5.0), "the thread that reads the link has ended"
    assert not at.tracebacks.ours, at.tracebacks.ours[0]
    for message in at.heard:
        if isinstance(message, Estimate | VehicleStatus):
            values = np.concatenate([np.ravel(getattr(message, name)) for name in message.__slots__])
            assert np.isfinite(values.astype(float)).all(), message
    at.link.send_pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    float(at.link.round_trip), at.link.protocol, at.link.firmware


def _use_connecting(folder: Path) -> None:
    """Connect to a vehicle some of whose answers are spoiled, set a parameter and start the logs."""
    logging.getLogger("cflib").handlers, logging.getLogger("cflib").propagate = [_Tracebacks()], False
    chance = Random((folder / _FILE).read_bytes())
    share = chance.choice((0.002, 0.02, 0.3))
    tracebacks = logging.getLogger("cflib").handlers[0]

    def spoil(packet: bytes) -> bytes:
        return (spoil_bytes(packet, chance) or b"\xff")[:32] if chance.random() < share else packet

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_Driver, "spoil", staticmethod(spoil))
        patch.setattr(connection, "WHOLE_CONNECTION", 3.0)
        patch.setattr(connection, "FIRST_ANSWER", 1.0)
        patch.setattr(connection, "_table_cache", lambda: None)
        link = connection.connect("fuzz://1", lambda _: None, [_Driver])
        try:
            link.set_parameter("stabilizer.controller", 2, patience=0.2)
            link.start_logs()
        finally:
            link.close()
    assert isinstance(tracebacks, _Tracebacks)
    assert not tracebacks.ours, tracebacks.ours[0]


LINKS = {
    "MAVLink": Reader(lambda _: None, _spoil_mavlink, _use_mavlink, 3.0),
    "DataStream": Reader(_datastream, _spoil_datastream, _use_datastream),
    "CRTP to the vehicle": Reader(_started, _spoil_uplink, _use_uplink),
    "CRTP from the vehicle": Reader(_vehicle, _spoil_downlink, _use_downlink, 2.0),
    "CRTP while connecting": Reader(lambda _: None, _spoil_downlink, _use_connecting, 0.01),
}
