"""Payloads against cflib's own encoder and those that the firmware decoded."""

import struct
from pathlib import Path

import numpy as np
import pytest
from cflib.crazyflie.commander import Commander
from cflib.utils.encoding import compress_quaternion as cflib_compress
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from cfplan.errors import NotCertifiedError
from cfplan.flight.setpoints.packets import (
    LARGEST,
    PAYLOAD_SIZE,
    FullStateSetpoints,
    compress_quaternion,
    decode,
    decompress_quaternion,
    encode,
)

FIRMWARE = Path(__file__).parents[4] / "shared" / "data" / "firmware"
VECTORS = ("position", "velocity", "acceleration", "body_rate")


def setpoints(count=50, seed=0, **changes) -> FullStateSetpoints:
    random = np.random.default_rng(seed)
    values = {name: random.uniform(-5, 5, (count, 3)) for name in VECTORS}
    values["quaternion"] = Rotation.random(count, rng=seed).as_quat()
    return FullStateSetpoints(**(values | changes))


class _Recorder:
    """Stands where cflib has its Crazyflie, and keeps what is sent."""

    def __init__(self):
        self.sent = []

    def send_packet(self, packet):
        self.sent.append(packet)


def test_payloads_are_cflibs_where_it_has_nothing_to_truncate():
    meant = setpoints(seed=1)
    meant = FullStateSetpoints(
        **{name: np.round(getattr(meant, name) * 4) / 4 for name in VECTORS}, quaternion=meant.quaternion
    )
    recorder = _Recorder()
    commander = Commander(recorder)
    for row in range(len(meant.position)):
        commander.send_full_state_setpoint(
            meant.position[row], meant.velocity[row], meant.acceleration[row], meant.quaternion[row],
            *meant.body_rate[row],
        )  # fmt: skip
    assert [bytes(packet.data) for packet in recorder.sent] == [row.tobytes() for row in encode(meant)]


def test_quaternions_are_compressed_as_cflib_does():
    quaternions = Rotation.random(2000, rng=2).as_quat()
    assert compress_quaternion(quaternions).tolist() == [cflib_compress(q) for q in quaternions]


def test_decoding_gives_what_was_meant_to_half_a_thousandth():
    meant = setpoints(2000)
    read = decode(encode(meant))
    for name in VECTORS:
        assert np.abs(getattr(read, name) - getattr(meant, name)).max() <= 0.5e-3 + 1e-12
    turned = (Rotation.from_quat(meant.quaternion).inv() * Rotation.from_quat(read.quaternion)).magnitude()
    assert np.degrees(turned).max() <= 0.25


def test_payloads_are_read_as_the_firmware_reads_them():
    if not FIRMWARE.is_dir():
        pytest.skip("the firmware's numbers, ../shared/data/firmware, are not here")
    for number in (0, 1):
        flown = np.load(FIRMWARE / f"closed_loop_mellinger_{number}.npz")
        read = decode(flown["payload"])
        rows = np.hstack([read.position, read.velocity, read.acceleration, read.quaternion, read.body_rate])
        assert rows == pytest.approx(flown["setpoint"], abs=1e-6)
        again = decode(encode(read))
        for name in (*VECTORS, "quaternion"):
            assert getattr(again, name) == pytest.approx(getattr(read, name), abs=1e-12)


def test_one_attitude_can_have_two_codes_that_read_alike():
    """A component of zero may carry either sign: encoding what was decoded need not give the same bytes."""
    plus, minus = 0xC0000000, 0xE0000200
    assert decompress_quaternion(np.array([plus, minus])) == pytest.approx(np.array([[0, 0, 0, 1]] * 2))


@given(arrays(float, (1, 4), elements=st.floats(-1, 1)).filter(lambda q: np.linalg.norm(q) > 1e-3))
def test_any_quaternion_survives_within_a_quarter_degree(quaternion):
    read = decompress_quaternion(compress_quaternion(quaternion))
    turned = Rotation.from_quat(quaternion).inv() * Rotation.from_quat(read)
    assert np.degrees(turned.magnitude()[0]) <= 0.25


def test_a_quaternion_and_its_negative_are_one_attitude():
    quaternions = Rotation.random(500, rng=3).as_quat()
    ours, negated = (decompress_quaternion(compress_quaternion(q)) for q in (quaternions, -quaternions))
    assert ours == pytest.approx(negated, abs=1e-12)


def test_the_layout_is_that_of_the_firmware():
    one = FullStateSetpoints(
        position=np.array([[1.0, -2.0, 3.0]]),
        velocity=np.array([[0.1, 0.2, -0.3]]),
        acceleration=np.array([[4.0, 5.0, -6.0]]),
        quaternion=np.array([[0.0, 0.0, 0.0, 1.0]]),
        body_rate=np.array([[0.7, -0.8, 0.9]]),
    )
    packed = struct.pack(
        "<BhhhhhhhhhIhhh", 6, 1000, -2000, 3000, 100, 200, -300, 4000, 5000, -6000, 3 << 30, 700, -800, 900
    )
    assert encode(one).tobytes() == packed
    assert len(packed) == PAYLOAD_SIZE


@pytest.mark.parametrize("name", VECTORS)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, LARGEST + 0.001, -LARGEST - 0.001])
def test_what_does_not_fit_is_refused_with_its_place(name, bad):
    values = np.zeros((5, 3))
    values[3, 1] = bad
    with pytest.raises(NotCertifiedError, match=name) as caught:
        encode(setpoints(5, **{name: values}))
    assert caught.value.where == "setpoint 3"


@pytest.mark.parametrize("bad", [0.0, np.nan, np.inf])
def test_a_quaternion_that_is_none_is_refused(bad):
    quaternions = Rotation.random(4, rng=4).as_quat()
    quaternions[2] = bad
    with pytest.raises(NotCertifiedError, match="quaternion") as caught:
        encode(setpoints(4, quaternion=quaternions))
    assert caught.value.where == "setpoint 2"
