"""Certificate of on-board pieces: checks the motion of the decoded pieces against every limit.

The commander commands position, velocity, acceleration and yaw, by which the controller turns its x axis. So the
attitude has z along the thrust and y along z × [cos yaw, sin yaw, 0]. Thrust, attitude, body rates and
motor thrusts follow from the pieces' derivatives up to snap, including drag and the moment by velocity. Samples and the
allowance between them are those of the certificate of trajectories.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import NotCertifiedError
from cfplan.flight.on_board.pieces import Pieces, body_rates, derivatives_of, goals_at
from cfplan.geometry.path import Path
from cfplan.geometry.polynomials import shifted
from cfplan.safety.certificate import (
    LEAST_POINTS,
    TIME_STEP,
    WALLS,
    Certificate,
    Margin,
    half_of,
    obstacle_margin,
    share_of,
)
from cfplan.safety.limits import PlanLimits
from cfplan.safety.quantities import AT_LEAST, QUANTITIES, Quantity
from cfplan.safety.space import Space
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.flatness import motor_thrusts
from cfplan.vehicle.measures import measures_of

_ALLOWANCE = 2.0 / 8.0  # of the second difference, twice what is needed
# Tolerated jumps of position, velocity, acceleration and jerk between pieces: rounding of float32 and of time.
_JOINT_TOLERANCES = np.array([1e-4, 1e-3, 0.01, 0.5])
_NAMES = ("position", "velocity", "acceleration", "jerk")
_UNITS = ("m", "m/s", "m/s²", "m/s³")
# m, m/s, m/s², rad/s: tolerated errors of float32; after a minute time alone is off by 0.1 ms.
_ROUNDING_TOLERANCES = np.array([5e-4, 1e-3, 0.01, 0.05])
_JOINT_OFFSET = 1e-4  # s
_STEP = 0.0101  # s between the moments at which arithmetic is compared


@dataclass(frozen=True, slots=True)
class Samples:
    """Closely spaced samples of pieces, including both ends of each."""

    time: NDArray  # (N,) s
    derivatives: NDArray  # (N, 5, 4): position and yaw, and four derivatives by time
    ends: NDArray  # (N,) bool: first or last of a piece

    def slowed(self, factor: float) -> "Samples":
        """Return the same of a flight that takes `factor` times as long."""
        return Samples(self.time * factor, self.derivatives / factor ** np.arange(5)[:, None], self.ends)


def sample_pieces(pieces: Pieces, step: float = TIME_STEP) -> Samples:
    """Return samples at most `step`, s, apart, and LEAST_POINTS of each piece at least."""
    times, derivatives, ends = [], [], []
    for k, (begin, duration) in enumerate(zip(pieces.begins, pieces.durations.astype(float), strict=True)):
        count = max(int(np.ceil(duration / step)) + 1, LEAST_POINTS)
        own = np.linspace(0.0, duration, count)
        times.append(begin + own)
        derivatives.append(derivatives_of(pieces, k, own))
        at_end = np.zeros(count, dtype=bool)
        at_end[[0, -1]] = True
        ends.append(at_end)
    return Samples(np.concatenate(times), np.concatenate(derivatives), np.concatenate(ends))


def certify_pieces(pieces: Pieces, airframe: Airframe, limits: PlanLimits, space: Space | None = None) -> Certificate:
    """Check every limit, and the space if given, everywhere along the pieces.

    Raises NotCertifiedError if two pieces do not meet, or if the commander's float32 arithmetic differs too much.
    """
    check_joints(pieces)
    check_arithmetic(pieces)
    samples = sample_pieces(pieces)
    certificate = certify_samples(samples, airframe, limits)
    if space is None:
        return certificate
    low, high = np.array(space.low)[:, None], np.array(space.high)[:, None]
    position = samples.derivatives[:, 0, :3].T
    walls = Quantity(WALLS, "m", "", "", AT_LEAST, 0, 3)
    rows = np.minimum(position - low, high - position)
    margins = [*certificate.margins, _margin(samples, rows, walls, space.margin, half_of(space))]
    if space.obstacles:
        margins.append(obstacle_margin(_path_of(pieces), space, np.asarray))
    return replace(certificate, margins=tuple(margins))


def _path_of(pieces: Pieces) -> Path:
    """Return the pieces as a path over time."""
    durations = pieces.durations.astype(float)
    table = pieces.coefficients[:, :3].astype(float).swapaxes(1, 2)
    table[-1:] = shifted(table[-1:], durations[-1:])  # of a path, the last piece is expanded about its end
    return Path(np.append(pieces.begins, pieces.duration), table)


def certify_samples(samples: Samples, airframe: Airframe, limits: PlanLimits) -> Certificate:
    """Return the certificate of samples, without walls and obstacles; NaN fails."""
    measured = measures_along(samples, airframe)
    margins = []
    for quantity in QUANTITIES:
        limit = quantity.allowed(limits)
        if limit != math.inf:
            rows = measured[quantity.which]
            margins.append(_margin(samples, rows, quantity, limit, quantity.unused(airframe)))
    return Certificate(tuple(margins), float(samples.time[-1]), len(samples.time))


def _margin(samples: Samples, rows: NDArray, quantity: Quantity, limit: float, unused: float) -> Margin:
    """Return the margin of a quantity, whose measures are `rows`, (count, N)."""
    signed = quantity.side * rows
    before, here, after = signed[:, :-2], signed[:, 1:-1], signed[:, 2:]
    bounds = np.maximum(here, np.maximum(before, after)) + _ALLOWANCE * np.maximum(2.0 * here - before - after, 0.0)
    bounds = np.where(samples.ends[1:-1], -np.inf, bounds)
    bounds = np.where(np.isnan(bounds), np.inf, bounds).max(axis=0)
    at = int(np.argmax(bounds)) + 1
    peak = float(bounds[at - 1]) if math.isfinite(bounds[at - 1]) else math.nan
    worst = float(quantity.value(quantity.side * peak))
    ratio = share_of(quantity, worst, limit, unused)
    x, y, z = samples.derivatives[at, 0, :3].tolist()
    time = float(samples.time[at])
    return Margin(
        quantity.name, quantity.unit, worst, limit, max(0.0, float(ratio)) if math.isfinite(worst) else math.nan,
        time, time, (x, y, z),
    )  # fmt: skip


def measures_along(samples: Samples, airframe: Airframe) -> NDArray:
    """Return (MEASURES, N) of the motion that flies the samples."""
    velocity, acceleration, jerk, snap = (samples.derivatives[:, order, :3] for order in range(1, 5))
    yaw, yaw_rate, yaw_acceleration = (samples.derivatives[:, order, 3] for order in range(3))
    drag, axial_drag = airframe.drag[0] / airframe.mass, airframe.drag[1] / airframe.mass

    # The thrust axis z and two derivatives, as in vehicle/flatness.py.
    force = acceleration + drag * velocity + np.array([0.0, 0.0, GRAVITY])
    force_dt, force_ddt = jerk + drag * acceleration, snap + drag * jerk
    size = np.sqrt(_dot(force, force))
    z = force / size
    size_dt = _dot(z, force_dt)
    z_dt = (force_dt - size_dt * z) / size
    size_ddt = _dot(z, force_ddt) + size * _dot(z_dt, z_dt)
    z_ddt = (force_ddt - 2.0 * size_dt * z_dt - size_ddt * z) / size

    # n = z × e with e the direction of yaw; y = n/|n|.
    zero = np.zeros_like(yaw)
    e = np.stack([np.cos(yaw), np.sin(yaw), zero], axis=1)
    across = np.stack([-e[:, 1], e[:, 0], zero], axis=1)
    e_dt = across * yaw_rate[:, None]
    e_ddt = across * yaw_acceleration[:, None] - e * yaw_rate[:, None] ** 2
    n = np.cross(z, e)
    n_dt = np.cross(z_dt, e) + np.cross(z, e_dt)
    n_ddt = np.cross(z_ddt, e) + 2.0 * np.cross(z_dt, e_dt) + np.cross(z, e_ddt)
    length = np.sqrt(_dot(n, n))
    y = n / length
    x = np.cross(y, z)

    # With R = [x y z] and R' = R ω^:  ω = (-z'·y, z'·x, -y'·x), and the same again for ω'.
    roll, pitch, turn = -_dot(z_dt, y), _dot(z_dt, x), -_dot(n_dt, x) / length
    x_dt = turn * y - pitch * z
    roll_dt = -_dot(z_ddt, y) + turn * pitch
    pitch_dt = _dot(z_ddt, x) - turn * roll
    turn_dt = -(_dot(n_ddt, x) + _dot(n_dt, x_dt)) / length + _dot(n_dt, x) * _dot(y, n_dt) / length**2
    rate = np.concatenate([roll, pitch, turn], axis=1)
    turning = np.concatenate([roll_dt, pitch_dt, turn_dt], axis=1)

    thrust = (size + (axial_drag - drag) * _dot(z, velocity))[:, 0]
    inertia = np.array(airframe.inertia)
    about_x, about_y = airframe.velocity_moment
    air = np.concatenate([about_x * _dot(y, velocity), -about_y * _dot(x, velocity), zero[:, None]], axis=1)
    torque = inertia * turning + np.cross(rate, inertia * rate) - air
    motors = motor_thrusts(airframe, airframe.mass * thrust, (torque[:, 0], torque[:, 1], torque[:, 2]))
    return measures_of(
        velocity, acceleration, rate, z, thrust, angular_acceleration=turning, motor_thrust=np.stack(motors, axis=1)
    )


def _dot(first: NDArray, second: NDArray) -> NDArray:
    return np.asarray((first * second).sum(axis=1)[:, None])


def check_joints(pieces: Pieces) -> None:
    """Check that the pieces meet, begin and end at rest. Raises NotCertifiedError with the place."""
    ends = [
        derivatives_of(pieces, k, np.array([0.0, float(duration)]), 4)[:, :, :3]
        for k, duration in enumerate(pieces.durations)
    ]
    moving = np.array([1.0, 1.0, 1.0, 0.0])  # jerk may jump at the ends
    for k in range(len(ends) + 1):
        left = ends[k - 1][1] if k else ends[0][0] * [[1], [0], [0], [0]]
        right = ends[k][0] if k < len(ends) else ends[-1][1] * [[1], [0], [0], [0]]
        jump = np.abs(left - right).max(axis=1) * (moving if k in (0, len(ends)) else 1.0)
        if not (jump <= _JOINT_TOLERANCES).all():
            order = int(np.argmax(jump / _JOINT_TOLERANCES))
            raise NotCertifiedError(
                f"{_NAMES[order]} jumps by {jump[order]:.3g} {_UNITS[order]}",
                where=f"the pieces, where piece {k + 1} begins" if k < len(ends) else "the end of the last piece",
                hint="use fewer, longer pieces",
            )  # fmt: skip


def check_arithmetic(pieces: Pieces) -> None:
    """Check that the commander's float32 arithmetic reproduces the certified motion. Raises NotCertifiedError."""
    times = np.arange(0.0, pieces.duration - _STEP, _STEP)  # at the very end float32 decides whether it has ended
    # Next to a joint float32 decides which piece is flown; check_joints() bounds their difference.
    times = times[np.abs(times[:, None] - pieces.begins[1:]).min(axis=1, initial=np.inf) > _JOINT_OFFSET]
    exact = np.concatenate(
        [
            derivatives_of(pieces, k, times[(times >= begin) & (times < begin + duration)] - begin, 4)
            for k, (begin, duration) in enumerate(zip(pieces.begins, pieces.durations.astype(float), strict=True))
        ]
    )
    goals = goals_at(pieces, times)
    rates = body_rates(exact[:, 2, :3], exact[:, 3, :3], exact[:, 0, 3], exact[:, 1, 3])
    difference = [
        goals.position - exact[:, 0, :3], goals.velocity - exact[:, 1, :3],
        goals.acceleration - exact[:, 2, :3], goals.body_rate - rates,
    ]  # fmt: skip
    ratio = (np.abs(difference) / _ROUNDING_TOLERANCES[:, None, None]).max(axis=(0, 2))
    if not (ratio <= 1.0).all():
        at = int(np.argmax(np.where(np.isfinite(ratio), ratio, np.inf)))
        raise NotCertifiedError(
            f"the vehicle's single precision is off by {ratio[at]:.3g} times what it may at {times[at]:.2f} s",
            where="the pieces", hint="use shorter pieces, or fly nearer to the origin",
        )  # fmt: skip
