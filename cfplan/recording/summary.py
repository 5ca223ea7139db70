"""Summarise a record in numbers: travel time, deviation, peaks, lateness, dropouts, battery.

The reference is the position of each setpoint at its reference time, straight between them: LEAD after its deadline,
as setpoints are sent ahead of the plan. A pose is compared with the reference at the pose's own time (deviation in
time) and with the nearest point of the path.
"""

import math
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.setpoints.encoding import LEAD
from cfplan.flight.telemetry import Phase
from cfplan.numbers import shown
from cfplan.recording.commitments import committed_path, committed_time
from cfplan.recording.path_distance import distance_to_path
from cfplan.recording.record import Record, Setpoints
from cfplan.safety.limits import PlanLimits

UNKNOWN = "–"
SETTLED = 0.03  # m from the end of the path: close enough to call the flight settled
SPEED_SPAN = 0.06  # s, span over which speed is computed from poses: 1 mm of noise is 0.02 m/s
_HOVER_SPAN = 0.1  # s before a plan's end, in which packets may show the hover that ends a stream on board
DROPOUT = 3.0  # usual intervals between poses: a longer gap is a dropout


@dataclass(frozen=True, slots=True)
class FlightSummary:
    """The numbers of one flight; NaN where the record does not hold one."""

    travel_time_planned: float  # s
    travel_time_flown: float
    """s, planned, plus the delay behind the setpoints until the vehicle stays within SETTLED of the path's end; NaN if
    the path was not finished."""
    settling: float  # s, from the end of the reference until the vehicle stays within SETTLED of the path's end
    max_deviation: float  # m, from the reference in time
    rms_deviation: float  # m
    max_deviation_to_path: float  # m, from the nearest point of the path
    rms_deviation_to_path: float  # m
    estimated_speed: float  # fraction by which the vehicle's estimate is faster than the poses, along the path
    peak_speed: float  # m/s, by the vehicle's estimate, along the path
    peak_acceleration: float  # m/s², gravity not counted, by the vehicle's estimate, along the path
    peak_body_rate: float  # rad/s, norm, along the path
    lateness_p50: float  # s, of all setpoints sent
    lateness_p99: float  # s
    lateness_max: float  # s
    pose_dropouts: int
    longest_pose_gap: float  # s
    battery_start: float  # V
    battery_end: float  # V
    duration: float  # s, of the whole record
    truncated: bool

    def to_json(self) -> dict[str, float | int | bool | None]:
        """Return it for summary.json: what is not known is null."""
        values = asdict(self)
        return {key: None if isinstance(value, float) and math.isnan(value) else value for key, value in values.items()}


class PoseDeviations(NamedTuple):
    """The deviation of the vehicle, at each pose."""

    time: NDArray  # (N,) s, of the poses
    in_time: NDArray  # (N,) m, from the reference at that time
    to_path: NDArray  # (N,) m, from the nearest point of the path


def summarise(record: Record) -> FlightSummary:
    """Return all numbers of one flight."""
    begin, end = reference_span(record)
    along = deviation(record, begin, end)
    arrived, sent = arrival(record)
    late = _finite(record.setpoints.time - record.setpoints.due)
    gaps = pose_gaps(record.poses.time)
    volts = _finite(record.status.battery_voltage)
    return FlightSummary(
        travel_time_planned=committed_time(record),
        travel_time_flown=end - begin + arrived - sent,
        settling=max(arrived - end, 0.0),
        max_deviation=_worst(along.in_time),
        rms_deviation=_rms(along.in_time),
        max_deviation_to_path=_worst(along.to_path),
        rms_deviation_to_path=_rms(along.to_path),
        estimated_speed=estimated_speed(record, begin, end),
        peak_speed=_peak(record.estimates.time, record.estimates.velocity, begin, end),
        peak_acceleration=_peak(record.estimates.time, record.estimates.acceleration, begin, end),
        peak_body_rate=_peak(record.status.time, record.status.body_rate, begin, end),
        lateness_p50=_percentile(late, 50),
        lateness_p99=_percentile(late, 99),
        lateness_max=_worst(late),
        pose_dropouts=len(dropouts(gaps)),
        longest_pose_gap=_worst(gaps),
        battery_start=float(volts[0]) if len(volts) else math.nan,
        battery_end=float(volts[-1]) if len(volts) else math.nan,
        duration=record.duration,
        truncated=record.truncated,
    )


