"""Dry run: fly exactly the bytes that will be sent on the simulated vehicle, before the flight.

It starts in hover at the start, receives each payload when it is due and hovers on the last one; the controller sees
the true state. Its motion is compared with the limits at which the pilot would brake.
"""

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import NotCertifiedError
from cfplan.flight.setpoints.encoding import LEAD, RATE, EncodedFlight
from cfplan.flight.setpoints.packets import decode
from cfplan.safety.limits import FlightLimits
from cfplan.safety.quantities import ON_LADDER
from cfplan.simulation.engine.body import TIME_STEP
from cfplan.simulation.engine.flight import AS_PLANNED, ClosedLoop, Conditions, fly_setpoints
from cfplan.simulation.engine.layout import hovering
from cfplan.simulation.engine.mellinger import FULL_COMMAND
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.joint import JoinedTrajectory
from cfplan.vehicle.trajectory import Trajectory

SETTLING = 1.0  # s simulated after the last payload, which the vehicle keeps
SETTLED = 0.02  # m from the end, within which the vehicle has settled
ARRIVED = 0.05  # m from the end, the largest permitted final error
_STRIDE = 5  # ms between compared positions
_HINT = "plan with lower limits, or check mass, thrust and motor lag of the airframe"


@dataclass(frozen=True, slots=True)
class Rehearsal:
    """The figures by which a dry run passes or fails."""

    reason: str  # why it failed; empty when it passed
    deviation: float  # m, largest distance from the trajectory at the same time
    deviation_time: float  # s, when that occurred
    final_error: float  # m, from the end of the path when the simulation ends
    speed: float  # m/s, highest value sustained for the limits' patience
    acceleration: float  # m/s², likewise
    angular_velocity: float  # rad/s, likewise

    @property
    def passed(self) -> bool:
        """Return whether the bytes may fly."""
        return not self.reason

    def require_passed(self) -> None:
        """Raise NotCertifiedError if it failed."""
        if self.reason:
            raise NotCertifiedError(self.reason, where="dry run", hint=_HINT)


@dataclass(frozen=True, slots=True)
class DryRun(Rehearsal):
    """The result of a dry run."""

    deviation_rms: float  # m, while it moves
    path_distance: float  # m, largest distance from the path, at any time
    settle_time: float  # s, from the end of the motion until the vehicle stays within SETTLED; inf: never
    saturation: float  # fraction of the time that the most saturated motor is at either end of its range
    real_time_factor: float  # simulated seconds per second
    loop: ClosedLoop  # the whole flight

    def __repr__(self) -> str:
        off = f"{100 * self.deviation:.1f} cm beside its place at most, {100 * self.deviation_rms:.1f} cm rms"
        return f"<DryRun: {self.reason or 'passed'}, {off}>"

    def summary(self) -> dict[str, bool | float | str | None]:
        """Return all figures without the flight itself, for a file; values that are not finite are None, as in JSON."""
        figures = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "loop"}
        return {"passed": self.passed} | {
            name: value if isinstance(value, str) or np.isfinite(value) else None for name, value in figures.items()
        }

    def rows(self) -> list[tuple[str, str]]:
        """Return all figures without the flight itself, as labels and texts."""
        return [
            ("verdict", self.reason or "passed"),
            ("deviation in time", f"{100 * self.deviation:.1f} cm at {self.deviation_time:.2f} s"),
            ("deviation in time, rms", f"{100 * self.deviation_rms:.1f} cm"),
            ("distance to the path", f"{100 * self.path_distance:.1f} cm"),
            ("error at the end", f"{100 * self.final_error:.1f} cm, settled after {self.settle_time:.2f} s"),
            ("speed", f"{self.speed:.2f} m/s"),
            ("acceleration", f"{self.acceleration:.2f} m/s²"),
            ("angular velocity", f"{self.angular_velocity:.2f} rad/s"),
            ("time at a motor's limit", f"{100 * self.saturation:.1f} %"),
            ("faster than real time", f"{self.real_time_factor:.0f} times"),
        ]


def dry_run(
    encoded: EncodedFlight,
    trajectory: Trajectory | JoinedTrajectory,
    airframe: Airframe,
    limits: FlightLimits,
    *,
    conditions: Conditions = AS_PLANNED,
    snapshot: NDArray | None = None,
) -> DryRun:
    """Fly the payloads on `airframe`; compare with `trajectory`.

    `snapshot`, (31,), is the state of another flight, which this one continues instead of starting in hover. The
    real-time factor leaves out compilation.
    """
    start = trajectory.at(0.0)
    begin = hovering(airframe, start.position, float(start.yaw)) if snapshot is None else snapshot
    fly = partial(
        fly_setpoints, decode(encoded.payloads), encoded.times, airframe, begin, conditions=conditions
    )  # fmt: skip
    return fly_and_judge(
        fly, encoded.duration + SETTLING, lambda times: trajectory.at(times).position, trajectory.duration, limits
    )


def rehearse_setpoints(
    payloads: NDArray, airframe: Airframe, limits: FlightLimits, *, snapshot: NDArray, rate: float = RATE
) -> Rehearsal:
    """Fly payloads, (N, 29) uint8 at `rate`, Hz, on from a snapshot, (31,); compare with the places in them.

    Like dry_run(), for a motion that is given by its setpoints alone; only the figures that decide are computed.
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


def fly_and_judge(
    fly: Callable[..., ClosedLoop],
    duration: float,
    wanted_at: Callable[[NDArray], NDArray],
    moving: float,
    limits: FlightLimits,
) -> DryRun:
    """Call fly(duration=…), s; compare with where the vehicle is wanted at times (N,), (N, 3) m, for `moving`, s."""
    fly(duration=0.0)  # compiles if need be; the next line imports
    _distances_to_path(np.zeros((1, 3)), np.zeros((1, 3)))
    begun = time.perf_counter()
    loop = fly(duration=duration)
    run = _judge(loop, wanted_at, moving, limits)
    return replace(run, real_time_factor=loop.time[-1] / (time.perf_counter() - begun))


def _judge(loop: ClosedLoop, wanted_at: Callable[[NDArray], NDArray], duration: float, limits: FlightLimits) -> DryRun:
    times, positions = loop.time[::_STRIDE], loop.position[::_STRIDE]
    wanted = wanted_at(times)
    error = _away(loop, wanted)
    known = np.isfinite(positions).all(axis=1)
    nearest = np.where(known, _distances_to_path(np.where(known[:, None], positions, 0.0), wanted), np.inf)
    moving = times <= duration
    late = np.flatnonzero(~moving & (error > SETTLED))
    settled = times[late[-1]] - duration if len(late) else 0.0
    at_its_end = np.mean((loop.commands <= 0) | (loop.commands >= FULL_COMMAND), axis=0)
    return DryRun(
        **asdict(_rehearsed(loop, error, limits)),
        deviation_rms=float(np.sqrt(np.mean(error[moving] ** 2))),
        path_distance=float(nearest.max()),
        settle_time=float(np.inf if error[-1] > SETTLED else settled),
        saturation=float(at_its_end.max()),
        real_time_factor=np.inf,
        loop=loop,
    )


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
    return float(minimum_filter1d(values, window, mode="nearest").max())  # ends stand for what is not simulated


def _distances_to_path(positions: NDArray, wanted: NDArray) -> NDArray:
    """Return the distance of each position, (N, 3), to the nearest of the wanted ones, (M, 3)."""
    from scipy.spatial import KDTree

    return np.asarray(KDTree(wanted).query(positions)[0])
