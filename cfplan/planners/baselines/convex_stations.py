"""Stations: a path by arc length with curvature and the frame of flight, bounded around each station.

By arc length l the motion is v = √b T and a = ½b' T + b k with the curvature vector k = κN, so every limit on the
norm of a, or of a + g e₃, lies in the plane of T and N. At a rest end γ' vanishes and h may grow without bound while
b = |γ'|²h stays bounded: hence nothing here is in cfplan's own parameter s.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.geometry.path import Path

SAMPLES_PER_STATION = 5  # fine samples between stations at nominal speed, 1 m/s
SAMPLES_MIN, SAMPLES_MAX = 2_000, 500_000
MAX_STATIONS = 25_000  # each takes some 8 kB, and time in proportion; longer paths have them further apart
STATION_GROWTH = 0.05  # of the distance from the path's nearer end: curvature is unbounded at a rest end
FIRST_STATION = 1e-5  # m from an end
SWING = 0.2  # change of e₃·N around a station, above which samples do not bound it


@dataclass(frozen=True, slots=True)
class Stations:
    """Geometry at each of M stations. low and high bound it over both intervals that touch the station."""

    length: NDArray  # (M,) m along the path, from 0
    s: NDArray  # (M,)
    curvature: NDArray  # (M,) 1/m
    curvature_low: NDArray  # (M,) 1/m
    curvature_high: NDArray  # (M,) 1/m
    slope: NDArray  # (M,) e₃·T
    slope_low: NDArray  # (M,)
    slope_high: NDArray  # (M,)
    normal: NDArray  # (M,) e₃·N
    normal_low: NDArray  # (M,)
    normal_high: NDArray  # (M,)
    binormal_square: NDArray  # (M,) (e₃·B)²
    binormal_square_low: NDArray  # (M,)


def stations(path: Path, *, spacing: float, turn: float) -> Stations:
    """Return stations at most `spacing`, m, and `turn`, rad of direction, apart; closer towards the path's ends.

    If that took more than MAX_STATIONS, all are further apart by the same factor.
    """
    samples = int(np.clip(SAMPLES_PER_STATION * path.end / spacing, SAMPLES_MIN, SAMPLES_MAX))
    # Graded towards both ends, so that a rest end's first micrometres are resolved.
    x = np.linspace(0.0, 1.0, samples + 1)
    s = path.end * (x - np.sin(2 * np.pi * x) / (2 * np.pi) * 0.9)
    length, curvature, slope, normal = frame(path, s)
    total = length[-1]
    distance = np.minimum(length, total - length) + FIRST_STATION
    # Near a rest end curvature grows as distance to the power of -3/4 while b grows as distance: κb vanishes there.
    density = np.maximum(1 / spacing, 1 / (STATION_GROWTH * distance))
    density = np.maximum(density, np.minimum(curvature, 1 / distance) / turn)
    count = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(length))])
    wanted = np.linspace(0.0, count[-1], min(int(np.ceil(count[-1])), MAX_STATIONS) + 1)
    chosen = np.unique(np.concatenate([[0], np.searchsorted(count, wanted[1:-1]), [samples]]))
    binormal_square = np.clip(1.0 - slope**2 - normal**2, 0.0, 1.0)

    def around(values: NDArray, extreme: np.ufunc) -> NDArray:
        inside = extreme(extreme.reduceat(values, chosen[:-1]), values[chosen[1:]])
        return extreme(np.append(inside, inside[-1]), np.insert(inside, 0, inside[0]))

    normal_low, normal_high = around(normal, np.minimum), around(normal, np.maximum)
    binormal_square_low = around(binormal_square, np.minimum)
    # Where the path is nearly straight the normal may swing round between two samples: then any direction is allowed.
    swinging = normal_high - normal_low > SWING
    normal_low, normal_high = np.where(swinging, -1.0, normal_low), np.where(swinging, 1.0, normal_high)
    binormal_square_low = np.where(swinging, 0.0, binormal_square_low)
    return Stations(
        length[chosen], s[chosen],
        curvature[chosen], around(curvature, np.minimum), around(curvature, np.maximum),
        slope[chosen], around(slope, np.minimum), around(slope, np.maximum),
        normal[chosen], normal_low, normal_high,
        binormal_square[chosen], binormal_square_low,
    )  # fmt: skip


def frame(path: Path, s: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Return arc length, curvature, e₃·T and e₃·N at each s, (N,).

    At a rest end the frame is that of the nearest sample that moves.
    """
    first, second = path(s, 1), path(s, 2)
    speed = np.linalg.norm(first, axis=1)
    moving = speed > 1e-9 * speed.max()
    # Simpson's rule on every interval, with the speed at the middles.
    middle = np.linalg.norm(path(0.5 * (s[1:] + s[:-1]), 1), axis=1)
    steps = np.diff(s) * (speed[1:] + 4 * middle + speed[:-1]) / 6
    length = np.concatenate([[0.0], np.cumsum(steps)])

    safe = np.where(moving, speed, 1.0)
    tangent = first / safe[:, None]
    along = np.einsum("ij,ij->i", second, tangent)
    bend = (second - along[:, None] * tangent) / (safe**2)[:, None]
    curvature = np.linalg.norm(bend, axis=1)
    bends = curvature > 1e-9
    slope = tangent[:, 2]
    # On a straight the normal is free: the one in the vertical plane of T, so that the binormal is level.
    upward = np.sqrt(np.clip(1.0 - slope**2, 0.0, 1.0))
    normal = np.where(bends, bend[:, 2] / np.where(bends, curvature, 1.0), upward)
    nearest = np.where(moving)[0]
    index = nearest[np.clip(np.searchsorted(nearest, np.arange(len(s))), 0, len(nearest) - 1)]
    return length, curvature[index], slope[index], normal[index]
