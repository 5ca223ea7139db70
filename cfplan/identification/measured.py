"""Measure a vehicle from one log: thrust scale in hover, moment and inertia by the torque, drag by the accelerometer.

Quantities that a log does not show keep the airframe's value and are reported. All fits are linear least squares on
smoothed columns; nothing is fitted to the deviation from the reference.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from cfplan.errors import InputError
from cfplan.identification.flight_log import FlightLog
from cfplan.vehicle.airframe import GRAVITY, Airframe

HOVER = 1.0  # s from the first record, for the thrust scale
_PERIOD = 0.002  # s, period of the grid on which columns are smoothed
_SMOOTHING = 0.012  # s
_CLIMB_SMOOTHING = 0.030  # s, before the climb is differentiated
_LAGS = np.arange(0.025, 0.125, 0.005)  # s, of the motors
_MIN_SPEED = 0.35  # m/s in body axes, which a flight must reach to show moment and drag
_LEAST_FIT = 0.85  # fraction of the torque's variance that moment and inertia must explain
_INERTIAS, _MOMENTS = (0.5e-5, 6e-5), (0.0, 1.5e-3)  # kg m², N m per m/s: plausible for a Crazyflie
_SCALES = (0.5, 2.0)  # of thrust
_CURVATURES, _LIFTS = (-0.5, 0.5), (0.0, 0.02)  # of thrust; 1/(m/s)²
_MIN_THRUST_VARIATION = 0.008  # of its mean
_FEWEST_POSES = 50
_MAX_YAW_INERTIA = 0.999  # largest inertia about z, as a fraction of the sum of those about x and y
_ROUNDS = 4  # iterations until the scale and the curvature of thrust agree
_VOLTAGE_SMOOTHING = 0.5  # s over which the battery's voltage is averaged


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """An airframe as measured in one flight."""

    airframe: Airframe
    found: dict[str, str]  # quantity: value with unit and uncertainty
    unknown: tuple[str, ...]  # quantities that the log does not show, each with the reason
    unlike: tuple[str, ...]  # differences from the named airframe that exceed its spread
    estimate: dict[str, float]  # errors of the estimate against motion capture: rms of m, m/s and rad; empty if unknown


@dataclass(frozen=True, slots=True, eq=False)
class _Smooth:
    """The log's columns on an even grid, smoothed; rows near gaps and ends left out by `keep`."""

    keep: NDArray
    velocity: NDArray  # (K, 3) m/s, body axes: x and y by motion capture where logged
    rate: NDArray  # (K, 3) rad/s
    torque: NDArray  # (K, 3) N m, commanded, not smoothed
    thrust: NDArray  # (K,) N, commanded, not smoothed
    force: NDArray | None  # (K, 3) m/s²
    seen: bool  # whether the velocity is motion capture's: the estimated one is too high
    along: NDArray  # (K,) m/s², specific force along the thrust axis: of the accelerometer, or of the climb


def thrust_scale(log: FlightLog, airframe: Airframe, seconds: float = HOVER) -> float:
    """Return actual over commanded thrust in hover: the impulse of the first seconds against the change of climb rate.

    The airframe's lift with speed and curvature of thrust are taken out. Raises InputError if the result is not
    plausible: the mass or the vehicle is not as stated.
    """
    inside = log.time <= seconds
    time, climb = log.time[inside], log.state[inside, 5]
    asked, up = log.control[inside, 0], log.attitude.as_matrix()[inside, 2, 2]
    lifted = 1.0 + airframe.lift_with_speed * (log.body_velocity[inside, :2] ** 2).sum(axis=1)
    weight = airframe.mass * GRAVITY
    needed = airframe.mass * (GRAVITY * time[-1] + climb[-1] - climb[0])
    scale = 1.0
    for _ in range(_ROUNDS):
        curved = 1.0 + airframe.thrust_curvature * (1.0 - asked * scale / weight)
        scale = float(needed / np.trapezoid(asked * curved * lifted * up, time))
    if not _SCALES[0] < scale < _SCALES[1]:
        raise InputError(
            f"in its first {seconds:g} s it needs {scale:.2f} times the thrust that was asked for",
            where=log.name,
            hint="weigh the vehicle; the log may be another vehicle's, or not begin in hover: --from names a hover",
        )
    return scale


