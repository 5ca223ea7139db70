"""Dry run: the bytes to be sent, flown by simulated vehicles before the flight.

The simulated vehicle is flown like the real one: by the firmware's controller on the estimate of its Kalman filter,
which gets late and noisy poses. What is unknown before the flight is drawn (see `draws`): the expected deviation is the
median over the draws, and the 95th percentile decides. Each draw begins in hover at the start, receives each payload
when it is due, and hovers at the last one.

In the air there is no time for that: the nominal vehicle, with exact knowledge of its state, continues from the
simulated state: rehearse_motion() and rehearse_setpoints().
"""

import math
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import NotCertifiedError
from cfplan.flight.firmware import Timeouts, gains_for, knows_drag
from cfplan.flight.pilot.vehicle_rules import EXTERNAL_ATTITUDE_STD, EXTERNAL_POSITION_STD
from cfplan.flight.setpoints.encoding import LEAD, RATE, EncodedFlight
from cfplan.flight.setpoints.packets import decode
from cfplan.safety.limits import FlightLimits, Limits
from cfplan.safety.quantities import ON_LADDER
from cfplan.simulation.draws import RADIO, Draw, draw_vehicles, nominal_draw
from cfplan.simulation.engine.body import TIME_STEP
from cfplan.simulation.engine.estimated_loop import EstimatorInput, fly_with_estimator
from cfplan.simulation.engine.flight import AS_PLANNED, ClosedLoop, Conditions, fly_setpoints
from cfplan.simulation.engine.layout import hovering, setpoint_rows
from cfplan.simulation.engine.mellinger import FULL_COMMAND, FULL_STATE, Modes
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.joint import JoinedTrajectory
from cfplan.vehicle.trajectory import Trajectory

SETTLING = 1.0  # s simulated after the last payload, which stays in force
SETTLED = 0.02  # m from the end, within which the vehicle has arrived
ARRIVED = 0.05  # m, largest final error
EXPECTED = 0.95  # quantile over the draws that decides
_STRIDE = 5  # ms between comparisons of positions
_HINT = "plan with lower limits, or check mass, thrust and motor lag of the airframe"


@dataclass(frozen=True, slots=True)
class Rehearsal:
    """The figures that decide whether a flight passes; in a dry run the 95th percentile over its draws."""

    reason: str  # why it failed; empty when it passed
    deviation: float  # m, largest distance from the trajectory at the same time
    deviation_time: float  # s, when that occurred
    final_error: float  # m, from the end of the path when the simulation ends
    speed: float  # m/s, highest value sustained for the limits' patience
    acceleration: float  # m/s², likewise
    angular_velocity: float  # rad/s, likewise

    @property
    def passed(self) -> bool:
        """Return whether the rehearsal passed."""
        return not self.reason

    def require_passed(self) -> None:
        """Raise NotCertifiedError if it failed."""
        if self.reason:
            raise NotCertifiedError(self.reason, where="dry run", hint=_HINT)


@dataclass(frozen=True, slots=True)
class DryRun(Rehearsal):
    """The result of a dry run; figures that are not over the draws are those of the nominal vehicle."""

    deviation_median: float  # m, over the draws, of the worst deviation of each
    deviations: tuple[float, ...]  # m, the worst of each draw
    deviation_rms: float  # m, while it moves
    path_distance: float  # m, worst distance from the path, at any time
    settle_time: float  # s, from the end of the motion until it stays within SETTLED; inf when it never does
    saturation: float  # fraction of time that the worst motor is at either end of its range
    real_time_factor: float  # simulated seconds per second, all draws together
    knows_drag: bool  # whether the filter models rotor drag, as that of the oldest permitted firmware may
    loop: ClosedLoop  # the whole flight

    def __repr__(self) -> str:
        return f"<DryRun: {self.reason or 'passed'}, largest deviation {self.expected()}>"

    def expected(self) -> str:
        """Return the largest deviation to expect, in words."""
        return f"{100 * self.deviation_median:.1f} cm in the median, {100 * self.deviation:.1f} cm in 95 %"

    def summary(self) -> dict[str, bool | float | str | None]:
        """Return the figures for a file, without the flights; values that are not finite become None."""
        names = [field.name for field in fields(self) if field.name not in ("loop", "deviations")]
        figures = {name: getattr(self, name) for name in names}
        return {"passed": self.passed} | {
            name: value if isinstance(value, str) or np.isfinite(value) else None for name, value in figures.items()
        }

    def rows(self) -> list[tuple[str, str]]:
        """Return rows of figures for people."""
        drag = "models rotor drag" if self.knows_drag else "without a model of rotor drag, as before firmware 2026.04"
        return [
            ("verdict", self.reason or "passed"),
            ("largest deviation, median", f"{100 * self.deviation_median:.1f} cm of {len(self.deviations)} draws"),
            ("largest deviation, 95 %", f"{100 * self.deviation:.1f} cm, at {self.deviation_time:.2f} s"),
            ("deviation in time, rms", f"{100 * self.deviation_rms:.1f} cm"),
            ("distance to the path", f"{100 * self.path_distance:.1f} cm"),
            ("error at the end", f"{100 * self.final_error:.1f} cm, settled after {self.settle_time:.2f} s"),
            ("speed", f"{self.speed:.2f} m/s"),
            ("acceleration", f"{self.acceleration:.2f} m/s²"),
            ("angular velocity", f"{self.angular_velocity:.2f} rad/s"),
            ("time at a motor's limit", f"{100 * self.saturation:.1f} %"),
            ("vehicle's filter", drag),
            ("faster than real time", f"{self.real_time_factor:.0f} times"),
        ]


