"""A wait before on-board polynomials: a hover at their start, for a vehicle that begins later than the others."""

from dataclasses import replace

import numpy as np

from cfplan.flight.on_board.certified_pieces import OnBoardTrajectory
from cfplan.flight.on_board.memory_format import (
    END,
    MOST_PIECES,
    POINTS,
    START_SIZE,
    ControlPoints,
    compressed_bytes,
    raw_bytes,
    read_compressed,
)
from cfplan.flight.on_board.pieces import AXES, COUNT, Pieces

WAIT_SIZE = len(END)  # bytes, of a compressed wait
WAIT_STEP = 0.001  # s: waits are multiples of this


def with_wait(made: OnBoardTrajectory, wait: float) -> OnBoardTrajectory:
    """Return the trajectory with one more piece, which hovers for `wait`, s, before the others; none if that is 0.

    As in the trajectory given, there are no bytes where there are more pieces than the memory holds.
    """
    if wait == 0.0:
        return made
    if made.compressed:
        start = np.frombuffer(made.memory, "<i2", AXES).astype(int)
        hover = ControlPoints(start, np.array([round(wait / WAIT_STEP)]), np.tile(start[None, :, None], (1, 1, POINTS)))
        memory = compressed_bytes(hover).removesuffix(END) + made.memory[START_SIZE:]
        return replace(made, memory=memory, pieces=read_compressed(memory))
    coefficients = np.zeros((1, AXES, COUNT))
    coefficients[0, :, 0] = made.pieces.coefficients[0, :, 0]
    pieces = Pieces(np.append([wait], made.pieces.durations), np.concatenate([coefficients, made.pieces.coefficients]))
    fits = len(pieces.durations) <= MOST_PIECES
    return replace(made, memory=raw_bytes(pieces) if fits else b"", pieces=pieces)
