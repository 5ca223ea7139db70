"""Correction: a shift of what a vehicle is asked to fly, by what it strayed in earlier flights of the same plan.

The shift is a B-spline in time that is zero, with four derivatives, at both ends of the flight. A trajectory with it is
a trajectory again, along γ(s) + δ(t(s)) by the same profile: all that certifies, encodes and flies trajectories does so
with a corrected one.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError
from cfplan.geometry.path import Path
from cfplan.geometry.polynomials import hermite, padded, shifted
from cfplan.vehicle.profile import ProfileSample, SpeedProfile
from cfplan.vehicle.trajectory import Trajectory

DEGREE = 5  # so that the fourth derivative is continuous, as snap makes angular acceleration
_ORDERS = 5  # the shift and four derivatives
_LONGEST_PIECE = 0.1  # s, in which a polynomial of degree 9 is within 1e-9 m of the shift
_HERMITE = hermite(_ORDERS)


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """A shift over the time of a flight; a flight of another duration stretches it.

    Raises InputError where the duration is not positive, or a coefficient not finite.
    """

    coefficients: NDArray  # (J, 3) m, of evenly spaced B-splines of DEGREE, none of which reaches beyond the flight
    duration: float  # s

    def __post_init__(self) -> None:
        shifts = np.array(self.coefficients, dtype=float).reshape(-1, 3)
        if not (np.isfinite(shifts).all() and np.isfinite(self.duration) and self.duration > 0.0):
            raise InputError("a correction is not finite, or has no duration", where="correction",
                             hint="learn it anew from a flight")  # fmt: skip
        shifts.setflags(write=False)
        object.__setattr__(self, "coefficients", shifts)

    @property
    def spacing(self) -> float:
        """Return the time between knots, s."""
        return self.duration / (len(self.coefficients) + DEGREE)

    def at(self, times: NDArray, duration: float | None = None) -> NDArray:
        """Return the shift and four derivatives, (N, 5, 3), at times of a flight that lasts `duration`, s."""
        from scipy.interpolate import BSpline  # slow to import

        stretch = (duration or self.duration) / self.duration
        out = np.zeros((len(times), _ORDERS, 3))
        if len(self.coefficients):
            knots = self.spacing * np.arange(len(self.coefficients) + DEGREE + 1)
            shift = BSpline(knots, self.coefficients, DEGREE)
            own = np.asarray(times, dtype=float) / stretch
            flying = (own > 0.0) & (own < knots[-1])
            for order in range(_ORDERS):
                out[flying, order] = shift(own[flying], nu=order) / stretch**order
        return out


def corrected(trajectory: Trajectory, correction: Correction) -> Trajectory:
    """Return the trajectory along the shifted path, with the same speed profile and yaw."""
    path, profile = trajectory.path, trajectory.profile
    breaks, interval = _breaks(trajectory)
    begin, end, length = breaks[:-1], breaks[1:], np.diff(breaks)
    sides = [_by_path(trajectory, correction, s, profile.at(s, interval)) for s in (begin, end)]
    scale = (length[:, None] ** np.arange(_ORDERS))[:, :, None]
    unit = _HERMITE @ np.concatenate([each * scale for each in sides], axis=1)  # (M, 10, 3) on [0, 1]
    shift = unit / (length[:, None] ** np.arange(2 * _ORDERS))[:, :, None]
    count = max(2 * _ORDERS, path.coefficients.shape[1])
    origins = begin.copy()
    origins[-1] = end[-1]
    piece = np.clip(np.searchsorted(path.breaks, 0.5 * (begin + end), side="right") - 1, 0, len(path.origins) - 1)
    table = shifted(padded(path.coefficients[piece], count), origins - path.origins[piece])
    return Trajectory(
        Path(breaks, table + shifted(padded(shift, count), origins - begin)), profile, trajectory.airframe
    )


def _breaks(trajectory: Trajectory) -> tuple[NDArray, NDArray]:
    """Return the ends of the corrected path's pieces, (M + 1,), and the interval of the profile of each, (M,)."""
    profile = trajectory.profile
    ends = np.unique(np.concatenate([trajectory.path.breaks, profile.s]))
    ends = np.concatenate([ends[:1], ends[1:][np.diff(ends) > 1e-9 * ends[-1]]])
    ends[-1] = trajectory.path.end
    lasting = np.diff(trajectory.time_at(ends))
    parts = np.maximum(np.ceil(lasting / _LONGEST_PIECE).astype(int), 1)
    parts = np.maximum(parts, 2) if len(parts) == 1 else parts
    inner = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(ends[:-1], ends[1:], parts, strict=True)]
    breaks = np.append(np.concatenate(inner), ends[-1])
    return breaks, profile.interval(0.5 * (breaks[:-1] + breaks[1:]))


def _by_path(trajectory: Trajectory, correction: Correction, s: NDArray, sample: ProfileSample) -> NDArray:
    """Return the shift and four derivatives by s, (M, 5, 3), at s, (M,), where the profile is `sample`."""
    h, dh, ddh, dddh = (each[:, None] for each in (sample.h, sample.dh, sample.ddh, sample.dddh))
    t1 = h**-0.5  # of t(s)
    t2 = -0.5 * dh * t1**3
    t3 = 0.75 * dh**2 * t1**5 - 0.5 * ddh * t1**3
    t4 = -1.875 * dh**3 * t1**7 + 2.25 * dh * ddh * t1**5 - 0.5 * dddh * t1**3
    d0, d1, d2, d3, d4 = np.moveaxis(correction.at(trajectory.time_at(s), trajectory.duration), 1, 0)
    return np.stack([
        d0,
        d1 * t1,
        d2 * t1**2 + d1 * t2,
        d3 * t1**3 + 3.0 * d2 * t1 * t2 + d1 * t3,
        d4 * t1**4 + 6.0 * d3 * t1**2 * t2 + d2 * (3.0 * t2**2 + 4.0 * t1 * t3) + d1 * t4,
    ], axis=1)  # fmt: skip
