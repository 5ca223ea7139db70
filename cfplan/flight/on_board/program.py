"""On-board program: a trajectory for the vehicle's memory that ends in a landing, with the pilot's data about it.

After the plan's pieces two more descend to the floor: quickly at first, then at touchdown speed, and on below the
floor, so that a standing vehicle no longer has the thrust to rise. Without its pilot the vehicle then stands instead of
hovering until its battery is empty.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import NotCertifiedError
from cfplan.flight.on_board.certified_pieces import OnBoardTrajectory
from cfplan.flight.on_board.memory_format import (
    END,
    LONGEST,
    POINTS,
    START_SIZE,
    STEPS,
    ControlPoints,
    compressed_bytes,
    raw_bytes,
    read_compressed,
    read_raw,
)
from cfplan.flight.on_board.pieces import Pieces

LANDING_PIECES = 2
LANDING_SIZE = LANDING_PIECES * (3 + 2 * POINTS)  # bytes, compressed: of the height alone
_SLOW_FROM = 0.15  # m above the floor, from where it sinks at touchdown speed
_PERIOD = 70  # ms: durations are multiples of this, in which 0.1 m/s, the touchdown speed, makes integer control points
_BENEATH_FLOOR = 0.3  # m, where no thrust is left, see setpoints/descent.py
_SHORTEST = 1.4  # s of the quick part


@dataclass(frozen=True, slots=True)
class OnBoardProgram:
    """The uploaded trajectory, and the data by which the pilot monitors it."""

    memory: bytes  # from byte 0 of the trajectory memory on
    compressed: bool
    pieces: int
    begin: tuple[float, float, float, float]  # m, m, m, rad, where the first piece begins
    descent: NDArray  # (N, 29) uint8, the landing at its end as setpoints would fly it
    falls: str  # the worst fall after link loss, in words
    deviation: float  # m, from the plan, in the dry run


def with_landing(made: OnBoardTrajectory, floor: float, mean_speed: float) -> tuple[bytes, Pieces]:
    """Return the memory and the pieces of a trajectory with a landing on a floor at `floor`, m.

    `mean_speed`, m/s, is that of the quick part. Raises NotCertifiedError if they do not fit.
    """
    last = made.pieces.coefficients[-1]
    end = _end_of(last, made.pieces.durations[-1])
    sinking = _sinking(end, floor, mean_speed)
    if made.compressed:
        memory = _joined(made.memory, sinking)
        return memory, read_compressed(memory)
    added = read_compressed(compressed_bytes(sinking))
    table = added.coefficients.copy()
    table[:, [0, 1, 3], 0] = end[[0, 1, 3]]  # these are exact already
    table[:, 2, 0] += np.float32(end[2]) - added.coefficients[0, 2, 0]
    pieces = Pieces(
        np.concatenate([made.pieces.durations, added.durations]), np.concatenate([made.pieces.coefficients, table])
    )
    memory = raw_bytes(pieces)
    return memory, read_raw(memory, len(pieces.durations))


def _end_of(table: NDArray, duration: float) -> NDArray:
    """Return where a piece, (4, 8), ends: (4,) m and rad."""
    return np.asarray(table.astype(float) @ float(duration) ** np.arange(table.shape[1]))


def _sinking(end: NDArray, floor: float, mean_speed: float) -> ControlPoints:
    """Return the two pieces of the landing, in whole steps of compressed memory, from a rest at `end`, (4,), to one.

    Raises NotCertifiedError if the landing is too slow for two pieces.
    """
    start = np.round(end / STEPS).astype(int)
    lowest = round(1000 * (floor - _BENEATH_FLOOR))
    way = max(int(start[2]) - round(1000 * (floor + _SLOW_FROM)), 0)
    quick = _PERIOD * math.ceil(max(_SHORTEST, way / 1000 / mean_speed) * 1000 / _PERIOD)
    step = quick // _PERIOD  # mm from one control point to the next, at the pace to touch the floor
    middle = int(start[2]) - max(way, 3 * step)
    if middle <= lowest or quick > 1000 * LONGEST:
        raise NotCertifiedError(
            f"sinking {way / 1000:.1f} m at {mean_speed:g} m/s takes {quick / 1000:.0f} s, too long for two pieces",
            where="landing", hint="raise `ground.land_speed` in safety.yaml",
        )  # fmt: skip
    slow = _PERIOD * max(round((middle - lowest) / 7), 1)
    points = np.tile(start[:, None], (2, 1, 7))
    points[0, 2, 3:] = middle + step * np.arange(3, -1, -1)
    points[1, 2, :3] = middle - slow // _PERIOD * np.arange(1, 4)
    points[1, 2, 3:] = lowest
    return ControlPoints(start, np.array([quick, slow]), points)


def _joined(memory: bytes, sinking: ControlPoints) -> bytes:
    """Return compressed memory with more pieces appended, which begin where the first ones end."""
    return memory[: -len(END)] + compressed_bytes(sinking)[START_SIZE:]
