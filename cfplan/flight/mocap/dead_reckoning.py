"""Dead reckoning: how the vehicle has moved and turned since a pose, by its own sensors.

A pose that is too old to extrapolate by a straight line tells where the vehicle was, not where it is. Sent unchanged,
it pulls the filter's position back by the distance flown since, and its velocity too: at 1.8 m/s, eight poses that were
0.12 s old lowered the estimated velocity by 0.7 m/s. Without further poses, a vehicle with such an estimate leaves the
room.

The vehicle's log has the motion since the pose, as acceleration and body rates, which are integrated from the last
poses. Position and velocity of the vehicle's estimate are not used, so errors of the filter are not fed back to it as
measurements.
"""

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.telemetry import Estimate, Quaternion, Triple, VehicleStatus
from cfplan.vehicle.rotations import product

_HISTORY = 1.5  # s of log to keep; poses that are sent are younger (`pose.age_brake` is at most 1 s)
_LONGEST_GAP = 0.1  # s between log messages; the motion in a longer gap counts as unknown

_Samples = deque[tuple[float, Triple]]


class SensedMotion:
    """The last second of accelerometer and gyroscope measurements from the vehicle's log."""

    def __init__(self) -> None:
        self._accelerations: _Samples = deque()  # s, m/s² in world axes, without gravity
        self._rates: _Samples = deque()  # s, rad/s in body axes

    def note(self, estimate: Estimate | None, status: VehicleStatus | None) -> None:
        """Take the newest messages of the log; the same ones may come again."""
        if estimate is not None:
            _append(self._accelerations, estimate.time, estimate.acceleration)
        if status is not None:
            _append(self._rates, status.time, status.body_rate)

    def displacement(self, velocity: Triple, at: float, since: float, now: float) -> Triple | None:
        """Return the displacement, m, from `since` to `now`, s, of a vehicle with `velocity`, m/s, at time `at`.

        None if the log has a gap in between.
        """
        known = _between(self._accelerations, at, now, since)
        if known is None:
            return None
        times, acceleration = known
        steps = np.diff(times)[:, None]
        gained = np.cumsum(0.5 * steps * (acceleration[:-1] + acceleration[1:]), axis=0)
        speeds = np.array(velocity) + np.vstack([np.zeros(3), gained])
        ways = steps * speeds[:-1] + steps**2 * (2.0 * acceleration[:-1] + acceleration[1:]) / 6.0
        x, y, z = ways[times[:-1] >= since].sum(axis=0).tolist()
        return x, y, z

    def turn(self, quaternion: Quaternion, since: float, now: float) -> Quaternion | None:
        """Return the attitude at `now`, s, of a vehicle with `quaternion` at `since`; None if the log has a gap."""
        known = _between(self._rates, since, now)
        if known is None:
            return None
        times, rates = known
        for step, rate in zip(np.diff(times), 0.5 * (rates[:-1] + rates[1:]), strict=True):
            angle = float(np.linalg.norm(rate)) * step
            scale = math.sin(0.5 * angle) / angle * step if angle > 0.0 else 0.0
            x, y, z = (scale * rate).tolist()
            quaternion = product(quaternion, (x, y, z, math.cos(0.5 * angle)))
        return quaternion


def _append(samples: _Samples, time: float, value: Triple) -> None:
    if not samples or time > samples[-1][0]:
        samples.append((time, value))
        while time - samples[0][0] > _HISTORY:
            samples.popleft()


def _between(samples: _Samples, begin: float, end: float, *marks: float) -> tuple[NDArray, NDArray] | None:
    """Return times (N,), s, from `begin` to `end`, and values (N, 3) at these; None if there is a gap."""
    times = np.array([time for time, _ in samples])
    if len(times) == 0 or times[0] > begin:
        return None
    before, inside = times[times <= begin][-1:], times[(times > begin) & (times < end)]
    if np.diff(np.concatenate([before, inside, [max(end, before[0])]])).max() > _LONGEST_GAP:
        return None
    grid = np.unique(np.concatenate([[begin], inside, [end], marks]))
    values = np.array([value for _, value in samples])
    return grid, np.column_stack([np.interp(grid, times, values[:, axis]) for axis in range(3)])