def scale_by_voltage(log: FlightLog, airframe: Airframe) -> NDArray:
    """Return the thrust scale at every millisecond: that of hover, less what the battery has lost since."""
    grid = np.arange(0.0, log.duration, 0.001)
    if log.voltage is None or airframe.voltage_sag == 0.0:
        return np.full(len(grid), airframe.thrust_scale)
    slow = gaussian_filter1d(log.voltage, _VOLTAGE_SMOOTHING / float(np.median(log.gaps)))
    hover = float(slow[log.time <= HOVER].mean())
    return airframe.thrust_scale * (1.0 + airframe.voltage_sag * (np.interp(grid, log.time, slow) - hover))


def measure(log: FlightLog, airframe: Airframe) -> Measured:
    """Return the airframe as measured in a log; the mass is taken as known. Raises InputError like `thrust_scale`."""
    found: dict[str, str] = {}
    unknown: list[str] = []
    columns = _smoothed(log)
    known = replace(airframe, thrust_scale=thrust_scale(log, airframe))
    for by in (_by_torque, _by_accelerometer, _by_thrust):
        known = by(columns, known, found, unknown)
    known = replace(known, thrust_scale=thrust_scale(log, known))
    found["thrust scale"] = f"{known.thrust_scale:.3f} of the commanded thrust, in the first {HOVER:g} s"
    return Measured(known, found, tuple(unknown), tuple(unlike(known, airframe)), _errors_of_estimate(log))


def unlike(found: Airframe, kind: Airframe) -> list[str]:
    """Describe values that differ from an airframe by more than its spread: it may be another vehicle's flight."""
    pairs = [
        ("thrust scale", found.thrust_scale, kind.thrust_scale, kind.spread.thrust_scale),
        ("drag over mass", found.drag[0] / found.mass, kind.drag[0] / kind.mass, kind.spread.drag),
        ("roll moment", found.velocity_moment[0], kind.velocity_moment[0], kind.spread.velocity_moment),
        ("pitch moment", found.velocity_moment[1], kind.velocity_moment[1], kind.spread.velocity_moment),
        ("motor lag", found.motor_time_constant, kind.motor_time_constant, kind.spread.motor_time_constant),
    ]
    return [
        f"{name} {value:.3g}, outside {usual:.3g} ± {spread:.0%} of {kind.name}"
        for name, value, usual, spread in pairs
        if abs(value - usual) > spread * usual
    ]


def pooled(flights: Sequence[Measured], airframe: Airframe) -> Airframe:
    """Return the airframe with the medians over the flights; quantities that no flight shows keep their value."""

    def median(key: str, value: Callable[[Airframe], float]) -> float:
        values = [value(each.airframe) for each in flights if key in each.found]
        return float(np.median(values)) if values else value(airframe)

    moment = (median("roll moment", lambda each: each.velocity_moment[0]),
              median("pitch moment", lambda each: each.velocity_moment[1]))  # fmt: skip
    inertia = (
        median("roll inertia", lambda each: each.inertia[0]),
        median("pitch inertia", lambda each: each.inertia[1]),
    )
    drag = airframe.mass * median("drag", lambda each: each.drag[0] / each.mass)
    return replace(
        airframe,
        velocity_moment=moment,
        inertia=(*inertia, min(airframe.inertia[2], _MAX_YAW_INERTIA * sum(inertia))),
        drag=(drag, airframe.drag[1]),
        motor_time_constant=median("motor lag", lambda each: each.motor_time_constant),
        lift_with_speed=median("lift with speed", lambda each: each.lift_with_speed),
        thrust_curvature=median("thrust curvature", lambda each: each.thrust_curvature),
        thrust_scale=median("thrust scale", lambda each: each.thrust_scale),
    )


def _smoothed(log: FlightLog) -> _Smooth:
    grid = np.arange(0.0, log.duration, _PERIOD)

    def on_grid(values: NDArray) -> NDArray:
        return np.column_stack([np.interp(grid, log.time, column) for column in values.reshape(len(log.time), -1).T])

    def smooth(values: NDArray) -> NDArray:
        return np.asarray(gaussian_filter1d(on_grid(values), _SMOOTHING / _PERIOD, axis=0))

    keep = (grid > 0.2) & (grid < log.duration - 0.2) & log.away_from_gaps(grid)
    velocity = smooth(log.body_velocity)
    if _has_poses(log):
        velocity[:, :2] = _seen_velocity(log, grid)
    force = None if log.acceleration is None else smooth(log.acceleration)
    up = smooth(log.attitude.as_matrix()[:, 2, 2])[:, 0]
    climb = gaussian_filter1d(on_grid(log.state[:, 5])[:, 0], _CLIMB_SMOOTHING / _PERIOD)
    return _Smooth(
        keep, velocity, smooth(log.state[:, 10:13]), on_grid(log.control[:, 1:]),
        on_grid(log.control[:, 0])[:, 0], force, _has_poses(log),
        (np.gradient(climb, _PERIOD) + GRAVITY) / up if force is None else force[:, 2],
    )  # fmt: skip


