"""Fly every PATH on the virtual Crazyflie, in real time or stepped, each flight with a different noise seed.

Measures the deviation from the plan, by the poses and by the simulated truth, and how late setpoints are sent.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cfplan.errors import CfplanError, ExitCode
from cfplan.flight.pilot.mission import Mission, mission_of
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.setpoints.encoding import LEAD, RATE, EncodedFlight, encode_motion, motion_at
from cfplan.flight.setpoints.level_out import BRAKE_LEAD
from cfplan.flight.setpoints.packets import decode
from cfplan.flight.telemetry import Phase, PhaseEntered, SetpointSent, Telemetry
from cfplan.geometry.path_file import load_path_file
from cfplan.preparation.plan_flight import plan_flight
from cfplan.preparation.prepare_flight import encode_flight, rehearse
from cfplan.simulation.draws import draw_vehicles
from cfplan.simulation.dry_run import dry_run
from cfplan.simulation.lab.radio import RadioFault, RadioFaultKind
from cfplan.simulation.lab.stepped_lab import SteppedLab
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_vicon.cameras import ViconSettings
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.rotations import hopf_quaternion
from cfplan.vehicle.trajectory import Trajectory
from studies.real_time import Conditions, RealTimeFlight, fly_in_real_time
from studies.runner.limits import limits_for
from studies.runner.options import argument, option
from studies.runner.reductions import count, largest, mean, rms, total
from studies.runner.result import Column, Table, table
from studies.runner.study import Run, Study, Work
from studies.stepped_flight import Scenario, fly_stepped

_DRAWN_BY = 7  # seed of the vehicles: others than those of dry runs
PLAN_COLUMNS = (
    Column("path", "path"),
    Column("length", "length", "m", ".1f"),
    Column("planner", "planner"),
    Column("planned", "planned", "s", ".2f"),
    Column("lower_bound"),
    Column("over_bound", "over bound", "%", ".1f", meaning="planned time over the proven lower bound"),
    Column("speed_factor", "speed kept", "%", ".2f", meaning="by repair, of the planner's speed"),
    Column("worst_usage", "largest usage", "%", ".2f", meaning="of any limit, by the certificate",
           value=largest("worst_usage")),
    Column("dry_run", "dry run", "cm", ".1f", meaning="largest deviation, 95th percentile of drawn vehicles"),
    Column(
        "dry_run_without_drag", "dry run without drag", "cm", ".1f",
        meaning="the same where the acceleration field does not make up for drag",
    ),
)  # fmt: skip
FLIGHT_COLUMNS = (
    Column("path", "path"),
    Column("flights", value=count()),
    Column("landed", "landed", of="flights", meaning="at the end of the plan", value=count("landed")),
    Column(
        "deviation_mean", "deviation, mean", "cm", ".1f", value=mean("deviation_max"),
        meaning="of each flight's largest distance from the reference in time, by the poses of motion capture",
    ),
    Column(
        "deviation_max", "deviation, max", "cm", ".1f", meaning="the largest of all flights",
        value=largest("deviation_max"),
    ),
    Column("deviation_rms", "rms", "cm", ".1f", value=rms("deviation_rms")),
    Column(
        "true_mean", "true, mean", "cm", ".1f", meaning="the same by the simulated truth",
        value=mean("true_deviation_max"),
    ),
    Column("true_max", "true, max", "cm", ".1f", value=largest("true_deviation_max")),
    Column("within", "within the dry run's 95 %", of="landed", value=count("within"),
           meaning="flights whose largest true deviation the dry run's 95th percentile covers"),
    Column(
        "off_plan", "time off plan", "%", ".2f", value=largest("off_plan"),
        meaning="first setpoint to last, against the plan; the worst",
    ),
    Column(
        "settled", "settled, max", "s", ".2f", value=lambda rows: _settled(rows),
        meaning="after the end of the path; *not*: landing began before",
    ),
    Column("late_p99", "late, p99", "ms", ".2f", meaning="of setpoints, the worst flight's", value=largest("late_p99")),
    Column("late_max", "late, max", "ms", ".2f", value=largest("late_max")),
    Column(
        "refusals", "refused", format=".0f", value=total("refusals"),
        meaning="tries that preflight refused because this computer was late",
    ),
)  # fmt: skip
FAILURE_COLUMNS = (Column("path", "path"), Column("seed", "seed"), Column("reason", "ended"))


@dataclass(frozen=True, slots=True)
class Settings:
    """Paths, repeats and conditions of the lab."""

    path_files: tuple[Path, ...] = argument()
    repeats: int = option(1, "Flights of each path.", least=1)
    loss: float = option(0.0, "Fraction of the radio's packets that is lost.", least=0)
    pose_noise: float = option(0.001, "Standard deviation of poses on each axis, m.", least=0)
    drawn: bool = option(False, "Each flight on another vehicle, drawn by the spread of the airframe.")
    seed: int = option(0, "Seed of the noise of each path's first flight.", least=0)
    stepped: bool = option(False, "Fly on a clock that runs only while the pilot sleeps, whatever the computer's load.")


@dataclass(frozen=True, slots=True)
class JudgedFlight:
    """One flight with its plan, or the reason why there was none; NaN where nothing was measured."""

    path: str
    seed: int
    reason: str  # how it ended
    landed: bool = False  # at the end of its plan
    length: float = math.nan  # m
    planner: str = ""
    planned: float = math.nan  # s
    lower_bound: float = math.nan  # s
    speed_factor: float = math.nan  # of repair, on the planner's speed; 1: not slowed down
    worst_usage: float = math.nan  # largest usage of any limit, by the certificate
    dry_run: float = math.nan  # m, largest deviation, 95th percentile of the draws
    dry_run_without_drag: float = math.nan  # m, the same without drag compensation in the acceleration field
    motor_lag: float = math.nan  # s, the plan's
    refusals: int = 0  # earlier attempts that preflight refused only because this computer was late
    streamed: float = math.nan  # s, from sending the first setpoint to sending that of the path's end
    deviation_max: float = math.nan  # m, from the reference in time, by the poses of motion capture
    deviation_rms: float = math.nan  # m
    true_deviation_max: float = math.nan  # m, by the simulated truth
    settled_after: float = math.nan  # s; not finite if it did not settle
    late_p99: float = math.nan  # s, of setpoints
    late_max: float = math.nan  # s

    @property
    def over_bound(self) -> float:
        """Return the planned time over the lower bound, as a relative excess."""
        return self.planned / self.lower_bound - 1

    @property
    def within(self) -> bool:
        """Return whether the dry run's 95th percentile covers the largest true deviation."""
        return self.true_deviation_max <= self.dry_run

    @property
    def off_plan(self) -> float:
        """Return the relative difference between streamed and planned time."""
        return abs(self.streamed / self.planned - 1)


