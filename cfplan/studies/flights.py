"""Path files flown on the virtual Crazyflie in real time, each several times, and how far from the plan they came."""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cfplan.errors import CfplanError, ExitCode
from cfplan.flight.setpoints.encoding import RATE, EncodedFlight
from cfplan.flight.setpoints.packets import encode
from cfplan.geometry.path_file import load_path_file
from cfplan.planners.baselines.convex import lower_bound
from cfplan.planners.task import PlanningTask
from cfplan.simulation.dry_run import dry_run
from cfplan.studies.machine import Machine, this_machine
from cfplan.studies.missions import PlannedMission, planned_mission
from cfplan.studies.real_time import Conditions, Flight, fly_in_real_time

PLANS = (
    "path", "length", "planner", "planned", "over bound", "speed kept", "worst share", "dry run",
    "dry run without drag",
)  # fmt: skip
FLIGHTS = (
    "path", "landed", "deviation, mean", "max", "rms", "true, mean", "true, max", "time off plan", "settled, max",
    "late p99", "late max", "refused",
)  # fmt: skip
FAILURES = ("path", "seed", "ended")


@dataclass(frozen=True, slots=True)
class Planned:
    """One path as planned and rehearsed."""

    path: str
    length: float
    # m
    planner: str
    planned: float
    # s
    lower_bound: float
    # s
    speed_factor: float  # of repair, on the planner's speed; 1: not slowed
    worst_share: float
    # of a limit, by the certificate
    dry_run: float
    # m, deviation at most
    dry_run_without_drag: float
    # m, the same where the acceleration field does not carry what makes up for drag

    def texts(self) -> list[str]:
        """As PLANS has it."""
        return [
            self.path, f"{self.length:.1f} m", self.planner, f"{self.planned:.2f} s",
            f"{100 * (self.planned / self.lower_bound - 1):.1f} %", f"{100 * self.speed_factor:.2f} %",
            f"{100 * self.worst_share:.2f} %", _cm(self.dry_run), _cm(self.dry_run_without_drag),
        ]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Flown:
    """One flight, or why there was none."""

    path: str
    seed: int
    landed: bool
    # at the end of its plan
    reason: str
    # how it ended
    refusals: int = 0
    # tries before it that preflight refused because this computer was late
    planned: float = 0.0
    # s
    streamed: float = 0.0
    # s, from the first setpoint to that of the path's end, as sent
    deviation_max: float = 0.0
    # m, from the reference in time, by the poses of motion capture
    deviation_rms: float = 0.0
    # m
    true_deviation_max: float = 0.0
    # m, by the simulated truth
    settled_after: float | None = None
    # s; None where it did not settle
    lateness_p99: float = 0.0
    # s, of setpoints
    lateness_max: float = 0.0
    # s
    telemetry_dropped: int = 0

    @property
    def off_plan(self) -> float:
        """By how much the time from the first setpoint to the last was another than planned, relative."""
        return abs(self.streamed / self.planned - 1)


@dataclass(frozen=True, slots=True)
class Flights:
    """A whole run."""

    command: str
    machine: Machine
    conditions: Conditions
    # with the seed of the first flight of each path
    motor_lag: float
    # s
    interrupted: bool
    plans: tuple[Planned, ...]
    flights: tuple[Flown, ...]

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self) | {"table": [dict(zip(FLIGHTS, row, strict=True)) for row in self._rows()]}

    def tables(self) -> list[tuple[str, list[str], list[list[str]]]]:
        """Title, columns and rows: the plans, the flights by path and all together, and what failed."""
        lab = self.conditions
        title = (
            f"Flights: deviation from the reference in time, {100 * lab.loss:g} % of radio packets lost, "
            f"{1e3 * lab.pose_noise:g} mm of pose noise{' by Vicon' if lab.vicon else ''}, "
            f"motor lag {self.motor_lag:g} s"
        )
        failed = [[f.path, str(f.seed), f.reason] for f in self.flights if not f.landed]
        return [
            ("Plans", list(PLANS), [plan.texts() for plan in self.plans]),
            (title, list(FLIGHTS), self._rows()),
            *([("Not landed", list(FAILURES), failed)] if failed else []),
        ]

    def _rows(self) -> list[list[str]]:
        names = dict.fromkeys(flight.path for flight in self.flights)
        rows = [_texts(name, [f for f in self.flights if f.path == name]) for name in names]
        return [*rows, _texts("all", self.flights)]


