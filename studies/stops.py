"""Stop from full speed, straight on, within several durations: demands on the vehicle, and reasons for refusal.

The vehicle flies along the longest side of the room, and stops where its speed is constant. The study tries every
duration that a request to stop tries, and shorter ones. For comparison, it measures how the fastest plan along that
side brakes, which keeps every limit of plans.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cfplan.air.stopping import STOPS, stop_within
from cfplan.air.timeline import Timeline, hold
from cfplan.errors import CfplanError
from cfplan.flight.setpoints.encoding import LEAD, RATE, encode_trajectory
from cfplan.flight.setpoints.packets import decode
from cfplan.flight.setpoints.rate_trade import gains_under
from cfplan.flight.setpoints.stop_certificate import certify_stops
from cfplan.flight.setpoints.stops import encode_stops, stop_motion
from cfplan.geometry.min_snap import centripetal_times, min_snap
from cfplan.planning.plan import plan
from cfplan.safety.limits import Limits
from cfplan.simulation.dry_run import fly_on
from cfplan.simulation.link_loss import as_believed
from studies.runner.limits import limits_for
from studies.runner.options import option
from studies.runner.result import Column, Table, table
from studies.runner.study import Run, Study, Work

SHORTER = (0.36, 0.4, 0.42, 0.43, 0.44)  # s, in addition to those that a request tries
LONGEST = 0.6  # s
PLAN = "the fastest plan"
_FROM_WALLS = 0.5  # m from the margin
_FINE = 300  # grid intervals, enough to brake as late as possible
_FULL = 0.99  # fraction of the highest speed below which a plan brakes
_NEXT = np.array([1])  # row of a motion: its next setpoint


@dataclass(frozen=True, slots=True)
class Settings:
    """The stops to try."""

    durations: tuple[float, ...] = option(
        tuple(sorted({*SHORTER, *(each for each in STOPS if each <= LONGEST)})), "Duration of a stop, s.", least=0.1
    )


@dataclass(frozen=True, slots=True)
class Braking:
    """One way to come to rest from full speed."""

    what: str  # a stop, or the plan
    speed: float  # m/s, at its beginning
    duration: float  # s
    distance: float  # m, of the setpoints
    flown: float  # m, farthest distance of the vehicle from where the setpoints begin to brake; NaN if refused
    acceleration: float  # m/s²
    tilt: float  # °
    turning: float  # rad/s²
    refused: str = ""  # why


_DURATION = Column("duration", "within", "s", ".2f")
_DISTANCE = Column("distance", "way to rest", "m", ".2f", meaning="of the setpoints, from full speed")
_FLOWN = Column("flown", "as flown", "m", ".2f",
                meaning="the farthest that the vehicle comes from where they begin to brake")  # fmt: skip
_HARDNESS = (
    Column("acceleration", "acceleration", "m/s²", ".1f"),
    Column("tilt", "tilt", "°", ".1f"),
    Column("turning", "angular acceleration", "rad/s²", ".0f", meaning="that the setpoints ask for"),
)
COLUMNS = (_DURATION, _DISTANCE, _FLOWN, *_HARDNESS, Column("refused", "refused, as"))
PLAN_COLUMNS = (Column("speed", "from", "m/s", ".2f"), _DISTANCE, _FLOWN, _DURATION, *_HARDNESS)


def work(settings: Settings, run: Run) -> Work:
    """Return one case per stop, and one for the fastest plan. Raises a CfplanError if no flight can be planned."""
    limits = limits_for(Path())
    cases: dict[str, float | None] = {PLAN: None} | {f"{each:g} s": each for each in settings.durations}
    return Work(cases, partial(measure, timeline=_straight_flight(limits), limits=limits), Braking)


def measure(duration: float | None, timeline: Timeline, limits: Limits) -> Braking:
    """Stop a flight from full speed within a duration, s; None: brake as the fastest plan does."""
    return _plan(limits) if duration is None else _stop(timeline, duration, limits)


def _stop(timeline: Timeline, duration: float, limits: Limits) -> Braking:
    number, gains, space = _at_full_speed(timeline), gains_under(limits), limits.space
    motion = encode_trajectory(timeline.motion.since(number / RATE), gains=gains, space=space).motion
    payloads = encode_stops(motion, RATE, duration, _NEXT, gains, space)
    reached = certify_stops(payloads, motion, limits, RATE, rows=_NEXT, gains=gains, space=space).worst
    made, _ = stop_motion(motion, _NEXT, RATE, duration)
    refused, flown = "", math.nan
    try:
        stop = stop_within(timeline, number, duration, limits)
        flown = _flown(stop.proposal.payloads, 1, timeline, number, limits)
    except CfplanError as error:
        refused = error.what
    return Braking(
        "a stop",
        speed=float(np.linalg.norm(motion.velocity[0])),
        duration=duration,
        distance=_way(made.position),
        flown=flown,
        acceleration=reached["acceleration"],
        tilt=float(np.degrees(reached["tilt"])),
        turning=float(np.linalg.norm(np.diff(made.body_rate, axis=0), axis=1).max() * RATE),
        refused=refused,
    )


def _plan(limits: Limits) -> Braking:
    """Return the braking of the fastest plan along that side, from where it last has nearly its highest speed.

    Waypoints a metre apart give a path that does not limit the speed until shortly before its end.
    """
    first, last = _ends(limits)
    path = min_snap(np.linspace(first, last, 1 + round(float(np.linalg.norm(last - first)))))
    planned = plan(path, limits.airframe, limits, planner="expert", nodes=_FINE)
    flown, timeline = planned.trajectory, hold(planned, np.array([first, last]))
    times = np.arange(0.0, flown.duration, 1e-3)
    state = flown.at(times)
    speed = np.linalg.norm(state.velocity, axis=1)
    begin = int(np.flatnonzero(speed >= _FULL * speed.max())[-1])
    number = math.ceil((times[begin] - LEAD) * RATE)  # of the first setpoint from then on
    passed = float(speed[begin]) * (number / RATE + LEAD - float(times[begin]))  # m, until that setpoint is due
    lean = np.degrees(np.arccos(np.clip(state.thrust_axis[begin:, 2], -1.0, 1.0)))
    return Braking(
        PLAN,
        speed=float(speed[begin]),
        duration=flown.duration - float(times[begin]),
        distance=_way(state.position[begin:]),
        flown=passed + _flown(timeline.commitment.payloads[number:], 0, timeline, number, limits),
        acceleration=float(np.linalg.norm(state.acceleration[begin:], axis=1).max()),
        tilt=float(lean.max()),
        turning=float(np.linalg.norm(state.angular_acceleration[begin:], axis=1).max()),
    )


def _ends(limits: Limits) -> NDArray:
    """Return the ends, (2, 3) m, of a line through the middle of the room along its longest side."""
    space = limits.space
    low, high = np.array(space.low), np.array(space.high)
    along = int(np.argmax((high - low)[:2]))
    ends = np.repeat([(low + high) / 2.0], 2, axis=0)
    ends[:, along] = low[along] + space.margin + _FROM_WALLS, high[along] - space.margin - _FROM_WALLS
    return ends


def _straight_flight(limits: Limits) -> Timeline:
    """Return a flight along that line, from rest to rest."""
    ends = _ends(limits)
    path = min_snap(ends, times=centripetal_times(ends))
    return hold(plan(path, limits.airframe, limits, planner="expert"), ends)


def _at_full_speed(timeline: Timeline) -> int:
    """Return the number of the setpoint where the vehicle is fastest and its speed changes least."""
    state = timeline.motion.at(np.arange(0.0, timeline.ends, 1.0 / RATE))
    speed, acceleration = np.linalg.norm(state.velocity, axis=1), np.linalg.norm(state.acceleration, axis=1)
    return int(np.argmin(np.where(speed >= _FULL * speed.max(), acceleration, np.inf)))


def _flown(payloads: NDArray, brakes: int, timeline: Timeline, number: int, limits: Limits) -> float:
    """Return the farthest distance, m, of the vehicle from payload number `brakes`, where braking begins.

    The payloads replace the committed setpoints from `number` on.
    """
    loop = fly_on(payloads, limits.airframe, as_believed(timeline.snapshots_at(number), limits))
    ahead = loop.position[loop.time >= brakes / RATE] - decode(payloads).position[brakes]
    return float(np.linalg.norm(ahead, axis=1).max())


def _way(places: NDArray) -> float:
    return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())


def tables(settings: Settings, rows: list[Braking]) -> Iterator[Table]:
    """Yield the stops, and the braking of the fastest plan."""
    stops = [row for row in rows if row.what != PLAN]
    speed = f" from {stops[0].speed:.2f} m/s" if stops else ""
    yield table("stops", f"Stops{speed}, straight on", COLUMNS, stops)
    plans = [row for row in rows if row.what == PLAN]
    yield table("braking", "How the fastest plan brakes, straight on", PLAN_COLUMNS, plans)


STUDY = Study(Settings, work, tables, "-o results/stops.json")
