"""Glitch margin: the effect of a gap in setpoints, in poses, or in both, beginning at any setpoint.

The flight is simulated once and branches off at each setpoint; the estimate of position and velocity is late all the
time. Where a gap takes the nominal vehicle far, one with slower motors and a stronger one fly too, each by the
airframe's spread, and the worst counts.

During the gap the vehicle keeps its last setpoint; without poses it flies on by gyroscope and accelerometer, and an
error of its attitude makes the estimate drift. After the gap, the setpoints that are due by the clock arrive again, and
poses. The vehicle is lost if it then deviates so far that the pilot would cut its motors, or tilts so far that it turns
over.

In 0.2 s an attitude error of 1° makes an error of 3 cm/s in the estimate, which adds less than 3 cm to the effect of a
gap in setpoints. So gaps in poses begin at every fifth setpoint only; between two of these the worse one counts, if it
is worse than the flight with all its poses. In planning all gaps begin at every tenth setpoint only, if the vehicle is
far from lost; there too the worse of two counts between them.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.firmware import estimate_errors, gains_for
from cfplan.flight.setpoints.encoding import RATE
from cfplan.flight.setpoints.packets import decode
from cfplan.safety.limits import Limits
from cfplan.simulation.engine.flight import NO_FLOOR
from cfplan.simulation.engine.layout import POSITION, QUATERNION, hovering_snapshot, pack_airframe, setpoint_rows
from cfplan.simulation.engine.run import Schedule, Vehicles, arrival_times, simulate
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.rotations import tilt_of

GAP = 0.2  # s without setpoints, without poses
LATENCY = 0.010  # s, lateness of the estimate; in dry runs positions are up to 6 and velocities up to 9 ms late
AFTERWARDS = 2.0  # s simulated after the gap: at little thrust a vehicle may stray for 1.5 s until it is lost
TURNED_OVER = math.radians(80.0)  # of tilt
KINDS = ("setpoints", "poses", "setpoints and poses")
WITHOUT_POSES_EVERY = 5  # setpoints
SAMPLED_EVERY = 10  # setpoints, if the vehicle is far from lost
CRITICAL_USAGE = 0.6  # usage above which it is not far
"""In 26 flights up to 3 m/s, whose estimates were exact, it rose by at most 0.15 between samples."""
_OTHERS_FROM = (
    0.4  # usage of the nominal vehicle from which the others fly; below it theirs was at most 0.66 in 11 flights
)
_NEAR_WORST = 0.03  # usage; around samples this close to the worst one every setpoint is simulated
_LATENCY_MS = round(1000 * LATENCY)
_STEP = 2  # ms, of the simulation from the gap on: steps of 4 ms underestimate saturation of the motors


@dataclass(frozen=True, slots=True)
class GlitchMoments:
    """The effect of a gap of GAP s that begins at each setpoint, for each of KINDS."""

    time: NDArray  # (N,) s of each setpoint from the first
    deviation: NDArray  # (3, N) m, largest distance from the setpoints that are due, from the gap on
    tilt: NDArray  # (3, N) rad, largest from the gap on
    lost: NDArray  # (3, N) bool, whether the vehicle is lost

    def usage(self, limits: Limits) -> NDArray:
        """Return (3, N): deviation or tilt as a fraction of what loses the vehicle; at least 1 if it is lost."""
        share = np.fmax(self.deviation / limits.flight.deviation.cut, self.tilt / TURNED_OVER)
        return np.where(self.lost & ~(share >= 1.0), np.inf, share)

    @property
    def worst(self) -> tuple[str, int]:
        """Return the kind of gap and the setpoint with the largest deviation."""
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
    flight = _fly_without(payloads, limits, limits.airframe, rate, gap, start)
    nominal = flight.moments(_gaps(flight, _wanted(len(payloads), limits), limits, gap), limits, rate)
    return _with_others(nominal, payloads, limits, rate, gap, start)


def glitch_at_sampled_setpoints(
    payloads: NDArray, limits: Limits, rate: float = RATE, *, start: NDArray | None = None
) -> GlitchMoments:
    """Let a gap begin at every tenth setpoint of a flight, and at each one near a gap that nearly loses the vehicle.

    The same holds near the worst of them. Arguments as for glitch_at_every_setpoint.
    """
    return _sampled(payloads, limits, rate, start, _NEAR_WORST)


def glitch_near_critical_setpoints(
    payloads: NDArray, limits: Limits, rate: float = RATE, *, start: NDArray | None = None
) -> GlitchMoments:
    """Let a gap begin like glitch_at_sampled_setpoints(); if none nearly loses the vehicle, the worst is not found."""
    return _sampled(payloads, limits, rate, start, -math.inf)


def _sampled(payloads: NDArray, limits: Limits, rate: float, start: NDArray | None, near_worst: float) -> GlitchMoments:
    """Simulate all setpoints near samples with a usage of CRITICAL_USAGE, or `near_worst` below the largest."""
    flight = _fly_without(payloads, limits, limits.airframe, rate, GAP, start)
    wanted: NDArray = _wanted(len(payloads), limits)
    first = _every(len(payloads), SAMPLED_EVERY) & wanted.any(axis=1, keepdims=True)
    found = _gaps(flight, first, limits, GAP)
    usage = flight.moments(found, limits, rate).usage(limits).max(axis=0)
    more = wanted & ~first & ~(usage < min(CRITICAL_USAGE, usage.max() - near_worst))
    nominal = flight.moments(np.fmax(found, _gaps(flight, more, limits, GAP)), limits, rate)
    return _with_others(nominal, payloads, limits, rate, GAP, start)


def _with_others(
    nominal: GlitchMoments, payloads: NDArray, limits: Limits, rate: float, gap: float, start: NDArray | None
) -> GlitchMoments:
    """Return the worst of all vehicles; the others fly from every fifth setpoint, where the nominal one strays."""
    from scipy.ndimage import maximum_filter1d  # slow to import

    strays = nominal.usage(limits).max(axis=0) >= _OTHERS_FROM
    if not strays.any():
        return nominal
    worst, count = nominal, len(payloads)
    near = maximum_filter1d(strays, 2 * WITHOUT_POSES_EVERY - 1, mode="nearest")  # with the samples around them
    wanted = _wanted(count, limits) & (near & _every(count, WITHOUT_POSES_EVERY) | _every(count, count))
    for airframe in _others(limits.airframe):
        flight = _fly_without(payloads, limits, airframe, rate, gap, start)
        found = flight.moments(_gaps(flight, wanted, limits, gap), limits, rate)
        worst = GlitchMoments(
            worst.time,
            np.where(strays, np.fmax(worst.deviation, found.deviation), worst.deviation),
            np.where(strays, np.fmax(worst.tilt, found.tilt), worst.tilt),
            worst.lost | (strays & found.lost),
        )
    return worst


def _others(airframe: Airframe) -> list[Airframe]:
    """Return the vehicles that a gap loses soonest: of 32 drawn ones, those with slow motors or much thrust."""
    spread = airframe.spread
    slower = replace(airframe, motor_time_constant=(1.0 + spread.motor_time_constant) * airframe.motor_time_constant)
    stronger = replace(airframe, thrust_scale=(1.0 + spread.thrust_scale) * airframe.thrust_scale)
    return [other for other in (slower, stronger) if other != airframe]


def _wanted(count: int, limits: Limits) -> NDArray:
    """Return (3, N) bool: the KINDS of gap to simulate at each setpoint; an exact estimate needs no gaps in poses."""
    blind = _every(count, WITHOUT_POSES_EVERY) & (estimate_errors(limits)[0] > 0.0)
    return np.stack([np.ones(count, dtype=bool), blind, blind])


def _every(count: int, step: int) -> NDArray:
    """Return (N,) bool: every `step`-th setpoint, and the last."""
    number = np.arange(count)
    return (number % step == 0) | (number == count - 1)


class _Flight(NamedTuple):
    """A flight without a gap."""

    airframe: NDArray  # (26,) as a batch holds it
    rows: NDArray  # (N, 20) setpoints, as the controller takes them
    arrivals: NDArray  # (N,) ms
    snapshots: NDArray  # (N, 31) when they arrive
    followed: NDArray  # (2, N) largest deviation, m, and tilt, rad, from each setpoint on

    def moments(self, found: NDArray, limits: Limits, rate: float) -> GlitchMoments:
        """Return the effect of all gaps from those that were simulated, (2, 3, N), NaN for the others.

        Between two simulated gaps the worse one counts. A gap in poses is no milder than none, and one in both no
        milder than one in setpoints.
        """
        worst, number = np.zeros_like(found), np.arange(len(self.rows))
        for kind in range(len(KINDS)):
            worst[:, kind] = self.followed if kind == 1 else worst[:, 0]
            known = np.flatnonzero(~np.isnan(found[0, kind]))
            if len(known):
                after = np.searchsorted(known, number)
                before = np.where(known[after] == number, after, after - 1)
                there = np.maximum(found[:, kind, known], worst[:, kind, known])
                worst[:, kind] = np.maximum(worst[:, kind], np.maximum(there[:, before], there[:, after]))
        deviation, tilt = worst
        kept = (deviation < limits.flight.deviation.cut) & (tilt < TURNED_OVER)
        return GlitchMoments(number / rate, deviation, tilt, ~kept)


def _fly_without(
    payloads: NDArray, limits: Limits, airframe: Airframe, rate: float, gap: float, start: NDArray | None
) -> _Flight:
    """Fly a vehicle without a gap; from each setpoint, evaluate as long a time as for a gap of `gap`, s."""
    from scipy.ndimage import maximum_filter1d  # slow to import

    state, first, watched = decode(payloads), np.zeros(1, dtype=np.int64), round(1000 * (gap + AFTERWARDS))
    rows, arrivals = setpoint_rows(state), arrival_times(len(payloads), rate)
    begin = hovering_snapshot(airframe, state) if start is None else start
    packed = pack_airframe(airframe, floor=NO_FLOOR)
    batch = Vehicles(begin[None], packed[None], first, first + len(rows) - 1, first, np.zeros((1, 3)))
    steps, gains = int(arrivals[-1]) + watched + 1, gains_for(limits.airframe).pack()
    schedule = Schedule(rows, arrivals, gains, steps=steps, latency=_LATENCY_MS)
    flown = simulate(batch, schedule, arrived=len(rows), trace=True)
    moved = flown.trace[0, 1:]
    due = rows[np.searchsorted(arrivals, np.arange(len(moved)), side="right") - 1, :3]
    each = np.stack([np.linalg.norm(moved[:, POSITION] - due, axis=1), tilt_of(moved[:, QUATERNION].T)])
    # The filter's window begins at each moment.
    worst = maximum_filter1d(np.where(np.isfinite(each), each, np.inf), watched, axis=1, origin=-(watched // 2))
    return _Flight(packed, rows, arrivals, flown.arrived[0], worst[:, arrivals])


def _gaps(flight: _Flight, wanted: NDArray, limits: Limits, gap: float) -> NDArray:
    """Return (2, 3, N): the worst deviation, m, and tilt, rad, from the gaps on that are `wanted`, (3, N); else NaN.

    If poses are missing, the estimate falls behind in the direction of motion.
    """
    kind, number = np.nonzero(wanted)
    snapshots, milliseconds = flight.snapshots[number], round(1000 * gap)
    speed = np.linalg.norm(snapshots[:, 3:5], axis=1, keepdims=True)
    ahead = np.where(speed > 0.0, snapshots[:, 3:5] / np.where(speed > 0.0, speed, 1.0), (1.0, 0.0))
    push = GRAVITY * math.tan(estimate_errors(limits)[0]) * (kind != 0)[:, None]
    batch = Vehicles(
        snapshots, np.tile(flight.airframe, (len(kind), 1)), number,
        np.full(len(kind), len(flight.rows) - 1), np.where(kind == 1, 0, milliseconds),
        np.concatenate([push * ahead, np.zeros((len(kind), 1))], axis=1),
    )  # fmt: skip
    schedule = Schedule(
        flight.rows, flight.arrivals, gains_for(limits.airframe).pack(),
        steps=(milliseconds + round(1000 * AFTERWARDS)) // _STEP, step=_STEP, blind_until=milliseconds,
        latency=_LATENCY_MS,
    )  # fmt: skip
    found, worst = simulate(batch, schedule), np.full((2, *wanted.shape), np.nan)
    worst[:, kind, number] = np.nan_to_num((found.deviation, found.tilt), nan=np.inf)  # NaN: not simulated
    return worst