def reference_span(record: Record) -> tuple[float, float]:
    """Return begin and end of the reference, s: the first deadline of the phase `stream`, and the end of the plan.

    If the plan was not sent to its end, its end is LEAD after the last deadline, the time for which that setpoint was
    made. Anything streamed later is the hover after the path. NaN if nothing was streamed.
    """
    due = _streamed(record)
    if len(due) == 0:
        return math.nan, math.nan
    begin = float(due[0])
    return begin, min(begin + committed_time(record), float(due[-1]) + LEAD)


def _streamed(record: Record) -> NDArray:
    """Return the deadlines of the phase `stream`; where plans were made in flight, of the hovers between them too."""
    span = record.phase_span(Phase.STREAM)
    if span is None:
        return np.empty(0)
    if len(record.commitments.time):
        phases = record.phases
        after = phases.time[(phases.time > span[0]) & ~np.isin(phases.phase, (Phase.STREAM, Phase.HOLD))]
        span = span[0], float(after[0]) if len(after) else record.start + record.duration
    return record.setpoints.due[(record.setpoints.time >= span[0]) & (record.setpoints.due <= span[1])]


def reference_times(setpoints: Setpoints) -> NDArray:
    """Return the planned time of each setpoint, (N,) s: LEAD after the deadline that it was made for."""
    return _deadlines(setpoints) + LEAD


def _deadlines(setpoints: Setpoints) -> NDArray:
    """Return (N,) s, the deadline that each setpoint was made for: a later one than its own where it was sent late."""
    if len(setpoints.due) < 2:
        return setpoints.due
    period = np.median(np.diff(setpoints.due))
    return setpoints.due + np.round((setpoints.time - setpoints.due) / period) * period


def planned_positions(record: Record) -> NDArray:
    """Return the planned position at each setpoint, (N, 3) m: as sent, less the correction."""
    sent, shift, due = record.setpoints, record.header.shift, _streamed(record)
    if not (len(shift) and len(due) > 1):
        return sent.position
    row = np.round((_deadlines(sent) - due[0]) / np.median(np.diff(due)))
    return np.asarray(sent.position - shift[np.clip(row, 0, len(shift) - 1).astype(int)])


def deviation(record: Record, begin: float = -math.inf, end: float = math.inf) -> PoseDeviations:
    """Return the deviation of every pose between begin and end that falls in the time of the setpoints."""
    wanted = reference_times(record.setpoints)
    if len(wanted) == 0:
        return PoseDeviations(np.empty(0), np.empty(0), np.empty(0))
    time, position = record.poses.time, record.poses.position
    inside = (time >= max(begin, wanted[0])) & (time <= min(end, wanted[-1])) & np.all(np.isfinite(position), axis=1)
    time, position = time[inside], position[inside]
    reference = np.stack([np.interp(time, wanted, axis) for axis in planned_positions(record).T], axis=1)
    path = committed_path(record)
    path = path[np.all(np.isfinite(path), axis=1)]
    path = path if len(path) else record.setpoints.position
    return PoseDeviations(time, np.linalg.norm(position - reference, axis=1), distance_to_path(position, path))


