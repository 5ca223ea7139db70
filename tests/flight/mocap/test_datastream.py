"""Vicon's DataStream, byte by byte."""

import math
import socket
import struct
import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cfplan.errors import InputError, LinkError
from cfplan.flight.mocap.datastream import Block, Decoder, kinds, packet, read_blocks
from cfplan.flight.mocap.datastream_client import DataStreamClient


def block(kind, payload):
    return struct.pack("<II", kind, len(payload)) + payload


def text(value):
    return struct.pack("<I", len(value)) + value.encode()


def subject(number, name, *segments):
    """Segments as (id, parent, name)."""
    rows = b"".join(struct.pack("<II6f", parent, own, *[0.0] * 6) + text(called) for own, parent, called in segments)
    return block(2, struct.pack("<I", number) + text(name) + struct.pack("<I", len(segments)) + rows + bytes(8))


def segments(number, *rows):
    """Rows as (segment, position in mm, rotation matrix)."""
    data = b"".join(struct.pack("<I12d", own, *place, *np.asarray(turn).ravel()) for own, place, turn in rows)
    return block(9, struct.pack("<II", number, len(rows)) + data)


def frame_info(number):
    return block(5, struct.pack("<I", number))


def contents(*unchanged):
    return block(100004, struct.pack(f"<II{len(unchanged)}I", 0, len(unchanged), *unchanged))


def decode(decoder, *blocks):
    return decoder.frame(memoryview(b"".join(blocks)), 1.0)


TURN = Rotation.from_rotvec([0.3, -0.8, 2.0])


@pytest.mark.parametrize("parts", [(math.inf, -math.inf), (1e308, 1e308), (math.inf,), (math.nan,), (-1e9,), (1e9,)])
def test_an_absurd_latency_is_not_known(parts):
    told = struct.pack("<I", len(parts)) + b"".join(text(str(i)) + struct.pack("<d", v) for i, v in enumerate(parts))
    frame = decode(Decoder(), contents(), subject(4, "cf1", (1, 0, "cf1")), frame_info(77), block(26, told))
    assert math.isnan(frame.latency)


def test_a_frame_is_read_field_by_field():
    frame = decode(
        Decoder(),
        contents(),
        subject(4, "cf1", (1, 0, "cf1")),
        subject(9, "gate", (1, 0, "gate")),
        frame_info(77),
        segments(4, (1, (1000.0, -2000.0, 300.0), TURN.as_matrix())),
        segments(9),
        block(26, struct.pack("<I", 2) + text("A") + struct.pack("<d", 0.003) + text("B") + struct.pack("<d", 0.004)),
        block(39, struct.pack("<I", 1) + text("Hardware") + struct.pack("<d", 200.0)),
        block(40, struct.pack("<Id", 4, 0.75)),
    )
    assert (frame.number, frame.rate, frame.hidden) == (77, 200.0, ("gate",))
    assert frame.latency == pytest.approx(0.007)
    (body,) = frame.bodies
    assert (body.name, body.quality) == ("cf1", 0.75)
    assert body.position == pytest.approx((1.0, -2.0, 0.3))
    assert (Rotation.from_quat(body.quaternion) * TURN.inv()).magnitude() < 1e-12


def test_y_up_becomes_z_up():
    """A body that stands at (1, 2, 3) where y is up stands at (1, -3, 2) where z is."""
    lean = Rotation.from_rotvec([0.0, 0.7, 0.0])  # about the vertical
    frame = decode(
        Decoder(), block(37, b"\1"), subject(1, "a", (1, 0, "a")), frame_info(1),
        segments(1, (1, (1000, 2000, 3000), lean.as_matrix())),
    )  # fmt: skip
    assert frame.bodies[0].position == pytest.approx((1.0, -3.0, 2.0))
    assert Rotation.from_quat(frame.bodies[0].quaternion).as_rotvec() == pytest.approx([0.0, 0.0, 0.7])


@given(st.integers(0, 2**32 - 1))
def test_every_rotation_survives(seed):
    turn = Rotation.random(rng=np.random.default_rng(seed))
    frame = decode(
        Decoder(), subject(1, "a", (1, 0, "a")), frame_info(1), segments(1, (1, (1, 2, 3), turn.as_matrix()))
    )
    assert (Rotation.from_quat(frame.bodies[0].quaternion) * turn.inv()).magnitude() < 1e-7


