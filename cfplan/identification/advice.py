"""Advice after a flight: a deviation that grows with speed shows that the vehicle differs from its airframe file.

Unknown latency and drag displace a vehicle along its motion, in proportion to its speed; noise and gusts have no
preferred direction.
"""

import numpy as np

from cfplan.recording.record import Record
from cfplan.recording.summary import reference_span, reference_times

# m of deviation along the motion per m/s. In the virtual lab known vehicles have 4 to 13 mm, those with drag and
# latency off by half some 20; the rest of an unknown vehicle's deviation does not grow with speed.
_MAX_DEVIATION_PER_SPEED = 0.015
_MIN_TOP_SPEED = 0.5  # m/s, least top speed of the flight for this test
_MIN_POSES = 100  # poses


def deviation_per_speed(record: Record) -> float:
    """Return m of horizontal deviation along the motion per m/s of the reference's speed; NaN where not known.

    Positive is ahead. A constant and a part proportional to acceleration are fitted too, and discarded.
    """
    begin, end = reference_span(record)
    time = record.poses.time
    inside = (time > begin) & (time < end) & np.isfinite(record.poses.position).all(axis=1)
    if inside.sum() < _MIN_POSES:
        return np.nan
    due, time = reference_times(record.setpoints), time[inside]

    def interpolated(values: np.ndarray) -> np.ndarray:
        return np.column_stack([np.interp(time, due, axis) for axis in values.T[:2]])

    velocity = interpolated(record.setpoints.velocity)
    if np.linalg.norm(velocity, axis=1).max() < _MIN_TOP_SPEED:
        return np.nan
    deviation = record.poses.position[inside, :2] - interpolated(record.setpoints.position)
    acceleration = np.gradient(velocity, time, axis=0)
    columns = [velocity.ravel(), acceleration.ravel(), np.tile([1.0, 0.0], len(time)), np.tile([0.0, 1.0], len(time))]
    return float(np.linalg.lstsq(np.column_stack(columns), deviation.ravel(), rcond=None)[0][0])


def suggests_identification(record: Record) -> bool:
    """Return whether the flight's deviation grows with speed by more than that of a known vehicle."""
    return abs(deviation_per_speed(record)) > _MAX_DEVIATION_PER_SPEED