def estimated_speed(record: Record, begin: float, end: float) -> float:
    """Return the fraction by which the vehicle's estimate is faster than the poses between begin and end.

    A vehicle whose estimate is too slow flies ahead of its setpoints. NaN if nothing moves or is known.
    """
    estimates, time = record.estimates, record.poses.time
    seen = np.isfinite(time) & np.all(np.isfinite(record.poses.position), axis=1)
    inside = (estimates.time >= begin) & (estimates.time <= end) & np.all(np.isfinite(estimates.velocity), axis=1)
    if not (seen.any() and inside.any()):
        return math.nan
    before, after = estimates.time[inside] - SPEED_SPAN / 2, estimates.time[inside] + SPEED_SPAN / 2
    axes = record.poses.position[seen].T
    moved = [np.interp(after, time[seen], axis) - np.interp(before, time[seen], axis) for axis in axes]
    velocity = np.stack(moved, axis=1) / SPEED_SPAN
    square = float(np.sum(velocity**2))
    return float(np.sum(estimates.velocity[inside] * velocity)) / square - 1.0 if square > 0.0 else math.nan


def settling(record: Record) -> float:
    """Return s after the end of the reference until the vehicle, held at the path's end, stays within SETTLED of it.

    NaN if the path was not finished, there is no pose, or the vehicle was still outside at the end.
    """
    return max(arrival(record)[0] - reference_span(record)[1], 0.0)


def arrival(record: Record) -> tuple[float, float]:
    """Return the times, s, from which on the vehicle, and its setpoints, stay within SETTLED of the path's end.

    NaN if the path was not finished, there is no pose, or the vehicle was still outside at the end.
    """
    begin, end = reference_span(record)
    held = record.phase_span(Phase.HOLD)
    if held is not None and len(record.commitments.time):
        held = held[0], float(_streamed(record)[-1])
    if not finished(record) or held is None:
        return math.nan, math.nan
    due = _streamed(record)
    sent = (record.setpoints.due >= begin) & (record.setpoints.due <= due[-1])
    planned = planned_positions(record)
    goal = planned[np.searchsorted(record.setpoints.due, due[-1])]
    seen = (record.poses.time >= begin) & (record.poses.time <= max(held[1], end))
    vehicle = _from_then_near(record.poses.time[seen], record.poses.position[seen], goal)
    return vehicle, _from_then_near(reference_times(record.setpoints)[sent], planned[sent], goal)


def _from_then_near(time: NDArray, position: NDArray, goal: NDArray) -> float:
    """Return the time, s, after which positions, linearly interpolated, stay within SETTLED of the goal; else NaN."""
    off = np.linalg.norm(position - goal, axis=1)
    outside = np.flatnonzero(~(off <= SETTLED))
    if len(time) == 0 or (len(outside) and outside[-1] == len(time) - 1):
        return math.nan
    if not len(outside):
        return float(time[0])
    last = outside[-1]
    fraction = (off[last] - SETTLED) / (off[last] - off[last + 1]) if math.isfinite(off[last]) else 1.0
    return float(time[last] + fraction * (time[last + 1] - time[last]))


def finished(record: Record) -> bool:
    """Return whether the whole plan was sent; a stop on the way is encoded apart and counts its own indices."""
    due = _streamed(record)
    if len(due) < 2:
        return False
    period = float(np.median(np.diff(due)))
    last = int(record.setpoints.index[np.searchsorted(record.setpoints.due, due[-1])])
    least = committed_time(record) - _HOVER_SPAN
    return bool(due[-1] - due[0] >= least and last * period >= least)


def pose_gaps(times: NDArray) -> NDArray:
    """Return s between poses, from their stamps."""
    return np.diff(_finite(times))


def dropouts(gaps: NDArray) -> NDArray:
    """Return the indices of the gaps that are longer than DROPOUT usual ones."""
    return np.flatnonzero(gaps > DROPOUT * np.median(gaps)) if len(gaps) else np.empty(0, dtype=int)


PLAN_LIMITS = {"peak_speed": "speed", "peak_acceleration": "acceleration", "peak_body_rate": "angular_velocity"}
"""The limit of planned motion that each peak is compared with."""


