"""Fly path files on the virtual Crazyflie in real time, each several times, and measure how far off the plan."""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cfplan.errors import CfplanError, ExitCode
from cfplan.flight.pilot.mission import mission_of
from cfplan.flight.setpoints.encoding import RATE, EncodedFlight, encode_motion, motion_at
from cfplan.flight.setpoints.packets import decode
from cfplan.flight.setpoints.rate_trade import BRAKE_LEAD
from cfplan.geometry.path_file import load_path_file
from cfplan.preparation.plan_flight import PlannedFlight, plan_flight
from cfplan.preparation.prepare_flight import encode_flight, rehearse
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.dry_run import dry_run
from studies.real_time import Conditions, RealTimeFlight, fly_in_real_time
from studies.runner.result import Column, StudyResult, Table, detail_table
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.rotations import hopf_quaternion
from cfplan.vehicle.trajectory import Trajectory

PLAN_COLUMNS = (
    Column("path", "path"),
    Column("length", "length", "m", ".1f"),
    Column("planner", "planner"),
    Column("planned", "planned", "s", ".2f"),
    Column("lower_bound"),
    Column("over_bound", "over bound", "%", ".1f", meaning="planned time over the proven lower bound"),
    Column("speed_factor", "speed kept", "%", ".2f", meaning="by repair, of the planner's speed"),
    Column("worst_share", "worst share", "%", ".2f", meaning="of any limit, by the certificate"),
    Column("dry_run", "dry run", "cm", ".1f", meaning="largest deviation"),
    Column(
        "dry_run_without_drag", "dry run without drag", "cm", ".1f",
        meaning="the same where the acceleration field does not make up for drag",
    ),
)  # fmt: skip
FLIGHT_COLUMNS = (
    Column("path", "path"),
    Column("flights"),
    Column("landed", "landed", of="flights", meaning="at the end of the plan"),
    Column(
        "deviation_mean", "deviation, mean", "cm", ".1f",
        meaning="of each flight's largest distance from the reference in time, by the poses of motion capture",
    ),
    Column("deviation_max", "deviation, max", "cm", ".1f", meaning="the largest of all flights"),
    Column("deviation_rms", "rms", "cm", ".1f"),
    Column("true_mean", "true, mean", "cm", ".1f", meaning="the same by the simulated truth"),
    Column("true_max", "true, max", "cm", ".1f"),
    Column("off_plan", "time off plan", "%", ".2f", meaning="first setpoint to last, against the plan; the worst"),
    Column("settled", "settled, max", "s", ".2f", meaning="after the end of the path; *not*: landing began before"),
    Column("late_p99", "late, p99", "ms", ".2f", meaning="of setpoints, the worst flight's"),
    Column("late_max", "late, max", "ms", ".2f"),
    Column("refusals", "refused", meaning="tries that preflight refused because this computer was late"),
)  # fmt: skip
FAILURE_COLUMNS = (Column("path", "path"), Column("seed", "seed"), Column("reason", "ended"))


@dataclass(frozen=True, slots=True)
class RehearsedPlan:
    """One path as planned and rehearsed."""

    path: str
    length: float  # m
    planner: str
    planned: float  # s
    lower_bound: float  # s
    speed_factor: float  # of repair, on the planner's speed; 1: not slowed
    worst_share: float  # of a limit, by the certificate
    dry_run: float  # m, largest deviation
    dry_run_without_drag: float  # m, the same where the acceleration field does not make up for drag

    def row(self) -> dict[str, Any]:
        """Return it by the keys of PLAN_COLUMNS."""
        return asdict(self) | {"over_bound": self.planned / self.lower_bound - 1}


