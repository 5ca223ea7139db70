"""A wait before on-board polynomials: one more piece, at rest where they begin."""

import numpy as np
import pytest

from cfplan.flight.on_board.certified_pieces import OnBoardTrajectory
from cfplan.flight.on_board.memory_format import (
    MOST_PIECES,
    POINTS,
    ControlPoints,
    compressed_bytes,
    raw_bytes,
    read_compressed,
    read_raw,
)
from cfplan.flight.on_board.pieces import Pieces, states_at
from cfplan.flight.on_board.wait import WAIT_SIZE, with_wait

START, END = np.array([-0.5, 0.2, 1.0, 0.3]), np.array([0.7, -0.4, 1.3, -0.6])


def raw(count: int) -> OnBoardTrajectory:
    """Pieces of 0.5 s, all together from START to END at a constant speed."""
    coefficients = np.zeros((count, 4, 8))
    coefficients[:, :, 0] = START + np.arange(count)[:, None] / count * (END - START)
    coefficients[:, :, 1] = (END - START) / (0.5 * count)
    pieces = Pieces(np.full(count, 0.5), coefficients)
    memory = raw_bytes(pieces) if count <= MOST_PIECES else b""
    return OnBoardTrajectory(memory, False, pieces, None, None, 0.0)


def compressed() -> OnBoardTrajectory:
    steps = np.array([1e-3, 1e-3, 1e-3, np.radians(0.1)])
    start, end = (np.round(each / steps).astype(int) for each in (START, END))
    points = np.tile(end[None, :, None], (1, 1, POINTS))
    memory = compressed_bytes(ControlPoints(start, np.array([900]), points))
    return OnBoardTrajectory(memory, True, read_compressed(memory), None, None, 0.0)


@pytest.mark.parametrize("made", [raw(3), compressed()], ids=["raw", "compressed"])
def test_it_hovers_at_the_start_and_then_flies_as_before(made):
    waits = with_wait(made, 1.234)
    read = read_compressed(waits.memory) if made.compressed else read_raw(waits.memory, len(waits.pieces.durations))
    assert read.duration == pytest.approx(made.duration + 1.234, abs=1e-5)
    hovering = states_at(read, np.linspace(0.0, 1.233, 7))
    np.testing.assert_allclose(hovering[:, 0], np.tile(states_at(made.pieces, np.zeros(1))[0, 0], (7, 1)), atol=1e-6)
    assert not hovering[:, 1:].any()
    own = np.linspace(0.01, made.duration - 0.01, 9)
    np.testing.assert_allclose(states_at(read, own + 1.234)[:, :3], states_at(made.pieces, own)[:, :3], atol=1e-3)
    added = len(waits.memory) - len(made.memory)
    assert added == (WAIT_SIZE if made.compressed else len(made.memory) // 3)


def test_without_a_wait_it_stays_as_it_is():
    made = raw(2)
    assert with_wait(made, 0.0) is made


def test_more_pieces_than_the_memory_holds_have_no_bytes():
    waits = with_wait(raw(MOST_PIECES), 0.5)
    assert len(waits.pieces.durations) == MOST_PIECES + 1
    assert waits.memory == b""