class Prepared(NamedTuple):
    """One path ready to be flown, or a row with the reason why it is not."""

    row: JudgedFlight
    mission: Mission | None = None
    trajectory: Trajectory | None = None


def work(settings: Settings, run: Run, *, fly: Callable[..., RealTimeFlight] | None = None) -> Work:
    """Return one case per flight: each path `repeats` times, each with its own seed. A failure is a row.

    Raises InputError, before anything is planned, if a file is not a path file or a condition is out of range.
    """
    fly = fly or (fly_on_stepped_clock if settings.stepped else fly_in_real_time)
    lab = Conditions(settings.loss, settings.pose_noise, settings.seed)
    for file in settings.path_files:
        load_path_file(file)
    cases: dict[str, tuple[int, int, Prepared]] = {}
    for number, file in enumerate(settings.path_files):
        run.progress(number, len(settings.path_files))
        prepared = _prepared(file, settings.seed)
        for k in range(settings.repeats if prepared.mission else 1):
            cases[f"{file.stem} {lab.seed + k}"] = lab.seed + k, len(cases), prepared

    def measure(case: tuple[int, int, Prepared]) -> JudgedFlight:
        seed, number, (row, mission, trajectory) = case
        if mission is None or trajectory is None:
            return row
        vehicle = None
        if settings.drawn:
            limits = mission.limits
            vehicle = draw_vehicles(limits.airframe, limits.pose, len(cases), _DRAWN_BY)[number].airframe
        flight = fly(mission, replace(lab, seed=seed, airframe=vehicle), name=row.path)
        if flight.outcome is not None and flight.outcome.exit_code is ExitCode.ENDED_BY_OPERATOR:
            raise KeyboardInterrupt  # the operator's stop ends the study too
        return _judged(replace(row, seed=seed), trajectory, flight)

    return Work(cases, measure, JudgedFlight)


def tables(settings: Settings, rows: list[JudgedFlight]) -> Iterator[Table]:
    """Yield the plans, the flights by path and in total, and the failed flights if there are any."""
    planned, failed = [row for row in rows if row.planner], [row for row in rows if not row.landed]
    lag = planned[-1].motor_lag if planned else math.nan
    title = (
        f"Flights: deviation from the reference in time, {100 * settings.loss:g} % of radio packets lost, "
        f"{1e3 * settings.pose_noise:g} mm of pose noise, motor lag {lag:g} s"
        f"{', each on a vehicle drawn by the spread of the airframe' if settings.drawn else ''}"
    )
    yield table("plans", "Plans", PLAN_COLUMNS, planned, by=("path",))
    yield table("flights-by-path", title, FLIGHT_COLUMNS, rows, by=("path",), last="all")
    if failed:
        yield table("not-landed", "Not landed", FAILURE_COLUMNS, failed)


