"""The trajectory memory: what the firmware reads from it, and what cflib would have written."""

import json
from pathlib import Path

import numpy as np
import pytest
from cflib.crazyflie.mem.trajectory_memory import CompressedSegment, CompressedStart, Poly4D
from hypothesis import given, settings
from hypothesis import strategies as st

from cfplan.errors import NotCertifiedError
from cfplan.flight.on_board.memory_format import (
    MEMORY_SIZE,
    MOST_PIECES,
    STEPS,
    ControlPoints,
    compressed_bytes,
    compressed_size,
    raw_bytes,
    read_compressed,
    read_raw,
)
from cfplan.flight.on_board.pieces import Pieces, goals_at

# Bytes, and what crazyflie-firmware 2026.08 (2a18fc29) makes of them: its pptraj.c and pptraj_compressed.c, compiled
# for a PC without fused multiplications, at each time: position, velocity, acceleration, jerk, body rates, yaw.
FIRMWARE = json.loads((Path(__file__).parents[2] / "data" / "firmware_polynomials.json").read_text())
SCALES = np.repeat([1.0, 1.0, 10.0, 100.0, 10.0, 1.0], [3, 3, 3, 3, 3, 1])


def table(goals):
    vectors = [goals.position, goals.velocity, goals.acceleration, goals.jerk, goals.body_rate, goals.yaw[:, None]]
    return np.concatenate(vectors, axis=1)


def some_pieces(count=5, seed=0):
    random = np.random.default_rng(seed)
    return Pieces(random.uniform(0.2, 1.0, count), random.normal(size=(count, 4, 8)))


def test_raw_pieces_are_flown_as_the_firmware_flies_them_to_the_last_bit_but_for_trigonometry():
    case = FIRMWARE["raw"]
    pieces = read_raw(bytes.fromhex(case["memory"]), case["count"])
    found = table(goals_at(pieces, np.array(case["times"])))
    np.testing.assert_array_equal(found[:, :12], np.array(case["goals"], dtype=np.float32)[:, :12])
    np.testing.assert_allclose(found, case["goals"], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", ["compressed", "types"])
def test_compressed_pieces_are_flown_as_the_firmware_flies_them(name):
    case = FIRMWARE[name]
    pieces = read_compressed(bytes.fromhex(case["memory"]))
    assert pieces.duration == pytest.approx(case["duration"], abs=1e-6)
    found = table(goals_at(pieces, np.array(case["times"])))
    # The firmware adds durations up where goals_at takes them away, so its time is another in the seventh digit.
    np.testing.assert_array_less(np.abs(found - case["goals"]) / (SCALES + np.abs(case["goals"])), 2e-5)


def test_raw_bytes_are_those_of_cflib_and_read_back():
    pieces = some_pieces()
    packed = b"".join(
        bytes(Poly4D(float(duration), *(Poly4D.Poly(axis.tolist()) for axis in table)).pack())
        for duration, table in zip(pieces.durations, pieces.coefficients, strict=True)
    )
    assert raw_bytes(pieces) == packed
    again = read_raw(packed, len(pieces.durations))
    np.testing.assert_array_equal(again.coefficients, pieces.coefficients)
    np.testing.assert_array_equal(again.durations, pieces.durations)


def test_a_memory_takes_31_pieces():
    assert len(raw_bytes(some_pieces(MOST_PIECES))) <= MEMORY_SIZE
    with pytest.raises(NotCertifiedError, match="holds 31"):
        raw_bytes(some_pieces(MOST_PIECES + 1))


def walks(count):
    """Control points that wander, some axes at rest."""
    step = st.integers(-900, 900)
    return st.lists(
        st.lists(st.lists(step, min_size=7, max_size=7), min_size=4, max_size=4), min_size=1, max_size=count
    )


@settings(max_examples=60, deadline=None)
@given(
    start=st.lists(st.integers(-9000, 9000), min_size=4, max_size=4), steps=walks(4),
    still=st.sets(st.integers(0, 3)), duration=st.integers(50, 3000),
)  # fmt: skip
def test_compressed_bytes_are_those_of_cflib_and_lead_through_their_end_points(start, steps, still, duration):
    moves = np.array(steps)
    moves[:, sorted(still)] = 0
    points = np.array(start)[None, :, None] + np.cumsum(moves.transpose(1, 0, 2).reshape(4, -1), axis=1).reshape(
        4, len(moves), 7
    ).transpose(1, 0, 2)
    if np.abs(points).max() > 32767:
        points = np.clip(points, -32767, 32767)
    curve = ControlPoints(np.array(start), np.full(len(points), duration), points)
    memory = compressed_bytes(curve)
    assert len(memory) == compressed_size(curve.moves)

    metres = (points + 0.25 * np.sign(points)) * STEPS[:, None]  # cflib cuts off what is behind the point
    begin = (np.array(start) + 0.25 * np.sign(start)) * STEPS
    packed = CompressedStart(*begin).pack() + b"".join(
        bytes(
            CompressedSegment(
                (duration + 0.25) * 1e-3,
                *([*axis] if moving else [] for axis, moving in zip(piece, moved, strict=True)),
            ).pack()
        )
        for piece, moved in zip(metres, curve.moves, strict=True)
    )
    assert memory == bytes(packed) + b"\0\0\0"

    pieces = read_compressed(memory)
    ends = goals_at(pieces, np.array([pieces.duration + 1.0]))
    np.testing.assert_allclose(ends.position[0], points[-1, :3, -1] * STEPS[:3], atol=2e-3)
    np.testing.assert_allclose(ends.yaw[0], points[-1, 3, -1] * STEPS[3], atol=2e-3)


def test_pieces_without_an_end_are_refused_as_the_firmware_would_read_on():
    memory = bytes.fromhex(FIRMWARE["compressed"]["memory"])
    with pytest.raises(NotCertifiedError, match="do not end"):
        read_compressed(memory[:-3])


@pytest.mark.parametrize(
    ("value", "duration", "words"),
    [(40000, 500, r"32\.767 m"), (100, 70000, r"65\.535 s"), (100, 0, r"65\.535 s")],
)
def test_what_does_not_fit_its_bits_is_refused(value, duration, words):
    points = np.zeros((1, 4, 7), dtype=int)
    points[0, 0] = value
    with pytest.raises(NotCertifiedError, match=words):
        compressed_bytes(ControlPoints(np.zeros(4, dtype=int), np.array([duration]), points))


def test_too_many_compressed_pieces_are_refused():
    points = np.cumsum(np.ones((100, 4, 7), dtype=int), axis=2) + 7 * np.arange(100)[:, None, None]
    with pytest.raises(NotCertifiedError, match="4096"):
        compressed_bytes(ControlPoints(np.zeros(4, dtype=int), np.full(100, 500), points))


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e39])
def test_pieces_of_numbers_that_float32_lacks_are_refused(bad):
    coefficients = np.zeros((2, 4, 8))
    coefficients[1, 2, 3] = bad
    with pytest.raises(NotCertifiedError, match="too large"):
        Pieces(np.ones(2), coefficients)