def fly_each(
    path_files: Sequence[Path],
    find_safety_file: Callable[[Path], Path],
    *,
    repeats: int = 1,
    conditions: Conditions | None = None,
    command: str = "",
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Flights:
    """Fly each `repeats` times, with a seed for each. What fails is a row; an interrupt keeps what was flown.

    Raises InputError, before anything flies, where a file is no path.
    """
    for file in path_files:
        load_path_file(file)
    conditions = conditions or Conditions()
    plans: list[Planned] = []
    flights: list[Flown] = []
    total, lag, interrupted = repeats * len(path_files), 0.0, False
    try:
        for index, file in enumerate(path_files):
            progress(index * repeats, total)
            try:
                made = planned_mission(file, find_safety_file(file))
                plans.append(_rehearsed(file.stem, made))
            except CfplanError as error:
                flights.append(Flown(file.stem, conditions.seed, landed=False, reason=str(error)))
                continue
            lag = made.plan.airframe.motor_time_constant
            for number in range(repeats):
                progress(index * repeats + number, total)
                lab = replace(conditions, seed=conditions.seed + number)
                flight = fly_in_real_time(made.mission, lab, name=file.stem)
                flights.append(_judged(file.stem, lab.seed, made, flight))
                if flight.outcome is not None and flight.outcome.exit_code is ExitCode.ENDED_BY_PILOT:
                    raise KeyboardInterrupt
        progress(total, total)
    except KeyboardInterrupt:
        interrupted = True
    return Flights(command, this_machine(), conditions, lag, interrupted, tuple(plans), tuple(flights))


def _rehearsed(name: str, made: PlannedMission) -> Planned:
    plan, encoded = made.plan, made.encoded
    rehearsal = dry_run(encoded, plan.trajectory, plan.airframe, plan.limits.flight)
    rehearsal.require_passed()
    return Planned(
        path=name,
        length=plan.path.length,
        planner=plan.planner,
        planned=plan.trajectory.duration,
        lower_bound=plan.lower_bound or lower_bound(PlanningTask(plan.path, plan.airframe, plan.limits.plan)),
        speed_factor=plan.repair_speed_factor,
        worst_share=plan.certificate.worst.share,
        dry_run=rehearsal.deviation,
        dry_run_without_drag=dry_run(_without_drag(made), plan.trajectory, plan.airframe, plan.limits.flight).deviation,
    )


def _without_drag(made: PlannedMission) -> EncodedFlight:
    """The same flight, but the acceleration is that of the motion alone."""
    states = made.plan.trajectory.at(made.encoded.times + made.encoded.lead)
    told = replace(made.encoded.decoded, acceleration=states.acceleration)
    return replace(made.encoded, payloads=encode(told), decoded=told)


def _judged(name: str, seed: int, made: PlannedMission, flight: Flight) -> Flown:
    outcome, truth, trajectory = flight.outcome, flight.truth, made.plan.trajectory
    if not flight.landed or outcome is None or truth is None:
        return Flown(name, seed, landed=False, reason=flight.reason, refusals=flight.refusals)
    elapsed = truth.time - outcome.first_setpoint
    moving = (elapsed >= 0) & (elapsed <= trajectory.duration)
    off = np.linalg.norm(truth.position[moving] - trajectory.at(elapsed[moving]).position, axis=1)
    return Flown(
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


def _texts(name: str, flights: Sequence[Flown]) -> list[str]:
    """Of those of one path, or of all, as FLIGHTS has it."""
    landed = [flight for flight in flights if flight.landed]
    refused = str(sum(flight.refusals for flight in flights))
    if not landed:
        return [name, f"0 of {len(flights)}", *["–"] * (len(FLIGHTS) - 3), refused]
    worst, true = [f.deviation_max for f in landed], [f.true_deviation_max for f in landed]
    settled = [f.settled_after for f in landed]
    return [
        name, f"{len(landed)} of {len(flights)}", _cm(np.mean(worst)), _cm(max(worst)),
        _cm(np.sqrt(np.mean([f.deviation_rms**2 for f in landed]))), _cm(np.mean(true)), _cm(max(true)),
        f"{100 * max(f.off_plan for f in landed):.2f} %",
        "not" if None in settled else f"{max(s for s in settled if s is not None):.2f} s",
        f"{1e3 * max(f.lateness_p99 for f in landed):.2f} ms", f"{1e3 * max(f.lateness_max for f in landed):.2f} ms",
        refused,
    ]  # fmt: skip


def _cm(metres: float | np.floating) -> str:
    return f"{100 * metres:.1f} cm"
