"""Advice after a flight: whether its deviation grows with speed, as a vehicle does that is not as its file says.

What a lab does not know of its vehicle, drag and latency above all, moves it by metres per (metre per second); noise
and air move it as far in hover.
"""

import numpy as np

from cfplan.recording.record import Record
from cfplan.recording.summary import deviation, reference_span

_LEAST_SLOPE = 0.010  # m of deviation per m/s; a known vehicle has some 5 mm, 20 ms of latency alone 20
_LEAST_CORRELATION = 0.3
_LEAST_SPEED = 0.5  # m/s, by which the speeds of the flight must differ
_FEWEST = 100  # poses


def deviation_growth(record: Record) -> tuple[float, float]:
    """Return m of deviation in time per m/s of the reference's speed, and their correlation; NaN where not known."""
    begin, end = reference_span(record)
    along = deviation(record, begin, end)
    if len(along.time) < _FEWEST:
        return np.nan, np.nan
    wanted = np.linalg.norm(record.setpoints.velocity, axis=1)
    speed = np.interp(along.time, record.setpoints.due, wanted)
    if not np.ptp(speed) >= _LEAST_SPEED or not np.ptp(along.in_time) > 0.0:
        return np.nan, np.nan
    slope = float(np.polyfit(speed, along.in_time, 1)[0])
    return slope, float(np.corrcoef(speed, along.in_time)[0, 1])


def suggests_identification(record: Record) -> bool:
    """Return whether the flight's deviation grows with speed by more than a vehicle's that is known."""
    slope, correlation = deviation_growth(record)
    return slope > _LEAST_SLOPE and correlation > _LEAST_CORRELATION