@dataclass(frozen=True, slots=True)
class JudgedFlight:
    """One flight, or why there was none."""

    path: str
    seed: int
    landed: bool  # at the end of its plan
    reason: str  # how it ended
    refusals: int = 0  # tries before it that preflight refused because this computer was late
    planned: float = 0.0  # s
    streamed: float = 0.0  # s, from the first setpoint to that of the path's end, as sent
    deviation_max: float = 0.0  # m, from the reference in time, by the poses of motion capture
    deviation_rms: float = 0.0  # m
    true_deviation_max: float = 0.0  # m, by the simulated truth
    settled_after: float | None = None  # s; None where it did not settle
    lateness_p99: float = 0.0  # s, of setpoints
    lateness_max: float = 0.0  # s
    telemetry_dropped: int = 0

    @property
    def off_plan(self) -> float:
        """Return by how much the time from the first setpoint to the last differed from the plan, relative."""
        return abs(self.streamed / self.planned - 1)


def fly_each(
    path_files: Sequence[Path],
    find_safety_file: Callable[[Path], Path],
    *,
    repeats: int = 1,
    conditions: Conditions | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> StudyResult:
    """Fly each path `repeats` times, with a seed for each. A failure is a row; an interrupt keeps what was flown.

    Raises InputError, before anything flies, where a file is no path.
    """
    for file in path_files:
        load_path_file(file)
    conditions = conditions or Conditions()
    plans: list[RehearsedPlan] = []
    flights: list[JudgedFlight] = []
    total, lag, interrupted = repeats * len(path_files), 0.0, False
    try:
        for index, file in enumerate(path_files):
            progress(index * repeats, total)
            try:
                planned = plan_flight(file, load_limits(find_safety_file(file)))
                encoded = encode_flight(planned)
                plans.append(_rehearsed(file.stem, planned, encoded))
            except CfplanError as error:
                flights.append(JudgedFlight(file.stem, conditions.seed, landed=False, reason=str(error)))
                continue
            mission, lag = mission_of(encoded, planned.limits), planned.plan.airframe.motor_time_constant
            for number in range(repeats):
                progress(index * repeats + number, total)
                lab = replace(conditions, seed=conditions.seed + number)
                flight = fly_in_real_time(mission, lab, name=file.stem)
                flights.append(_judged(file.stem, lab.seed, planned.plan.trajectory, flight))
                if flight.outcome is not None and flight.outcome.exit_code is ExitCode.ENDED_BY_OPERATOR:
                    raise KeyboardInterrupt
        progress(total, total)
    except KeyboardInterrupt:
        interrupted = True
    settings = {"repeats": repeats, "conditions": asdict(conditions), "motor_lag": lag}
    tables = flight_tables(plans, flights, conditions, lag)
    return StudyResult("flights", settings, tables, (detail_table("flights", flights),), interrupted)


def flight_tables(
    plans: Sequence[RehearsedPlan], flights: Sequence[JudgedFlight], lab: Conditions, motor_lag: float
) -> tuple[Table, ...]:
    """Return the plans, the flights by path and all together, and those that failed where there are any."""
    title = (
        f"Flights: deviation from the reference in time, {100 * lab.loss:g} % of radio packets lost, "
        f"{1e3 * lab.pose_noise:g} mm of pose noise{' by Vicon' if lab.vicon else ''}, motor lag {motor_lag:g} s"
    )
    paths = dict.fromkeys(flight.path for flight in flights)
    rows = [*(_row(path, [f for f in flights if f.path == path]) for path in paths), _row("all", flights)]
    failed = tuple(asdict(flight) for flight in flights if not flight.landed)
    return (
        Table("plans", "Plans", PLAN_COLUMNS, tuple(plan.row() for plan in plans)),
        Table("flights-by-path", title, FLIGHT_COLUMNS, tuple(rows)),
        *([Table("not-landed", "Not landed", FAILURE_COLUMNS, failed)] if failed else []),
    )


def _rehearsed(name: str, planned: PlannedFlight, encoded: EncodedFlight) -> RehearsedPlan:
    plan = planned.plan
    without_drag = dry_run(_without_drag(encoded, plan.trajectory), plan.trajectory, plan.airframe, plan.limits.flight)
    return RehearsedPlan(
        path=name,
        length=plan.path.length,
        planner=plan.planner,
        planned=plan.trajectory.duration,
        lower_bound=planned.lower_bound(),
        speed_factor=plan.repair_speed_factor,
        worst_share=plan.certificate.worst.share,
        dry_run=rehearse(planned, encoded).deviation,
        dry_run_without_drag=without_drag.deviation,
    )


def _without_drag(encoded: EncodedFlight, trajectory: Trajectory) -> EncodedFlight:
    """Return the same flight with the acceleration of the motion alone, and the attitude that leans for just that."""
    times = encoded.times + encoded.lead
    states = trajectory.at(times)
    thrust = states.acceleration + np.array([0.0, 0.0, GRAVITY])
    axis = (thrust / np.linalg.norm(thrust, axis=1)[:, None]).T
    quaternion = np.stack(
        hopf_quaternion((axis[0], axis[1], axis[2]), np.cos(states.yaw / 2), np.sin(states.yaw / 2)), 1
    )
    motion = replace(motion_at(trajectory, times), acceleration=states.acceleration, quaternion=quaternion)
    payloads = encode_motion(motion, trajectory.at(times + BRAKE_LEAD).acceleration, encoded.gains, space=encoded.space)
    return replace(encoded, payloads=payloads, decoded=decode(payloads))


def _judged(name: str, seed: int, trajectory: Trajectory, flight: RealTimeFlight) -> JudgedFlight:
    outcome, truth = flight.outcome, flight.truth
    if not flight.landed or outcome is None or truth is None:
        return JudgedFlight(name, seed, landed=False, reason=flight.reason, refusals=flight.refusals)
    elapsed = truth.time - outcome.first_setpoint
    moving = (elapsed >= 0) & (elapsed <= trajectory.duration)
    off = np.linalg.norm(truth.position[moving] - trajectory.at(elapsed[moving]).position, axis=1)
    return JudgedFlight(
        path=name,
        seed=seed,
        landed=True,
        reason=flight.reason,
        refusals=flight.refusals,
        planned=trajectory.duration,
        streamed=flight.time_to(math.ceil(trajectory.duration * RATE)),
        deviation_max=outcome.deviation.max,
        deviation_rms=outcome.deviation.rms,
        true_deviation_max=float(off.max()),
        settled_after=outcome.settled_after if np.isfinite(outcome.settled_after) else None,
        lateness_p99=outcome.lateness.p99,
        lateness_max=outcome.lateness.max,
        telemetry_dropped=outcome.telemetry_dropped,
    )


def _row(path: str, flights: Sequence[JudgedFlight]) -> dict[str, Any]:
    """Return the figures of one path's flights, or of all, by the keys of FLIGHT_COLUMNS."""
    landed = [flight for flight in flights if flight.landed]
    counts = {
        "path": path,
        "flights": len(flights),
        "landed": len(landed),
        "refusals": sum(flight.refusals for flight in flights),
    }
    if not landed:
        return dict.fromkeys((column.key for column in FLIGHT_COLUMNS), np.nan) | counts
    settled = [math.inf if f.settled_after is None else f.settled_after for f in landed]
    return counts | {
        "deviation_mean": np.mean([f.deviation_max for f in landed]),
        "deviation_max": max(f.deviation_max for f in landed),
        "deviation_rms": np.sqrt(np.mean([f.deviation_rms**2 for f in landed])),
        "true_mean": np.mean([f.true_deviation_max for f in landed]),
        "true_max": max(f.true_deviation_max for f in landed),
        "off_plan": max(f.off_plan for f in landed),
        "settled": max(settled) if math.isfinite(max(settled)) else "not",
        "late_p99": max(f.lateness_p99 for f in landed),
        "late_max": max(f.lateness_max for f in landed),
    }
