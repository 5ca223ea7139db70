"""Glitch margin: what a gap in setpoints, in poses, or in both does to the flight, beginning at any setpoint.

The flight is simulated once, as in the dry run, and branches off at each setpoint. Through the gap the vehicle keeps
its last setpoint; without poses it flies on by gyroscope and accelerometer, and what its attitude is wrong by makes its
estimate drift. Then everything comes again: setpoints as far on as the clock is, and poses. The vehicle is lost where
it then strays so far that the pilot would cut its motors, or leans so far that it turns over.

In 0.2 s a wrong attitude of 1° makes an estimate that misses 3 cm/s, which adds less than 3 cm to what a gap in
setpoints does. So poses stop at every fifth setpoint alone, and between two of these the worse one counts, if it is
worse than the flight with all its poses. Planning lets all gaps begin at every tenth setpoint only, where what is lost
is far away: there too the worse one of two counts between them.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.flight.firmware import gains_for
from cfplan.flight.setpoints.encoding import RATE
from cfplan.flight.setpoints.packets import decode
from cfplan.machine_code import njit
from cfplan.safety.limits import Limits
from cfplan.simulation.dynamics.body import FULL_EFFICIENCY, STILL_AIR, TIME_STEP, pack_body
from cfplan.simulation.dynamics.branching import (
    SNAPSHOT_SIZE,
    STEPS_A_CONTROL,
    arrival_steps,
    hovering_snapshot,
    setpoint_rows,
    step_control,
    step_vehicle,
)
from cfplan.simulation.dynamics.mellinger import CONTROL_PERIOD, FULL_STATE
from cfplan.simulation.dynamics.side_by_side import (
    MISSED,
    OWN,
    WIDTH,
    new_panel,
    step_controls,
    step_vehicles,
    unpacked_body,
    unpacked_gains,
    whole,
    write_setpoint,
    write_snapshot,
)
from cfplan.vehicle.airframe import GRAVITY

GAP = 0.2  # s without setpoints, without poses
AFTERWARDS = 1.0  # s that are simulated after the gap
TURNED_OVER = math.radians(80.0)  # of tilt
KINDS = ("setpoints", "poses", "setpoints and poses")
WITHOUT_POSES_EVERY = 5  # setpoints
SAMPLED_EVERY = 10  # setpoints, where the vehicle is far from lost
NEARLY = 0.6  # share of what is lost from which on it is not; by 0.15 it was exceeded at most in 26 flights, to 3 m/s
_NEAR_WORST = 0.03  # share of what is lost, within which of the worst one each setpoint is looked at
_DUE, _FARTHEST, _LEAST_LIFT, _ALONG = OWN, OWN + 3, OWN + 4, OWN + 5  # rows of a panel
_STEP = CONTROL_PERIOD  # s, of the simulation from the gap on: motors saturate, which 4 ms show too mildly


@dataclass(frozen=True, slots=True)
class GlitchMoments:
    """What a gap of GAP s that begins at each setpoint does, for each of KINDS."""

    time: NDArray  # (N,) s of each setpoint from the first
    deviation: NDArray  # (3, N) m, worst from the setpoints that are due, from the gap on
    tilt: NDArray  # (3, N) rad, worst from the gap on
    lost: NDArray  # (3, N) bool, whether the vehicle is lost

    @property
    def worst(self) -> tuple[str, int]:
        """Return the kind of gap and the setpoint after which the vehicle strays farthest."""
        kind, number = np.unravel_index(np.argmax(np.nan_to_num(self.deviation, nan=np.inf)), self.deviation.shape)
        return KINDS[int(kind)], int(number)

    def __str__(self) -> str:
        kind, number = self.worst
        row = KINDS.index(kind)
        return (
            f"a gap of {GAP:g} s in {kind} at {self.time[number]:.2f} s takes the vehicle "
            f"{self.deviation[row, number]:.2f} m off, at a tilt of {np.degrees(self.tilt[row, number]):.0f}°"
            f"{'; it is lost' if self.lost.any() else ''}"
        )


def glitch_at_every_setpoint(
    payloads: NDArray, limits: Limits, rate: float = RATE, *, gap: float = GAP, start: NDArray | None = None
) -> GlitchMoments:
    """Let a gap, s, begin at each setpoint of a flight, (N, 29) uint8 at `rate`, Hz.

    The flight begins in hover, or from the snapshot `start`, (31,), of another at the same setpoint.
    """
    return _moments(_simulate(payloads, limits, _as_sampled(len(payloads), limits), rate, gap, start), limits, rate)


def glitch_at_sampled_setpoints(
    payloads: NDArray, limits: Limits, rate: float = RATE, *, start: NDArray | None = None
) -> GlitchMoments:
    """Let a gap begin at every tenth setpoint of a flight, and at each where one of these nearly loses the vehicle.

    So at those about the worst one. Arguments as for glitch_at_every_setpoint.
    """
    return _sampled(payloads, limits, rate, start, _NEAR_WORST)


def glitch_where_nearly_lost(
    payloads: NDArray, limits: Limits, rate: float = RATE, *, start: NDArray | None = None
) -> GlitchMoments:
    """Return as glitch_at_sampled_setpoints() does which gaps lose the vehicle; where none does, not quite the worst.

    Arguments as for glitch_at_every_setpoint.
    """
    return _sampled(payloads, limits, rate, start, -math.inf)


def _sampled(payloads: NDArray, limits: Limits, rate: float, start: NDArray | None, near_worst: float) -> GlitchMoments:
    """Return what gaps do that begin where sampled, where one nearly loses the vehicle, and that near to the worst."""
    whole = _as_sampled(len(payloads), limits)
    first = np.where(_every(len(payloads), SAMPLED_EVERY), whole.max(), 0)
    flight = _fly_without(payloads, limits, rate, start)
    found = _let_begin(flight, limits, first, rate)
    moments = _moments(found, limits, rate)
    share = np.fmax(moments.deviation / limits.flight.deviation.cut, moments.tilt / TURNED_OVER).max(axis=0)
    share[moments.lost.any(axis=0)] = np.inf
    kinds = np.where((first == 0) & ~(share < min(NEARLY, share.max() - near_worst)), whole, 0)
    if kinds.any():
        more = _let_begin(flight, limits, kinds, rate)
        for kind in range(len(KINDS)):
            found.gaps[:, kind, kinds > kind] = more.gaps[:, kind, kinds > kind]
            found.simulated[kind, kinds > kind] = True
    return _moments(found, limits, rate)


class _Simulated(NamedTuple):
    """Deviation, m, and tilt, rad, worst from each setpoint on."""

    gaps: NDArray  # (2, 3, N) after a gap of each of KINDS
    simulated: NDArray  # (3, N) bool, whether it was simulated
    followed: NDArray  # (2, N) of the flight without a gap


class _Flight(NamedTuple):
    """A flight without a gap."""

    rows: NDArray  # (N, 20) setpoints, as the controller takes them
    snapshots: NDArray  # (N, 31) at the moments at which they arrive
    followed: NDArray  # (2, N) deviation, m, and tilt, rad, worst from each of them on


def _as_sampled(count: int, limits: Limits) -> NDArray:
    """Return (N,) how many of KINDS begin at each setpoint. An estimate without errors misses nothing without poses."""
    if limits.link_loss.attitude_error == 0.0:
        return np.ones(count, dtype=np.int64)
    return np.where(_every(count, WITHOUT_POSES_EVERY), len(KINDS), 1)


def _every(count: int, step: int) -> NDArray:
    """Return (N,) bool: so many setpoints apart, and the last."""
    number = np.arange(count)
    return (number % step == 0) | (number == count - 1)


def _simulate(
    payloads: NDArray, limits: Limits, kinds: NDArray, rate: float, gap: float = GAP, start: NDArray | None = None
) -> _Simulated:
    """Let so many of KINDS begin at each setpoint, `kinds` (N,)."""
    return _let_begin(_fly_without(payloads, limits, rate, start, gap), limits, kinds, rate, gap)


def _fly_without(payloads: NDArray, limits: Limits, rate: float, start: NDArray | None, gap: float = GAP) -> _Flight:
    """Fly without a gap, and look as far on from each setpoint as for one of `gap`, s."""
    state, airframe, count = decode(payloads), limits.airframe, len(payloads)
    begin = hovering_snapshot(airframe, state) if start is None else start
    rows, snapshots, followed = setpoint_rows(state), np.empty((count, SNAPSHOT_SIZE)), np.empty((2, count))
    _follow(
        snapshots, *followed, rows, arrival_steps(count, rate), begin, gains_for(airframe).pack(),
        pack_body(airframe, floor=-np.inf), round(_steps(gap) * _STEP / TIME_STEP),
    )  # fmt: skip
    return _Flight(rows, snapshots, followed)


def _let_begin(flight: _Flight, limits: Limits, kinds: NDArray, rate: float, gap: float = GAP) -> _Simulated:
    """Let so many of KINDS begin at each setpoint of a flight, `kinds` (N,)."""
    simulated = np.arange(len(KINDS))[:, None] < kinds
    newest, kind = np.nonzero(simulated.T)
    worst, gaps = np.empty((2, len(newest))), np.zeros((2, len(KINDS), len(kinds)))
    airframe, push = limits.airframe, GRAVITY * math.tan(limits.link_loss.attitude_error)
    _fly_gaps(
        *worst, flight.snapshots, newest, kind, flight.rows, gains_for(airframe).pack(),
        pack_body(airframe, floor=-np.inf, step=_STEP), round(gap / _STEP), _steps(gap), rate, push,
    )  # fmt: skip
    gaps[:, kind, newest] = worst
    return _Simulated(gaps, simulated, flight.followed)


def _steps(gap: float) -> int:
    """Return how many steps are simulated from the beginning of a gap, s, on."""
    return round((gap + AFTERWARDS) / _STEP)


def _moments(found: _Simulated, limits: Limits, rate: float) -> GlitchMoments:
    """Return of each setpoint what it leads to, where it was not simulated the worse one of those before and after.

    A gap in poses is no milder than none, and one in both no milder than one in setpoints.
    """
    worst = np.zeros_like(found.gaps)
    for kind, simulated in enumerate(found.simulated):
        least = (worst[:, 0], found.followed, worst[:, 0])[kind]
        worst[:, kind] = least
        if simulated.any():
            there = np.maximum(found.gaps[:, kind, simulated], least[:, simulated])
            after = np.searchsorted(np.flatnonzero(simulated), np.arange(len(simulated)))
            before = np.where(simulated, after, after - 1)
            worst[:, kind] = np.maximum(least, np.maximum(there[:, before], there[:, after]))
    deviation, tilt = worst
    kept = (deviation < limits.flight.deviation.cut) & (tilt < TURNED_OVER)
    return GlitchMoments(np.arange(len(kept.T)) / rate, deviation, tilt, ~kept)


@njit(nogil=True)
def _follow(
    snapshots: NDArray,
    followed: NDArray,
    followed_tilt: NDArray,
    setpoints: NDArray,
    arrivals: NDArray,
    start: NDArray,
    gains: NDArray,
    body: NDArray,
    following: int,
) -> None:
    """Fly the setpoints; write the snapshots at which each arrives, and what is worst in so many steps from there."""
    now, control, motors = start.copy(), np.zeros(4), np.zeros(4)
    away, lift = np.empty(arrivals[-1] + following), np.empty(arrivals[-1] + following)
    for newest in range(len(setpoints)):
        last = newest + 1 == len(setpoints)
        for k in range(SNAPSHOT_SIZE):
            snapshots[newest, k] = now[k]
        for step in range(arrivals[newest], len(away) if last else arrivals[newest + 1]):
            if step % STEPS_A_CONTROL == 0:
                step_control(now, now, gains, setpoints[newest], FULL_STATE, body, CONTROL_PERIOD, control, motors)
            step_vehicle(now, body, STILL_AIR, FULL_EFFICIENCY)
            away[step], lift[step] = _away(now, setpoints[newest]), _lift(now)
    # The worst of `following` steps is the worst of what is left of one block of as many, and of what the next begins
    # with (van Herk).
    left_away, left_lift = away.copy(), lift.copy()
    for step in range(len(away) - 2, -1, -1):
        if (step + 1) % following:
            left_away[step] = _most(left_away[step + 1], away[step])
            left_lift[step] = _least(left_lift[step + 1], lift[step])
    for step in range(1, len(away)):
        if step % following:
            away[step], lift[step] = _most(away[step - 1], away[step]), _least(lift[step - 1], lift[step])
    for newest in range(len(setpoints)):
        first, last_step = arrivals[newest], arrivals[newest] + following - 1
        followed[newest] = math.sqrt(_most(left_away[first], away[last_step]))
        followed_tilt[newest] = _tilt(_least(left_lift[first], lift[last_step]))


@njit(nogil=True, error_model="numpy")
def _fly_gaps(
    deviation: NDArray,
    tilt: NDArray,
    snapshots: NDArray,
    newest: NDArray,
    kind: NDArray,
    setpoints: NDArray,
    gains: NDArray,
    body: NDArray,
    gap: int,
    steps: int,
    rate: float,
    push: float,
) -> None:
    """Fly on through gaps, each of a kind, that begin at the setpoints `newest`, (B,).

    Written are the worst deviation, m, and tilt, rad, from there on. Snapshots are at each setpoint.
    """
    panel, spare = new_panel(), np.empty((WIDTH, SNAPSHOT_SIZE))
    the_gains, the_body = unpacked_gains(gains), unpacked_body(body)
    for first in range(0, len(newest), WIDTH):
        lanes, passed = min(WIDTH, len(newest) - first), -1
        for n in range(lanes):
            snapshot = snapshots[newest[first + n]]
            write_snapshot(panel, n, snapshot)
            _write_direction(panel, n, snapshot, kind[first + n] != 0)
            panel[_FARTHEST * WIDTH + n], panel[_LEAST_LIFT * WIDTH + n] = 0.0, 1.0
        for step in range(steps):
            since = int(step * _STEP * rate + 1e-9)
            if since != passed or step == gap:
                passed = since
                for n in range(lanes):
                    due = min(newest[first + n] + since, len(setpoints) - 1)
                    holds = kind[first + n] != 1 and step < gap
                    write_setpoint(panel, n, setpoints[newest[first + n] if holds else due])
                    for k in range(3):
                        panel[(_DUE + k) * WIDTH + n] = setpoints[due, k]
            if step <= gap:
                time = step * _STEP if step < gap else 0.0
                _fall_behind(panel, whole(lanes), 0.5 * push * time * time, push * time)
            step_controls(panel, lanes, the_gains, the_body, False, _STEP)
            step_vehicles(panel, lanes, the_body, body, spare)
            _judge(panel, whole(lanes))
        for n in range(lanes):
            deviation[first + n] = math.sqrt(panel[_FARTHEST * WIDTH + n])
            tilt[first + n] = _tilt(panel[_LEAST_LIFT * WIDTH + n])


@register_jitable
def _write_direction(panel: NDArray, n: int, snapshot: NDArray, no_poses: bool) -> None:
    """Write the direction of motion, in which the estimate falls behind; none where there are poses."""
    speed = math.sqrt(snapshot[3] ** 2 + snapshot[4] ** 2)
    x, y = (snapshot[3] / speed, snapshot[4] / speed) if speed > 0.0 else (1.0, 0.0)
    panel[_ALONG * WIDTH + n], panel[(_ALONG + 1) * WIDTH + n] = (x, y) if no_poses else (0.0, 0.0)


@register_jitable
def _fall_behind(panel: NDArray, lanes: int, distance: float, speed: float) -> None:
    """Let the estimates fall behind the motion, by what a wrong attitude makes them miss: m, m/s."""
    lanes = min(lanes, WIDTH)
    for k in range(2):
        for n in range(lanes):
            panel[(MISSED + k) * WIDTH + n] = distance * panel[(_ALONG + k) * WIDTH + n]
            panel[(MISSED + 2 + k) * WIDTH + n] = speed * panel[(_ALONG + k) * WIDTH + n]


@register_jitable
def _judge(panel: NDArray, lanes: int) -> None:
    """Note how far from its setpoint and how far tilted each vehicle is, if more than before."""
    lanes = min(lanes, WIDTH)
    for n in range(lanes):
        x, y, z = panel[n], panel[WIDTH + n], panel[2 * WIDTH + n]
        due = panel[_DUE * WIDTH + n], panel[(_DUE + 1) * WIDTH + n], panel[(_DUE + 2) * WIDTH + n]
        panel[_FARTHEST * WIDTH + n] = _most(panel[_FARTHEST * WIDTH + n], _away((x, y, z), due))
        qx, qy = panel[6 * WIDTH + n], panel[7 * WIDTH + n]
        panel[_LEAST_LIFT * WIDTH + n] = _least(panel[_LEAST_LIFT * WIDTH + n], 1.0 - 2.0 * (qx * qx + qy * qy))


@register_jitable
def _away(now: Any, setpoint: Any) -> float:
    """Return the square of the distance from a setpoint, m²."""
    return (now[0] - setpoint[0]) ** 2 + (now[1] - setpoint[1]) ** 2 + (now[2] - setpoint[2]) ** 2


@register_jitable
def _lift(now: NDArray) -> float:
    """Return the cosine of the tilt."""
    return 1.0 - 2.0 * (now[6] * now[6] + now[7] * now[7])


@register_jitable
def _tilt(lift: float) -> float:
    return math.acos(min(max(lift, -1.0), 1.0))


@register_jitable
def _most(value: float, other: float) -> float:
    """Return the larger; written so that what is no number is taken over."""
    return value if other <= value else other


@register_jitable
def _least(value: float, other: float) -> float:
    return value if other >= value else other