@dataclass(frozen=True, slots=True, eq=False)
class Rehearsed:
    """The setpoints of a dry run, and the motion for comparison."""

    setpoints: NDArray  # (N, 20) as in `mellinger`
    times: NDArray  # (N,) s, when each is sent
    yaw: float  # rad, of the initial hover
    wanted_at: Callable[[NDArray], NDArray]  # times (N,) s -> (N, 3) m
    moving: float  # s
    duration: float  # s, to the end of the simulation
    mode: Modes = FULL_STATE  # of the setpoints


def dry_run(encoded: EncodedFlight, trajectory: Trajectory | JoinedTrajectory, limits: Limits) -> DryRun:
    """Fly the payloads on vehicles drawn about the airframe of the limits; compare with `trajectory`."""
    return rehearse_draws(rehearsed_flight(encoded, trajectory), limits)


def rehearsed_flight(encoded: EncodedFlight, trajectory: Trajectory | JoinedTrajectory) -> Rehearsed:
    """Return the flight of an encoded trajectory, to be flown by drawn vehicles."""
    rows, yaw = setpoint_rows(decode(encoded.payloads)), float(trajectory.at(0.0).yaw)

    def wanted_at(times: NDArray) -> NDArray:
        return np.asarray(trajectory.at(times).position)

    return Rehearsed(rows, encoded.times, yaw, wanted_at, trajectory.duration, encoded.duration + SETTLING)


def rehearse_draws(flight: Rehearsed, limits: Limits) -> DryRun:
    """Fly the nominal vehicle and the draws, and judge the quantile over the draws.

    The real-time factor counts everything but the compilation at the first call ever.
    """
    nominal = nominal_draw(limits.airframe, limits.pose)
    fly_drawn(replace(flight, duration=0.0), nominal, limits)  # compiles if necessary
    _distances_to_path(np.zeros((1, 3)), np.zeros((1, 3)))
    begun = time.perf_counter()
    steps = round(flight.duration / TIME_STEP) + 1
    wanted = flight.wanted_at(np.arange(0, steps, _STRIDE) * TIME_STEP)

    def fly_and_judge(draw: Draw) -> Rehearsal:
        loop = fly_drawn(flight, draw, limits)
        return _rehearsed(loop, _away(loop, wanted), limits.flight)

    with ThreadPoolExecutor(min(os.cpu_count() or 1, 8)) as pool:  # the compiled loop lets other threads run
        itself = pool.submit(fly_drawn, flight, nominal, limits)
        runs = list(pool.map(fly_and_judge, draw_vehicles(limits.airframe, limits.pose)))
        loop = itself.result()
    run = _judge(runs, loop, wanted, flight.moving, limits)
    return replace(run, real_time_factor=flight.duration / (time.perf_counter() - begun))