def _has_poses(log: FlightLog) -> bool:
    return len(log.pose_time) >= _FEWEST_POSES


def _seen_velocity(log: FlightLog, grid: NDArray) -> NDArray:
    """Return motion capture's velocity in the rotor plane, (K, 2): the estimated one is several percent too high."""
    place = np.column_stack([np.interp(grid, log.pose_time, column) for column in log.poses[:, :3].T])
    seen = np.gradient(gaussian_filter1d(place, _CLIMB_SMOOTHING / _PERIOD, axis=0), _PERIOD, axis=0)
    at = np.searchsorted(log.time, grid).clip(0, len(log.time) - 1)
    return np.asarray(log.attitude[at].inv().apply(seen))[:, :2]


def _lagged(values: NDArray, lag: float) -> NDArray:
    """Return the response of motors with a lag, s, to a command, smoothed like the other columns."""
    decay = np.exp(-_PERIOD / lag)
    followed = lfilter([1.0 - decay], [1.0, -decay], values, axis=0, zi=decay * values[:1])[0]
    return np.asarray(gaussian_filter1d(followed, _SMOOTHING / _PERIOD, axis=0))


def _by_torque(columns: _Smooth, known: Airframe, found: dict[str, str], unknown: list[str]) -> Airframe:
    """Return the airframe with moment, inertia and lag: J dω/dt + ω × J ω = torque - the moment that must be held."""
    if not np.isfinite(columns.torque).all():
        unknown.append("moment, inertia and motor lag: the log has no torques")
        return known
    turning = np.gradient(columns.rate, _PERIOD, axis=0)
    moment, inertia = list(known.velocity_moment), list(known.inertia)
    fits = {lag: [_torque_fit(columns, turning, known, axis, float(lag)) for axis in (0, 1)] for lag in _LAGS}
    moved = [float(np.abs(columns.velocity[columns.keep, 1 - axis]).max()) for axis in (0, 1)]
    axes = [axis for axis in (0, 1) if moved[axis] > _MIN_SPEED]
    if not axes:
        unknown.append(f"moment, inertia and motor lag: the flight is slower than {_MIN_SPEED:g} m/s")
        return known
    lag = float(max(fits, key=lambda each: sum(fits[each][axis][2] for axis in axes)))
    for axis, name in enumerate(("roll", "pitch")):
        slope, held, fit, deviation = fits[lag][axis]
        if axis in axes and fit > _LEAST_FIT and _within(slope, _INERTIAS) and _within(held, _MOMENTS):
            moment[axis], inertia[axis] = held, slope
            text = f"{1e4 * held:.2f} ± {1e4 * deviation:.2f} e-4 N m per m/s ({fit:.0%} explained)"
            found[f"{name} moment"] = text if columns.seen else f"{text}, low by a tenth or two: without motion capture"
            found[f"{name} inertia"] = f"{1e5 * slope:.2f} e-5 kg m²"
        else:
            unknown.append(f"{name} moment: {'flown too slowly' if axis not in axes else 'the torque is another'}")
    found["motor lag"] = f"{1e3 * lag:.0f} ms"
    yaw = min(inertia[2], _MAX_YAW_INERTIA * (inertia[0] + inertia[1]))
    return replace(
        known, velocity_moment=(moment[0], moment[1]), inertia=(inertia[0], inertia[1], yaw), motor_time_constant=lag
    )


def _torque_fit(
    columns: _Smooth, turning: NDArray, known: Airframe, axis: int, lag: float
) -> tuple[float, float, float, float]:
    """Return inertia, moment, the fraction of the torque's variance that they explain, and the moment's deviation."""
    other, keep = 1 - axis, columns.keep
    jx, jy, jz = known.inertia
    rate = columns.rate
    gyroscopic = (jz - jy) * rate[:, 1] * rate[:, 2] if axis == 0 else (jx - jz) * rate[:, 0] * rate[:, 2]
    torque = (_lagged(columns.torque[:, axis], lag) - gyroscopic)[keep]
    sign = -1.0 if axis == 0 else 1.0  # held against the moment
    design = np.column_stack([turning[:, axis], sign * columns.velocity[:, other], np.ones(len(rate))])[keep]
    solved = np.linalg.lstsq(design, torque, rcond=None)[0]
    left = torque - design @ solved
    correlated = _SMOOTHING * 4 / _PERIOD  # rows that share their noise
    covariance = np.linalg.pinv(design.T @ design) * left.var() * correlated
    return float(solved[0]), float(solved[1]), float(1.0 - left.var() / torque.var()), float(covariance[1, 1] ** 0.5)