def _settled(rows: Sequence[JudgedFlight]) -> float | str:
    times = [row.settled_after for row in rows if row.landed]
    return "not" if any(map(math.isinf, times)) else max(times, default=math.nan)


def _prepared(file: Path, seed: int) -> Prepared:
    try:
        planned = plan_flight(file, limits_for(file))
        encoded = encode_flight(planned)
        plan = planned.plan
        bare = without_drag(encoded, plan.trajectory)
        row = JudgedFlight(
            path=file.stem,
            seed=seed,
            reason="",
            length=plan.path.length,
            planner=plan.planner,
            planned=plan.trajectory.duration,
            lower_bound=planned.lower_bound(),
            speed_factor=plan.repair_speed_factor,
            worst_usage=plan.certificate.worst.share,
            dry_run=rehearse(planned, encoded).deviation,
            dry_run_without_drag=dry_run(bare, plan.trajectory, planned.limits).deviation,
            motor_lag=plan.airframe.motor_time_constant,
        )
        return Prepared(row, mission_of(encoded, planned.limits), plan.trajectory)
    except CfplanError as error:
        return Prepared(JudgedFlight(file.stem, seed, str(error)))


def without_drag(encoded: EncodedFlight, trajectory: Trajectory) -> EncodedFlight:
    """Return the same flight with accelerations and attitudes of the motion alone, without drag compensation."""
    times = encoded.times + LEAD
    states = trajectory.at(times)
    thrust = states.acceleration + np.array([0.0, 0.0, GRAVITY])
    axis = (thrust / np.linalg.norm(thrust, axis=1)[:, None]).T
    quaternion = np.stack(
        hopf_quaternion((axis[0], axis[1], axis[2]), np.cos(states.yaw / 2), np.sin(states.yaw / 2)), 1
    )
    motion = replace(motion_at(trajectory, times), acceleration=states.acceleration, quaternion=quaternion)
    payloads = encode_motion(motion, trajectory.at(times + BRAKE_LEAD).acceleration, encoded.gains, space=encoded.space)
    return replace(encoded, payloads=payloads, decoded=decode(payloads))


def fly_on_stepped_clock(mission: Mission, conditions: Conditions, *, name: str) -> RealTimeFlight:
    """Fly a mission in the stepped lab. Setpoints are never late there."""
    flight, streaming = RealTimeFlight(None, ""), False

    def hear(message: Telemetry) -> None:
        nonlocal streaming
        if isinstance(message, PhaseEntered):
            streaming = message.phase is Phase.STREAM
        elif isinstance(message, SetpointSent) and streaming:
            flight.sent.append(message)

    seed = conditions.seed
    lab = SteppedLab(
        conditions.airframe or mission.limits.airframe,
        vehicle=VehicleSettings(seed=seed),
        cameras=ViconSettings(position_noise=conditions.pose_noise, seed=seed),
        seed=seed,
    )
    if conditions.loss:
        lab.disturb(RadioFault(RadioFaultKind.LOSS, size=conditions.loss))
    flown = fly_stepped(Scenario(name, Rung.NONE), mission, listen=hear, lab=lab)
    flight.outcome, flight.reason, flight.truth = flown.outcome, flown.reason, flown.truth
    return flight


def _judged(row: JudgedFlight, trajectory: Trajectory, flight: RealTimeFlight) -> JudgedFlight:
    outcome, truth = flight.outcome, flight.truth
    row = replace(row, reason=flight.reason, refusals=flight.refusals)
    if not flight.landed or outcome is None or truth is None:
        return row
    elapsed = truth.time - outcome.first_setpoint
    moving = (elapsed >= 0) & (elapsed <= trajectory.duration)
    off = np.linalg.norm(truth.position[moving] - trajectory.at(elapsed[moving]).position, axis=1)
    return replace(
        row,
        landed=True,
        streamed=flight.time_to(math.ceil(trajectory.duration * RATE)),
        deviation_max=outcome.deviation.max,
        deviation_rms=outcome.deviation.rms,
        true_deviation_max=float(off.max()),
        settled_after=outcome.settled_after,
        late_p99=outcome.lateness.p99,
        late_max=outcome.lateness.max,
    )


STUDY = Study(
    Settings,
    work,
    tables,
    "flights/*.yaml --repeats 5 --loss 0.05 --drawn -o results/flights.json",
    one_at_a_time=True,
)