def fly_drawn(flight: Rehearsed, draw: Draw, limits: Limits, lost: float = math.inf) -> ClosedLoop:
    """Fly a drawn vehicle, whose controller and filter have the parameters that the pilot sets.

    After `lost`, s, neither setpoints nor poses are sent, and its supervisor levels it out and stops its motors.
    """
    planned, drawn = limits.airframe, draw.airframe
    gains = gains_for(planned)
    # The hover was too short for the controller's integral, of some 25 s, to compensate for errors of mass and thrust.
    sunk = GRAVITY * (drawn.mass * planned.thrust_scale / drawn.thrust_scale - planned.mass) / gains.kp_z
    start = hovering(drawn, flight.wanted_at(np.zeros(1))[0] - [0.0, 0.0, sunk], flight.yaw)
    steps = round(flight.duration / TIME_STEP) + 1
    arrivals = np.arange(draw.pose_phase, min(flight.duration + TIME_STEP, lost), 1.0 / limits.pose.rate)
    sent = flight.times <= lost
    alone = flight.times[sent][-1] + RADIO if lost < math.inf else math.inf
    noise = np.random.default_rng(draw.seed).normal(size=(len(arrivals), 6))
    noise *= np.repeat([limits.pose.position_noise, limits.pose.attitude_noise], 3)
    drag = planned.drag[0] / planned.mass if knows_drag(limits) else 0.0
    poses = EstimatorInput(
        arrivals, draw.pose_age, draw.attitude_age, position_deviation=EXTERNAL_POSITION_STD,
        attitude_deviation=EXTERNAL_ATTITUDE_STD, drag=(drag, drag, 0.0), noise=noise,
    )  # fmt: skip
    flown = fly_with_estimator(
        gains, flight.setpoints[sent], flight.times[sent] + RADIO, drawn, start[:13], poses,
        scale=np.full(steps, drawn.thrust_scale), mode=flight.mode,
        level_at=alone + Timeouts().level_out_at_latest,
        off_at=alone + Timeouts().motors_off_at_latest(limits.firmware.watchdog),
    )  # fmt: skip
    commands = flown.asked * (FULL_COMMAND / planned.motor_thrust_max)
    return ClosedLoop(np.arange(steps) * TIME_STEP, flown.states, commands)


def rehearse_motion(
    encoded: EncodedFlight,
    motion: Trajectory | JoinedTrajectory,
    airframe: Airframe,
    limits: FlightLimits,
    *,
    conditions: Conditions = AS_PLANNED,
    snapshot: NDArray | None = None,
) -> Rehearsal:
    """Fly like fly_motion(); compare with `motion`."""
    loop = fly_motion(encoded, motion, airframe, conditions=conditions, snapshot=snapshot)
    return _rehearsed(loop, _away(loop, motion.at(loop.time[::_STRIDE]).position), limits)


def fly_motion(
    encoded: EncodedFlight,
    motion: Trajectory | JoinedTrajectory,
    airframe: Airframe,
    *,
    conditions: Conditions = AS_PLANNED,
    snapshot: NDArray | None = None,
) -> ClosedLoop:
    """Return the flight of the payloads on one vehicle that knows its true state.

    `snapshot`, (31,), is the state of another flight that this one continues, instead of a hover.
    """
    start = motion.at(0.0)
    begin = hovering(airframe, start.position, float(start.yaw)) if snapshot is None else snapshot
    duration = encoded.duration + SETTLING
    return fly_setpoints(decode(encoded.payloads), encoded.times, airframe, begin, duration, conditions)


def rehearse_setpoints(
    payloads: NDArray, airframe: Airframe, limits: FlightLimits, *, snapshot: NDArray, rate: float = RATE
) -> Rehearsal:
    """Fly payloads, (N, 29) uint8 at `rate`, Hz, on from a snapshot, (31,); compare with the places in them.

    As rehearse_motion() does, of a motion that is known by its setpoints alone.
    """
    loop = fly_on(payloads, airframe, snapshot, rate)
    decoded, times = decode(payloads), np.arange(len(payloads)) / rate
    moments = loop.time[::_STRIDE]
    wanted = np.stack([np.interp(moments, times + LEAD, along) for along in decoded.position.T], axis=1)
    return _rehearsed(loop, _away(loop, wanted), limits)


def fly_on(payloads: NDArray, airframe: Airframe, snapshot: NDArray, rate: float = RATE) -> ClosedLoop:
    """Fly payloads, (N, 29) uint8 at `rate`, Hz, on from a snapshot, (31,); the last one is held."""
    times = np.arange(len(payloads)) / rate
    duration = times[-1] + SETTLING
    return fly_setpoints(decode(payloads), times, airframe, snapshot, duration)