@pytest.mark.parametrize("matrix", [np.zeros(9), np.full(9, math.nan), -np.eye(3), 2 * np.eye(3), np.ones(9)])
def test_what_is_no_rotation_is_not_a_number(matrix):
    frame = decode(Decoder(), subject(1, "a", (1, 0, "a")), frame_info(1), segments(1, (1, (1, 2, 3), matrix)))
    assert all(map(math.isnan, frame.bodies[0].quaternion))


def test_the_segment_named_as_its_body_is_taken_else_the_root():
    rows = [(2, (2000, 0, 0), np.eye(3)), (1, (1000, 0, 0), np.eye(3))]
    decoder = Decoder()
    named = decode(decoder, subject(1, "a", (1, 0, "hip"), (2, 1, "a")), frame_info(1), segments(1, *rows))
    assert named.bodies[0].position[0] == 2.0
    assert decoder.scene.subjects[0].segments == ("a", "hip")
    rooted = decode(Decoder(), subject(1, "a", (2, 1, "foot"), (1, 0, "hip")), frame_info(1), segments(1, *rows))
    assert rooted.bodies[0].position[0] == 1.0


def test_what_is_unchanged_is_kept():
    decoder = Decoder()
    decode(decoder, subject(1, "a", (1, 0, "a")), frame_info(1), segments(1, (1, (1000, 0, 0), np.eye(3))))
    moved = decode(decoder, contents(2), frame_info(2), segments(1, (1, (2000, 0, 0), np.eye(3))))
    assert moved.bodies[0].position[0] == 2.0
    kept = decode(decoder, contents(2, 9), frame_info(3))
    assert kept.bodies[0].position[0] == 2.0
    hidden = decode(decoder, contents(2), frame_info(4))
    assert hidden.hidden == ("a",)


def test_a_packet_without_a_frame_is_none():
    assert decode(Decoder(), block(42, bytes(8))) is None


def test_what_is_packed_is_unpacked():
    body = packet((Block.PING, b"12345678"), (Block.OBJECT_ENUMS, kinds([9, 2])))[8:]
    assert [(kind, bytes(data)) for kind, data in read_blocks(memoryview(body))] == [
        (42, b"12345678"), (100001, struct.pack("<III", 2, 2, 9)),
    ]  # fmt: skip


@pytest.fixture
def talker():
    """A server that says what it is given to one client after the other, then closes or stays silent."""
    listener = socket.create_server(("127.0.0.1", 0))
    clients = []

    def say(data, *, close, **settings):
        def run():
            client, _ = listener.accept()
            clients.append(client)
            client.sendall(data)
            if close:
                client.close()

        threading.Thread(target=run, daemon=True).start()
        return DataStreamClient("127.0.0.1", listener.getsockname()[1], "vicon://here", **settings)

    yield say
    for client in clients:
        client.close()
    listener.close()


ENUMS = packet((Block.OBJECT_ENUMS, kinds([2, 5, 9])))


def test_another_server_is_told_from_vicon(talker):
    with pytest.raises(InputError, match="not a Vicon") as caught:
        talker(b"SSH-2.0-OpenSSH_9.2\r\n", close=False).connect()
    assert caught.value.hint


def test_a_silent_server_is_given_up(talker):
    with pytest.raises(LinkError, match="nothing came"):
        talker(b"", close=False, frame_timeout=0.05).connect()


def test_a_stream_that_ends_is_a_lost_link(talker):
    client = talker(ENUMS + packet((Block.FRAME_INFO, struct.pack("<I", 1)))[:-2], close=True)
    client.connect()
    with pytest.raises(LinkError, match=r"closed|lost"):
        client.wait()
    client.close()
    client.close()


def test_a_damaged_stream_is_a_lost_link(talker):
    client = talker(ENUMS + packet((Block.FRAME_INFO, b"\1")), close=False)
    client.connect()
    with pytest.raises(LinkError, match="damaged"):
        client.wait()
    client.close()


def test_nobody_there_is_an_error_at_once():
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with pytest.raises(LinkError, match="refused") as caught:
        DataStreamClient("127.0.0.1", port, "vicon://here").connect()
    assert caught.value.where == "vicon://here"


def test_an_unknown_name_is_an_error():
    with pytest.raises(InputError, match="nowhere"):
        DataStreamClient("nowhere.invalid", 801, "vicon://nowhere.invalid").connect()