def _by_accelerometer(columns: _Smooth, known: Airframe, found: dict[str, str], unknown: list[str]) -> Airframe:
    """Return the airframe with the drag that the accelerometer shows."""
    if columns.force is None:
        unknown.append("drag: the log has no accelerometer (acc.x to acc.z), and the estimate knows no drag")
        return known
    slopes = []
    for axis in (0, 1):
        speed = columns.velocity[columns.keep, axis]
        if np.abs(speed).max() > _MIN_SPEED:
            design = np.column_stack([-speed, np.ones(len(speed))])
            slopes.append(float(np.linalg.lstsq(design, columns.force[columns.keep, axis], rcond=None)[0][0]))
    if not slopes:
        unknown.append(f"drag: the flight is slower than {_MIN_SPEED:g} m/s")
        return known
    drag = float(np.mean(slopes))
    found["drag"] = f"{drag:.2f} 1/s of the mass"
    return replace(known, drag=(known.mass * drag, known.drag[1]))


def _by_thrust(columns: _Smooth, known: Airframe, found: dict[str, str], unknown: list[str]) -> Airframe:
    """Return the airframe with lift with speed and curvature of thrust, from actual against commanded thrust."""
    keep = columns.keep
    thrust = _lagged(columns.thrust, known.motor_time_constant)[keep]
    given = known.mass * columns.along[keep] + known.drag[1] * columns.velocity[keep, 2]
    squared = (columns.velocity[keep, :2] ** 2).sum(axis=1)
    if np.std(thrust) < _MIN_THRUST_VARIATION * thrust.mean():
        unknown.append("lift with speed, curvature of thrust: the thrust hardly changes")
        return known
    design = np.column_stack([np.ones(len(thrust)), thrust / thrust.mean() - 1.0, squared])
    level, slope, lift = np.linalg.lstsq(design, given / given.mean(), rcond=None)[0]
    curvature, lift = float(np.clip(1.0 - slope / level, *_CURVATURES)), float(np.clip(lift / level, *_LIFTS))
    found["lift with speed"], found["thrust curvature"] = f"{100 * lift:.2f} % per (m/s)²", f"{curvature:.2f}"
    return replace(known, lift_with_speed=lift, thrust_curvature=curvature)


def _errors_of_estimate(log: FlightLog) -> dict[str, float]:
    """Return rms errors of the estimated position, m, velocity, m/s, and tilt, rad, against motion capture."""
    if not _has_poses(log):
        return {}
    place, time = log.poses[:, :3], log.pose_time
    at = np.column_stack([np.interp(time, log.time, column) for column in log.state[:, :6].T])
    width = 0.03 / float(np.median(np.diff(time)))
    seen = np.gradient(gaussian_filter1d(place, width, axis=0), time, axis=0)
    even = np.convolve(np.gradient(time) > 2 * np.median(np.diff(time)), np.ones(21), mode="same") == 0
    even[:10] = even[-10:] = False
    if even.sum() < _FEWEST_POSES:
        return {}
    errors = {
        "position": _rms((at[:, :3] - place)[even]),
        "velocity": _rms((gaussian_filter1d(at[:, 3:6], width, axis=0) - seen)[even]),
    }
    with_attitude = np.linalg.norm(log.poses[:, 3:], axis=1) > 0.5
    if with_attitude.all():
        up = log.attitude.as_matrix()[np.searchsorted(log.time, time).clip(0, len(log.time) - 1)][:, :, 2]
        x, y, z, w = log.poses[:, 3:].T
        theirs = np.column_stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
        apart = up - theirs
        errors["tilt"] = _rms(apart - apart.mean(axis=0))
    return errors


def _rms(errors: NDArray) -> float:
    return float(np.sqrt(np.mean((errors**2).sum(axis=1))))


def _within(value: float, bounds: tuple[float, float]) -> bool:
    return bounds[0] < value < bounds[1]