def _judge(
    runs: Sequence[Rehearsal], loop: ClosedLoop, wanted: NDArray, duration: float, limits: Limits
) -> DryRun:  # fmt: skip
    """Return the result over the runs of all draws, with figures of the nominal vehicle's flight."""
    times, positions, error = loop.time[::_STRIDE], loop.position[::_STRIDE], _away(loop, wanted)
    known = np.isfinite(positions).all(axis=1)
    nearest = np.where(known, _distances_to_path(np.where(known[:, None], positions, 0.0), wanted), np.inf)
    moving = times <= duration
    late = np.flatnonzero(~moving & (error > SETTLED))
    settled = times[late[-1]] - duration if len(late) else 0.0
    at_its_end = np.mean((loop.commands <= 0) | (loop.commands >= FULL_COMMAND), axis=0)
    return DryRun(
        **asdict(_expected(runs, limits.flight)),
        deviation_median=float(np.median([run.deviation for run in runs])),
        deviations=tuple(run.deviation for run in runs),
        deviation_rms=float(np.sqrt(np.mean(error[moving] ** 2))),
        path_distance=float(nearest.max()),
        settle_time=float(np.inf if error[-1] > SETTLED else settled),
        saturation=float(at_its_end.max()),
        real_time_factor=np.inf,
        knows_drag=knows_drag(limits),
        loop=loop,
    )


def _expected(runs: Sequence[Rehearsal], limits: FlightLimits) -> Rehearsal:
    """Return the quantile EXPECTED of each figure, rounded up to a draw."""
    at = int(np.ceil(EXPECTED * (len(runs) - 1)))
    worst = sorted(runs, key=lambda run: run.deviation)[at]
    figures = {
        name: sorted(getattr(run, name) for run in runs)[at]
        for name in ("final_error", "speed", "acceleration", "angular_velocity")
    }
    run = replace(worst, **figures)
    return replace(run, reason=_fault(run, limits))


def _away(loop: ClosedLoop, wanted: NDArray) -> NDArray:
    """Return the distance from the desired position, (K, 3) m, each _STRIDE, (K,) m; inf if unknown."""
    error = np.linalg.norm(loop.position[::_STRIDE] - wanted, axis=1)
    return np.where(np.isfinite(error), error, np.inf)


def _rehearsed(loop: ClosedLoop, error: NDArray, limits: FlightLimits) -> Rehearsal:
    """Return the figures that decide; `error`, (K,) m, is the distance from the desired position."""
    worst, patience = int(np.argmax(error)), limits.patience
    changes = np.diff(loop.velocity, axis=0)
    run = Rehearsal(
        reason="",
        deviation=float(error[worst]),
        deviation_time=float(loop.time[::_STRIDE][worst]),
        final_error=float(error[-1]),
        speed=_lasting(np.linalg.norm(loop.velocity, axis=1), patience),
        acceleration=_lasting(np.linalg.norm(changes, axis=1) / TIME_STEP, patience),
        angular_velocity=_lasting(np.linalg.norm(loop.body_rate, axis=1), patience),
    )
    return replace(run, reason=_fault(run, limits))


def _fault(run: Rehearsal, limits: FlightLimits) -> str:
    """Return the first reason not to fly, or an empty text. A NaN position counts as infinitely far."""
    if not run.deviation < limits.deviation.brake:
        return (
            f"the vehicle strays {run.deviation:.2f} m from the trajectory at {run.deviation_time:.2f} s; "
            f"from {limits.deviation.brake:g} m on the pilot brakes"
        )
    for quantity in ON_LADDER:
        value, limit, unit = getattr(run, quantity.ladder), getattr(limits, quantity.ladder).brake, quantity.unit
        if not value < limit:
            return f"{quantity.name} reaches {value:.2f} {unit}; from {limit:g} {unit} on the pilot brakes"
    if not run.final_error <= ARRIVED:
        return f"the vehicle is {run.final_error:.2f} m from the end of the path {SETTLING:g} s after the last setpoint"
    return ""


def _lasting(values: NDArray, patience: float) -> float:
    """Return the highest value below which the values do not fall for `patience`, s; less at the ends."""
    from scipy.ndimage import minimum_filter1d  # slow to import

    window = min(max(1, round(patience / TIME_STEP)), len(values))
    values = np.where(np.isfinite(values), values, np.inf)
    return float(minimum_filter1d(values, window, mode="nearest").max())  # the ends stand in for the time not simulated


def _distances_to_path(positions: NDArray, wanted: NDArray) -> NDArray:
    """Return the distance of each position, (N, 3), to the nearest of the wanted ones, (M, 3)."""
    from scipy.spatial import KDTree

    return np.asarray(KDTree(wanted).query(positions)[0])
