"""The plots of a flight: lines over time, and their limits."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.telemetry import Phase
from cfplan.recording.record import Record, meant_motion
from cfplan.recording.summary import deviation, reference_span, reference_times
from cfplan.vehicle.motor_commands import command_shares

FAR_LIMIT = 2.0  # measured spans beyond the values, above which a limit is not drawn

Colour = tuple[int, int, int]
FLOWN: Colour = (86, 180, 233)
WANTED: Colour = (230, 159, 0)
LIMIT: Colour = (226, 74, 74)
FOUR: tuple[Colour, ...] = ((86, 180, 233), (0, 158, 115), (240, 228, 66), (204, 121, 167))
# The titles of all plots, in the order in which they are shown.
TITLES = {
    "deviation": "Deviation, m",
    "motor_thrust": "Motor thrust, N",
    "speed": "Speed, m/s",
    "body_rate": "Body rate, rad/s",
    "acceleration": "Acceleration, m/s²",
    "battery": "Battery, V",
    "age": "Age of poses and of the vehicle's log, ms",
    "lateness": "Lateness of setpoints, ms",
}


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """One curve, or several that share their times."""

    name: str
    time: NDArray  # (N,) s, on the record's clock
    values: NDArray  # (N,) or (N, K)
    labels: tuple[str, ...]  # K of them
    colours: tuple[Colour, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Plot:
    """One set of axes."""

    name: str  # one of TITLES
    lines: tuple[Line, ...]
    limits: tuple[float, ...]  # drawn as level lines; those that are not finite are left out

    @property
    def title(self) -> str:
        """Return the plotted quantity, with its unit."""
        return TITLES[self.name]


def plots(record: Record) -> tuple[Plot, ...]:
    """Return all plots of a flight, in the order of TITLES."""
    setpoints, estimates, status = record.setpoints, record.estimates, record.status
    bounds, planned, motors = record.header.bounds, record.header.plan_limits, motor_thrust(record)
    _, meant_acceleration, meant_rate = meant_motion(setpoints)
    wanted = reference_times(setpoints)
    off = deviation(record, *_along_the_path(record))
    aged, age = pose_age(record)
    return (
        Plot(
            "deviation",
            (
                _flown("in_time", off.time, off.in_time, "in time"),
                Line("to_path", off.time, off.to_path, ("from the path",), ((150, 150, 150),)),
            ),
            (bounds.deviation,),
        ),
        Plot(
            "motor_thrust",
            (Line("motors", status.time, motors, ("motor 1", "motor 2", "motor 3", "motor 4"), FOUR),),
            (planned.motor_thrust_min, planned.motor_thrust_max),
        ),
        _norms("speed", estimates.time, estimates.velocity, wanted, setpoints.velocity, bounds.speed),
        _norms("body_rate", status.time, status.body_rate, wanted, meant_rate, bounds.body_rate),
        _norms(
            "acceleration",
            estimates.time,
            estimates.acceleration,
            wanted,
            meant_acceleration,
            bounds.acceleration,
        ),
        Plot(
            "battery",
            (_flown("voltage", status.time, status.battery_voltage, "voltage"),),
            (bounds.battery_voltage,),
        ),
        Plot(
            "age",
            (
                _flown("pose", aged, age * 1e3, "pose"),
                Line("log", status.time[1:], 1e3 * np.diff(status.time), ("log by radio",), ((150, 150, 150),)),
            ),
            (bounds.pose_age * 1e3,),
        ),
        Plot(
            "lateness",
            (_flown("lateness", setpoints.due, (setpoints.time - setpoints.due) * 1e3, "lateness"),),
            (bounds.lateness * 1e3,),
        ),
    )


def _along_the_path(record: Record) -> tuple[float, float]:
    """Return begin and end, s, of the path with the hover at its end; infinite if it was never flown."""
    begin, end = reference_span(record)
    if math.isnan(begin):
        return -math.inf, math.inf
    held = record.phase_span(Phase.HOLD)
    return begin, held[1] if held is not None else end


def motor_thrust(record: Record) -> NDArray:
    """Return the commanded thrusts, (N, 4) N, from the motors' PWM in the status messages."""
    status, header = record.status, record.header
    return command_shares(status.motor, status.battery_voltage, header.vehicle) * header.thrust_at_full_command


def pose_age(record: Record) -> tuple[NDArray, NDArray]:
    """Return the arrival of each pose but the first, (N-1,), and the age of the previous pose then, (N-1,), both s."""
    return record.poses.received[1:], record.poses.received[1:] - record.poses.time[:-1]


def finite_limits(plot: Plot) -> tuple[float, ...]:
    """Return the limits that can be drawn."""
    return tuple(limit for limit in plot.limits if math.isfinite(limit))


def near_limits(limits: Sequence[float], values: Sequence[NDArray]) -> tuple[float, ...]:
    """Return the limits that are near enough to draw: at most FAR_LIMIT spans of the values beyond them."""
    known = np.concatenate([np.empty(0), *(array[np.isfinite(array)] for array in values)])
    if len(known) == 0:
        return tuple(limits)
    low, high = min(float(known.min()), 0.0), max(float(known.max()), 0.0)
    reach = FAR_LIMIT * (high - low)
    return tuple(limit for limit in limits if low - reach <= limit <= high + reach)


def _flown(name: str, time: NDArray, values: NDArray, label: str = "flown") -> Line:
    return Line(name, time, values, (label,), (FLOWN,))


def _norms(name: str, time: NDArray, flown: NDArray, due: NDArray, wanted: NDArray, limit: float) -> Plot:
    """Return the plot of a vector's norm, as flown and as planned."""
    reference = Line("wanted", due, np.linalg.norm(wanted, axis=1), ("reference",), (WANTED,))
    return Plot(name, (_flown("flown", time, np.linalg.norm(flown, axis=1)), reference), (limit,))