def shares(summary: FlightSummary, limits: PlanLimits) -> dict[str, float]:
    """Return the usage of the plan's limit by each peak; NaN if the record holds no peak or no limit."""
    allowed = {peak: getattr(limits, limit) for peak, limit in PLAN_LIMITS.items()}
    return {peak: getattr(summary, peak) / most if most > 0.0 else math.nan for peak, most in allowed.items()}


def summary_rows(summary: FlightSummary, limits: PlanLimits) -> list[tuple[str, str]]:
    """Return name and text of each number; peaks with their usage of the plan's limit."""
    of_limits = shares(summary, limits)

    def peak(name: str, unit: str) -> str:
        share = of_limits[name]
        of_limit = f" ({100 * share:.0f} % of the plan's limit)" if math.isfinite(share) else ""
        return _text(getattr(summary, name), unit, 2) + of_limit

    return [
        ("travel time, planned", _text(summary.travel_time_planned, "s", 2)),
        ("travel time, flown", _text(summary.travel_time_flown, "s", 2)),
        ("settled after", _text(summary.settling, "s", 2)),
        ("deviation in time, max", _text(100 * summary.max_deviation, "cm", 1)),
        ("deviation in time, rms", _text(100 * summary.rms_deviation, "cm", 1)),
        ("deviation from the path, max", _text(100 * summary.max_deviation_to_path, "cm", 1)),
        ("deviation from the path, rms", _text(100 * summary.rms_deviation_to_path, "cm", 1)),
        ("speed by the estimate, over that by poses", _text(100 * summary.estimated_speed, "%", 1)),
        ("peak speed", peak("peak_speed", "m/s")),
        ("peak acceleration", peak("peak_acceleration", "m/s²")),
        ("peak body rate", peak("peak_body_rate", "rad/s")),
        ("lateness of setpoints, p99", _text(1e3 * summary.lateness_p99, "ms", 2)),
        ("lateness of setpoints, worst", _text(1e3 * summary.lateness_max, "ms", 2)),
        ("pose dropouts", str(summary.pose_dropouts)),
        ("longest pose gap", _text(1e3 * summary.longest_pose_gap, "ms", 0)),
        ("battery", f"{_text(summary.battery_start, 'V', 2)} → {_text(summary.battery_end, 'V', 2)}"),
    ]


def summary_text(record: Record) -> str:
    """Return a heading, a table of the numbers, and what flew, in Markdown; a dash for what is not known."""
    header = record.header
    cut = ["**The record ends early: data after its last complete chunk is lost.**", ""] if record.truncated else []
    lines = [
        f"## {header.name}",
        "",
        *cut,
        f"{begun(record)} · {header.vehicle.name} · {header.uri} · {header.planner}",
        "",
        "| | |",
        "|---|---|",
        *(f"| {name} | {value} |" for name, value in summary_rows(summarise(record), header.plan_limits)),
    ]
    return "\n".join(lines)


def begun(record: Record) -> str:
    """Return the date and time of the record's start; a dash where it is not known."""
    try:
        return f"{datetime.fromtimestamp(record.header.wall_time_at_zero + record.start, UTC):%Y-%m-%d %H:%M:%S} UTC"
    except (ValueError, OverflowError, OSError):
        return UNKNOWN


def _text(value: float, unit: str, digits: int) -> str:
    """Return the number with its unit; a dash where it is not known."""
    return f"{shown(value, f'.{digits}f')} {unit}" if math.isfinite(value) else UNKNOWN


def _peak(time: NDArray, vectors: NDArray, begin: float, end: float) -> float:
    return _worst(_finite(np.linalg.norm(vectors[(time >= begin) & (time <= end)], axis=1)))


def _finite(values: NDArray) -> NDArray:
    return values[np.isfinite(values)]


def _worst(values: NDArray) -> float:
    return float(np.max(values)) if len(values) else math.nan


def _rms(values: NDArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else math.nan


def _percentile(values: NDArray, fraction: float) -> float:
    return float(np.percentile(values, fraction)) if len(values) else math.nan
