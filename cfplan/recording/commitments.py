"""Commitments of a record: the setpoints of all plans committed in flight, in one sequence."""

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError
from cfplan.flight.setpoints.encoding import RATE
from cfplan.flight.setpoints.packets import PAYLOAD_SIZE, decode
from cfplan.recording.record import Commitments, Record

_FARTHEST = 5_000_000  # number of a setpoint: 14 hours, more than a record's longest time


def check_commitments(commitments: Commitments, *, where: str) -> None:
    """Raise InputError if these are not setpoints, or their numbers are invalid."""
    for number, (splice, payloads) in enumerate(zip(commitments.splice, commitments.payloads, strict=True)):
        if not payloads or len(payloads) % PAYLOAD_SIZE or not 0 <= splice <= (_FARTHEST if number else 0):
            raise InputError(
                f"commitment {number + 1} holds {len(payloads)} bytes from setpoint {splice} on",
                where=where,
                hint="the record is damaged, or was changed since",
            )


def committed_setpoints(record: Record) -> NDArray:
    """Return (N, 29) uint8, each setpoint as committed last; none if no plan was committed in flight."""
    plans = [
        (int(splice), np.frombuffer(payloads, np.uint8).reshape(-1, PAYLOAD_SIZE))
        for splice, payloads in zip(record.commitments.splice, record.commitments.payloads, strict=True)
    ]
    longest = max((splice + len(rows) for splice, rows in plans), default=0)
    sequence, length = np.empty((longest, PAYLOAD_SIZE), dtype=np.uint8), 0
    for splice, rows in plans:
        if length:
            sequence[length:splice] = sequence[length - 1]  # hover at the end of the earlier setpoints
        length = splice + len(rows)
        sequence[splice:length] = rows
    return sequence[:length]


def committed_path(record: Record) -> NDArray:
    """Return the planned path, (M, 3) m: the header's, or the one committed in flight."""
    sequence = committed_setpoints(record)
    return decode(sequence).position if len(sequence) else record.header.path


def committed_time(record: Record) -> float:
    """Return the planned duration, s: the header's, or until the end of the last committed motion."""
    sequence = committed_setpoints(record)
    if not len(sequence):
        return record.header.travel_time
    moving = np.flatnonzero(np.any(decode(sequence).velocity != 0.0, axis=1))
    return float(moving[-1] + 1) / RATE if len(moving) else 0.0
