"""Samples of a motion with times, from Blender, a vehicle carried by hand or a motion capture log, as points of a path.

The planner times a path, so only the curve is kept. Samples are as dense and noisy as they were measured, and pile up
where the motion rested; so the curve is cut into steps of equal length, and the samples of each are averaged.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError
from cfplan.geometry.path import Path

STEP = 0.08  # m between points, and averaging length: bends of 0.5 m change by at most 2 mm
_MIN_POINTS = 24  # points of a curve that is too short for this many steps
_MIN_STEP_FRACTION = 0.25  # of a step; samples closer to the last counted one add no length
_MAX_SPEED = 30.0  # m/s between samples; a faster one is another marker, or in another unit
_REST_SPEED = 0.03  # m/s, largest speed at rest
_SHORTEST_REST = 0.3  # s
_MIN_REST_SAMPLES = 10  # samples for which the mean is better than the first
_LONGEST_GAP = 0.5  # s, longest gap that is not reported


@dataclass(frozen=True, slots=True)
class TimedSamples:
    """A measured motion."""

    time: NDArray  # (N,) s, rising
    position: NDArray  # (N, 3) m

    def points(self) -> NDArray:
        """Return points, (K, 3) m, along the way: the first and the last sample, and averages between."""
        counts = _thinned(self.position, STEP * _MIN_STEP_FRACTION)
        way = float(np.linalg.norm(np.diff(self.position[counts], axis=0), axis=1).sum())
        step = min(STEP, way / _MIN_POINTS)
        if step < STEP:
            counts = _thinned(self.position, step * _MIN_STEP_FRACTION)
        along = np.zeros(len(self.position))
        lengths = np.linalg.norm(np.diff(self.position[counts], axis=0), axis=1)
        along[counts[1:]] = lengths
        along = np.cumsum(along)
        bins = np.round(along / step).astype(int)
        inner = (bins > 0) & (bins < bins[-1])
        numbers, which = np.unique(bins[inner], return_inverse=True)
        sums = np.zeros((len(numbers), 3))
        np.add.at(sums, which, self.position[inner])
        means = sums / np.bincount(which, minlength=len(numbers))[:, None]
        first, last = self._end(bins == 0, 0), self._end(bins == bins[-1], -1)
        points = np.concatenate([[first], means, [last]])
        keep = np.append(True, np.linalg.norm(np.diff(points, axis=0), axis=1) > step / 4)
        keep[-1] = True
        return points[keep]

    def _end(self, which: NDArray, index: int) -> NDArray:
        """Return where the motion begins or ends, (3,) m: the mean of a rest, which averages noise out."""
        place = self.position[which]
        rests = len(place) > _MIN_REST_SAMPLES and float(np.ptp(place, axis=0).max()) < STEP / 4
        return np.asarray(place.mean(axis=0) if rests else self.position[index])

    def losses(self, path: Path) -> tuple[str, ...]:
        """Return what the path loses of the motion, a few words each."""
        found = [f"timing is not kept: {self.time[-1] - self.time[0]:.1f} s of {len(self.time)} samples"]
        rests = self._rests()
        if rests:
            found.append(f"{len(rests)} rests are left out, {sum(rests):.1f} s together")
        gap = float(np.diff(self.time).max())
        if gap > _LONGEST_GAP:
            found.append(
                f"there are no samples for {gap:.1f} s before {self.time[1 + np.argmax(np.diff(self.time))]:.1f} s"
            )
        apart = 1000 * distances(path, self.position)
        found.append(f"samples lie up to {apart.max():.0f} mm from the path, {np.median(apart):.1f} mm in median")
        return tuple(found)

    def _rests(self) -> list[float]:
        """Return the durations, s, of rests, also at the ends."""
        if len(self.time) < 3:
            return []
        window = max(1, int(np.searchsorted(self.time - self.time[0], _SHORTEST_REST)))
        if window >= len(self.time):
            return []
        pace = np.linalg.norm(self.position[window:] - self.position[:-window], axis=1)
        slow = pace / (self.time[window:] - self.time[:-window]) < _REST_SPEED
        edges = np.flatnonzero(np.diff(np.concatenate([[0], slow.astype(int), [0]])))
        return [
            float(self.time[min(b - 1 + window, len(self.time) - 1)] - self.time[a]) for a, b in edges.reshape(-1, 2)
        ]


def timed_samples(rows: NDArray, lines: list[int], file: str) -> TimedSamples:
    """Return rows of t, x, y, z, (N, 4), as a motion.

    Raises InputError with the line if time does not rise or the motion jumps, or if there is no motion.
    """
    time, position = rows[:, 0], rows[:, 1:]
    if len(rows) < 2:
        raise InputError("a motion needs at least two samples", where=file, hint="add rows t, x, y, z to the file")
    steps = np.diff(time)
    if (steps <= 0.0).any():
        bad = int(np.argmax(steps <= 0.0))
        raise InputError(
            f"time goes from {time[bad]:g} to {time[bad + 1]:g} s", where=f"{file}:{lines[bad + 1]}",
            hint="the first number of a row is the time in seconds, and rises from row to row",
        )  # fmt: skip
    lengths = np.linalg.norm(np.diff(position, axis=0), axis=1)
    if (lengths > _MAX_SPEED * steps).any():
        bad = int(np.argmax(lengths / steps))
        raise InputError(
            f"the motion jumps by {lengths[bad]:.3g} m within {steps[bad]:.3g} s",
            where=f"{file}:{lines[bad + 1]}",
            hint="give seconds and metres; remove rows where motion capture took another marker",
        )  # fmt: skip
    extent = float(np.ptp(position, axis=0).max())
    if extent < STEP:
        raise InputError(f"the motion stays within {extent:.3f} m", where=file, hint="give metres, and a longer motion")
    return TimedSamples(time, position)


def distances(path: Path, position: NDArray) -> NDArray:
    """Return how far positions, (N, 3) m, are from a path, (N,) m."""
    from scipy.spatial import KDTree  # slow to import

    s = np.linspace(0.0, path.end, max(2, int(path.length / 0.005)))
    nearest = s[KDTree(path(s)).query(position)[1]]
    distance, tangent = position - path(nearest), path(nearest, 1)
    along = np.sum(distance * tangent, axis=1) / np.maximum(np.sum(tangent**2, axis=1), 1e-12)  # 0 at the ends, at rest
    return np.asarray(np.linalg.norm(distance - along[:, None] * tangent, axis=1))


def _thinned(position: NDArray, least: float) -> NDArray:
    """Return the indices of samples that are each at least `least`, m, from the one before; and of the last."""
    chosen, here = [0], position[0]
    for index in range(1, len(position)):
        distance = position[index] - here
        if distance @ distance >= least * least:
            chosen.append(index)
            here = position[index]
    if chosen[-1] != len(position) - 1:
        chosen.append(len(position) - 1)
    return np.array(chosen)
