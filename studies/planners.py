"""Compare planners on the same paths: time to certificate and to setpoints, time of flight, and the dry run.

Workloads: `random` paths in two boxes under two sets of limits; `lengths`, paths of 1 to 100 times the usual length;
`drawn`, limits and vehicles drawn at random, within and outside the shipped network's training distribution; `hard`,
adversarial paths under limits 0.01 to 10 times those of safety.yaml, planned by `auto` within its budget.

All planners plan a path before the next one begins, in reverse order on every other path, so that other load and
processor caches affect all alike. Times are processor time; each planner is warmed up before it is timed.
"""

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cache, partial
from pathlib import Path as File
from typing import Any

import numpy as np

from cfplan.deadline import Deadline
from cfplan.errors import CfplanError, NotCertifiedError
from cfplan.flight.setpoints.byte_check import check_bytes
from cfplan.flight.setpoints.encoding import encode_trajectory
from cfplan.geometry.path import Path
from cfplan.geometry.yaw import YawMode
from cfplan.learning.model_files import find_model
from cfplan.planners.baselines.convex import lower_bound
from cfplan.planners.task import PlanningTask
from cfplan.planning.plan import default_budget, plan
from cfplan.planning.planners import AUTO, PLANNERS, default_nodes, find_planner
from cfplan.planning.repair import refine, repair, slow
from cfplan.safety.certificate import certify
from cfplan.safety.limit_sets import BOXES, LIMIT_SETS, LimitSet
from cfplan.safety.limits import Limits
from cfplan.safety.limits_file import load_limits
from cfplan.safety.space import Space
from cfplan.simulation.dry_run import rehearse_motion
from cfplan.simulation.geometric_flight import LOST
from cfplan.vehicle.trajectory import Trajectory
from cfplan.version import REPOSITORY
from studies.adversarial_paths import FAMILIES, adversarial_path
from studies.drawn_limits import GROUPS, draw_case
from studies.drawn_paths import path_of_length, random_path
from studies.runner.limits import lost_alone
from studies.runner.machine import process_memory
from studies.runner.options import option
from studies.runner.reductions import count, farthest, largest, mean, median, quantile
from studies.runner.result import Column, Table, quantile_columns, table
from studies.runner.study import Run, Study, Work

LENGTHS = (20.0, 40.0, 100.0, 200.0, 400.0, 1000.0, 2000.0)  # m, 1 to 100 times the mean of the paper's paths
EXPERT, TOPPQUAD = "expert", "toppquad"
FLOWN = ("learned", EXPERT)  # planners whose setpoints are encoded and rehearsed
REFINED = ("learned", "convex")  # planners whose profiles are refined to the optimum
PATIENCE = 5.0  # multiple of the budget after which planning counts as hanging
ENDURANCE, ROOM = 1e6, 3000.0  # s of battery life and m of room to each side, for hard paths


class Workload(StrEnum):
    """The groups of paths to plan."""

    RANDOM = "random"
    LENGTHS = "lengths"
    DRAWN = "drawn"
    HARD = "hard"


class Answer(StrEnum):
    """The outcome of planning a path."""

    CERTIFIED = "certified"
    REFUSED = "refused"  # with a reason and a hint
    FAILED = "failed"  # an error without a hint, or no certificate
    HANGS = "hangs"


@dataclass(frozen=True, slots=True)
class Settings:
    """The paths to plan, and the planners."""

    workload: Workload = option(Workload.RANDOM, "Which paths.")
    paths: int = option(100, "Paths of each group.", least=1)
    planners: tuple[str, ...] = option(("learned", "expert", "toppquad", "convex", "minsnap"), "Planner.",
                                       choices=(*PLANNERS, AUTO))  # fmt: skip
    boxes: tuple[str, ...] = option(tuple(BOXES), "Box of random paths, m.", choices=tuple(BOXES))
    limits: tuple[str, ...] = option(tuple(LIMIT_SETS), "Set of limits.", choices=tuple(LIMIT_SETS))
    speeds: tuple[float, ...] = option((), "Limit on speed, m/s, instead of the set's.", least=0.01)
    lengths: tuple[float, ...] = option(LENGTHS, "Length of paths, m, of the workload `lengths`.", least=10.0)
    nodes: int = option(100, "Grid intervals of random paths; those of `lengths` follow the length.", least=12)
    yaw: YawMode = option(YawMode.FIXED, "Yaw of random paths.")
    first_seed: int = option(20_000, "Seed of the first path.", least=0)


@dataclass(frozen=True, slots=True)
class Case:
    """One path with its limits, to be planned by each planner."""

    group: str
    seed: int
    path: Path
    chosen: LimitSet
    nodes: int
    yaw: YawMode = YawMode.FIXED
    yaw_angle: float = 0.0  # rad
    planners: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Trial:
    """One planner's plan of one path. NaN where there was nothing to measure."""

    group: str
    seed: int
    planner: str
    length: float  # m
    nodes: int
    answer: str = Answer.FAILED
    reason: str = ""  # why there is no certified flight; empty if there is one
    plan_seconds: float = np.nan  # s, of the planner's call
    solve_seconds: float = np.nan  # s, of its solver alone, as the solver reports
    finish_seconds: float = np.nan  # s, to refine, repair and certify
    encode_seconds: float = np.nan  # s, to encode and certify the setpoints
    worst_usage: float = np.nan  # largest usage of any limit on the dense grid, before repair
    planned_time: float = np.nan  # s of flight, before repair
    certified_time: float = np.nan  # s of flight
    speed_factor: float = np.nan  # by which the entire flight was slowed down; 1: not at all
    bound: float = np.nan  # s, lower bound of any flight within speed, acceleration and collective thrust
    memory: float = np.nan  # MB, largest growth of the process
    budget: float = np.nan  # s for planning
    left_out: str = ""  # steps left out for lack of time
    bytes_refused: str = ""  # why its setpoints were refused; empty if they were not
    deviation: float = np.nan  # m, in the dry run
    dry_run: str = ""  # why the dry run failed; empty if it passed
    expert_time: float = np.nan  # s, the expert's certified flight along the same path
    expert_seconds: float = np.nan  # s of processor time, to the expert's certificate
    toppquad_seconds: float = np.nan  # s, of TOPPQuad's solver alone

    @property
    def seconds(self) -> float:
        """Return the processor time, s, from the path to the certified trajectory."""
        return self.plan_seconds + self.finish_seconds

    @property
    def certified(self) -> bool:
        """Return whether there is a certified flight."""
        return self.answer == Answer.CERTIFIED

    @property
    def against_expert(self) -> float:
        """Return the certified time over the expert's, as a relative excess."""
        return self.certified_time / self.expert_time - 1.0

    @property
    def flown(self) -> bool:
        """Return whether there was a dry run."""
        return bool(np.isfinite(self.deviation) or self.dry_run)


TIME_COLUMNS = (
    Column("group", "paths"),
    Column("planner", "planner"),
    Column("paths", "", value=count()),
    Column("length", "length", "m", ".0f", meaning="mean", value=mean("length")),
    Column("nodes", "nodes", "", ".0f", value=mean("nodes")),
    *quantile_columns("plan_seconds", "plan", "ms", ".1f", shown=("median",), meaning="the planner's call"),
    *quantile_columns("seconds", "to certificate", "ms", ".1f", meaning="from the path to the certified trajectory"),
    *quantile_columns("to_setpoints", "to setpoints", "ms", ".1f", lambda row: row.seconds + row.encode_seconds,
                      meaning="the same and encoding, with its certificate"),
    Column("per_metre", "to certificate, per metre", "ms", ".2f", meaning="median",
           value=median(lambda row: row.seconds / row.length)),
    Column("speed_up", "expert's time over it", "×", ".2f", meaning="to the certificate, path by path, median",
           value=median(lambda row: row.expert_seconds / row.seconds)),
    Column("speed_up_toppquad", "TOPPQuad's solver over it", "×", ".1f", meaning="likewise",
           value=median(lambda row: row.toppquad_seconds / row.seconds)),
    Column("memory", "memory", "MB", ".0f", meaning="by which the process grew, at most", value=largest("memory")),
)  # fmt: skip
FLIGHT_COLUMNS = (
    Column("group", "paths"),
    Column("planner", "planner"),
    Column("paths", "", value=count()),
    Column("certified", "certified", of="paths", value=count("certified")),
    Column("as_planned", "as planned", of="paths", meaning="passed the dense certificate without repair",
           value=count(lambda row: row.worst_usage <= 1.0)),
    Column("slowed", "slowed as a whole", of="paths", value=count(lambda row: row.speed_factor < 1.0)),
    Column("worst_usage", "worst usage", "%", ".2f", meaning="of any limit, before repair",
        value=largest("worst_usage")),
    Column("planned_off", "as planned, off the expert", "%", ".2f", meaning="travel time before repair, mean absolute",
           value=mean(lambda row: abs(row.planned_time / row.expert_time - 1.0))),
    Column("flight", "flight", "s", ".3f", meaning="certified travel time, median", value=median("certified_time")),
    Column("against_mean", "against expert, mean", "%", "+.3f", meaning="certified travel time",
           value=mean("against_expert")),
    Column("against_p95", "against expert, p95", "%", "+.3f", value=quantile("against_expert", 0.95)),
    Column("against_max", "against expert, most", "%", "+.2f", value=farthest("against_expert")),
    Column("gap", "gap, median", "%", ".2f", meaning="certified travel time over the proven bound",
           value=median(lambda row: row.certified_time / row.bound - 1.0)),
    Column("bytes_refused", "setpoints refused", meaning="a place that no packet holds, or a thrust that leans too far",
           value=count("bytes_refused")),
    Column("flown", "", value=count("flown")),
    Column("failed", "dry run failed", of="flown", meaning=f"{LOST:g} m from its place, or did not arrive",
           value=count("dry_run")),
    Column("deviation_median", "deviation, median", "cm", ".1f", meaning="largest of each dry run",
           value=median("deviation")),
    Column("deviation_max", "deviation, most", "cm", ".1f", value=largest("deviation")),
)  # fmt: skip
ANSWER_COLUMNS = (
    Column("group", "paths"),
    Column("paths", "", value=count()),
    Column("certified", "certified", of="paths", value=count("certified")),
    Column("refused", "refused", of="paths", meaning="with a reason and a hint: a cusp, an hour of flight",
           value=count(lambda row: row.answer == Answer.REFUSED)),
    Column("failed", "neither", of="paths", meaning="an error that is no answer, or no end",
           value=count(lambda row: row.answer in (Answer.FAILED, Answer.HANGS))),
    Column("late", "over budget", of="paths", meaning="5 s and 20 ms a metre, of processor time",
           value=count(lambda row: row.plan_seconds > row.budget)),
    Column("unfinished", "budget spent", of="paths", meaning="answered in time with something left out",
           value=count("left_out")),
    Column("slowed", "slowed as a whole", of="paths", meaning="by more than 1 %",
           value=count(lambda row: row.speed_factor < 0.99)),
    Column("seconds_median", "median", "s", ".2f", meaning="processor time of planning", value=median("plan_seconds")),
    Column("seconds_max", "most", "s", ".2f", value=largest("plan_seconds")),
    Column("memory_max", "memory", "MB", ".0f", meaning="by which the process grew, at most", value=largest("memory")),
    Column("compared", "compared", meaning="with the expert, planned without a budget",
           value=count(lambda row: np.isfinite(row.against_expert))),
    Column("excess_median", "over the expert, median", "%", "+.2f", meaning="of the time of flight",
           value=median("against_expert")),
    Column("excess_max", "most", "%", "+.1f", value=largest("against_expert")),
)  # fmt: skip


def work(settings: Settings, run: Run) -> Work:
    """Return one case per path; each yields one trial per planner."""
    cases = {f"{group} {seed}": (group, seed) for group, seed in _cases(settings)}
    return Work(cases, partial(measure, settings), Trial)


def _cases(settings: Settings) -> Iterator[tuple[Any, int]]:
    groups: list[Any]
    seeds = range(settings.first_seed, settings.first_seed + settings.paths)
    match settings.workload:
        case Workload.RANDOM:
            speeds = settings.speeds or (None,)
            groups = [(box, limits, speed) for limits in settings.limits for box in settings.boxes for speed in speeds]
        case Workload.LENGTHS:
            groups = list(settings.lengths)
        case Workload.DRAWN:
            groups = list(GROUPS)
        case Workload.HARD:
            groups, seeds = ["hard"], range(settings.first_seed, settings.first_seed + settings.paths * len(FAMILIES))
    for group in groups:
        for seed in seeds:
            yield group, seed


def measure(settings: Settings, named: tuple[Any, int]) -> list[Trial]:
    """Plan one path with each planner; a path that is refused before planning counts as refused by all."""
    group, seed = named
    if settings.workload is Workload.HARD:
        return [_hard_trial(seed)]
    try:
        case = _case(settings, group, seed)
        case.path.check()
        bound = lower_bound(PlanningTask(case.path, case.chosen.airframe, case.chosen.limits))
    except CfplanError as error:
        return [Trial(str(group), seed, name, np.nan, 0, Answer.REFUSED, str(error)) for name in settings.planners]
    order = settings.planners[:: -1 if seed % 2 else 1]
    planned = [_trial(name, case) for name in order]  # all before any is rehearsed, which empties the caches
    trials = [replace(_rehearsed(trial, trajectory, case.chosen), bound=bound) for trial, trajectory in planned]
    reference = {trial.planner: trial for trial in trials}
    if EXPERT in reference:
        best = reference[EXPERT]
        if settings.workload is Workload.DRAWN and not best.certified:
            return []  # the limits exclude the path
        trials = [replace(t, expert_time=best.certified_time, expert_seconds=best.seconds) for t in trials]
    if TOPPQUAD in reference:
        trials = [replace(t, toppquad_seconds=reference[TOPPQUAD].solve_seconds) for t in trials]
    return sorted(trials, key=lambda trial: settings.planners.index(trial.planner))


def _case(settings: Settings, group: Any, seed: int) -> Case:
    """Return the path of a seed in a group of the workload, with its limits."""
    if settings.workload is Workload.DRAWN:
        path, chosen, yaw, angle = draw_case(group, seed)
        return Case(group, seed, path, chosen, 100, yaw, angle)
    if settings.workload is Workload.LENGTHS:
        path = path_of_length(group, list(BOXES)[-1], seed)
        return Case(f"{group:g} m", seed, path, LIMIT_SETS["hardware"], default_nodes(path, "learned"))
    box, name, speed = group
    chosen, label = LIMIT_SETS[name], f"{box} m, {name}"
    if speed is not None:
        chosen, label = replace(chosen, limits=replace(chosen.limits, speed=speed)), f"{label}, {speed:g} m/s"
    return Case(label, seed, random_path(seed, box), chosen, settings.nodes, settings.yaw)


def _trial(name: str, case: Case) -> tuple[Trial, Trajectory | None]:
    """Plan, repair and certify; return the certified flight too. A failure is a trial with its reason."""
    _warm_up(name, case.chosen.name)
    find_model(case.chosen.airframe, case.chosen.limits)  # read once for these limits
    trial, trajectory = Trial(case.group, case.seed, name, case.path.length, case.nodes), None
    before = _memory_begins()
    try:
        trial, trajectory = _planned(trial, case)
    except CfplanError as error:
        trial = replace(trial, answer=Answer.REFUSED if error.hint else Answer.FAILED, reason=str(error))
    return replace(trial, memory=process_memory("VmHWM") - before), trajectory


def _planned(trial: Trial, case: Case) -> tuple[Trial, Trajectory | None]:
    airframe, limits = case.chosen.airframe, case.chosen.limits
    begun = time.process_time()
    task = PlanningTask(case.path, airframe, limits, case.nodes, case.yaw, case.yaw_angle)
    solution = find_planner(trial.planner)(task)
    seconds, solving = time.process_time() - begun, float(solution.stats.get("solve_seconds", np.nan))
    trial = replace(trial, plan_seconds=seconds, solve_seconds=solving)
    if solution.profile is None:
        return replace(trial, answer=Answer.REFUSED, reason=solution.reason or str(solution.status)), None
    finish = refine if trial.planner in REFINED else repair if trial.planner == EXPERT else slow
    begun = time.process_time()
    found = finish(task, solution.profile)
    trial = replace(trial, finish_seconds=time.process_time() - begun)
    raw = Trajectory(case.path, solution.profile, airframe)
    trial = replace(
        trial, answer=Answer.CERTIFIED if found.certificate.passed else Answer.FAILED,
        worst_usage=certify(raw, limits).worst.share, planned_time=raw.duration,
        certified_time=found.trajectory.duration, speed_factor=found.speed_factor,
    )  # fmt: skip
    return trial, found.trajectory


def _rehearsed(trial: Trial, trajectory: Trajectory | None, chosen: LimitSet) -> Trial:
    """Encode and rehearse the flights of the planners that cfplan flies by."""
    if trajectory is None or trial.planner not in FLOWN:
        return trial
    begun = time.process_time()
    try:
        encoded = encode_trajectory(trajectory)
        check_bytes(encoded, trajectory, chosen.limits)
    except NotCertifiedError as error:  # a place too far out for a packet
        return replace(trial, bytes_refused=str(error))
    seconds = time.process_time() - begun
    run = rehearse_motion(encoded, trajectory, chosen.airframe, lost_alone())
    return replace(trial, encode_seconds=seconds, deviation=run.deviation, dry_run=run.reason)


@cache
def _warm_up(name: str, limits: str) -> None:
    """Compile and load what a planner needs, once per process."""
    chosen, path = LIMIT_SETS.get(limits, LIMIT_SETS["hardware"]), random_path(0, next(iter(BOXES)))
    with suppress(CfplanError):
        _planned(Trial("", 0, name, path.length, 100), Case("", 0, path, chosen, 100))


def _memory_begins() -> float:
    """Reset the peak memory of this process, if Linux permits it, and return its present memory, MB."""
    with suppress(OSError):
        File("/proc/self/clear_refs").write_text("5")
    return process_memory("VmRSS")


# Hard paths: planned as users plan, within the budget; every COMPARED-th also by the expert, without a budget.


class _HangsError(Exception):
    """Planning took PATIENCE times its budget."""


@contextmanager
def _patience(seconds: float) -> Iterator[None]:
    """Raise _HangsError in the block after this much processor time, s."""

    def hang(*_: Any) -> None:
        raise _HangsError

    signal.signal(signal.SIGPROF, hang)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)


COMPARED = 7  # also run the expert on every Nth hard path


def _hard_trial(seed: int) -> Trial:
    limits = _roomy_limits()
    drawn = adversarial_path(seed, limits.plan)
    limits = replace(limits, plan=drawn.limits)
    trial = Trial(drawn.family, seed, AUTO, np.nan, 0)
    before, begun = _memory_begins(), time.process_time()
    try:
        path = drawn.path
        budget = default_budget(path)
        trial = replace(trial, length=path.length, budget=budget)
        with _patience(PATIENCE * budget):
            begun = time.process_time()
            made = plan(
                path, limits.airframe, limits, yaw=drawn.yaw, deadline=Deadline.after(budget, time.process_time)
            )
        trial = replace(
            trial, answer=Answer.CERTIFIED if made.certificate.passed else Answer.FAILED, nodes=made.nodes,
            certified_time=made.trajectory.duration, speed_factor=made.repair_speed_factor, left_out=made.left_out,
        )  # fmt: skip
    except CfplanError as error:
        trial = replace(trial, answer=Answer.REFUSED if error.hint else Answer.FAILED, reason=str(error))
    except _HangsError:
        trial = replace(trial, answer=Answer.HANGS)
    except Exception as error:
        trial = replace(trial, reason=repr(error))
    trial = replace(trial, plan_seconds=time.process_time() - begun, memory=process_memory("VmHWM") - before)
    if trial.certified and seed % COMPARED == 0:
        with suppress(CfplanError, _HangsError), _patience(20.0 * PATIENCE * trial.budget):
            best = plan(path, limits.airframe, limits, planner=EXPERT, yaw=drawn.yaw)
            trial = replace(trial, expert_time=best.trajectory.duration)
    return trial


@cache
def _roomy_limits() -> Limits:
    """Return safety.yaml's limits with room and battery for every path, and load machine code, once per process."""
    limits = load_limits(REPOSITORY / "safety.yaml")
    space = Space((-ROOM,) * 3, (ROOM,) * 3, 0.0)
    limits = replace(limits, space=space, battery=replace(limits.battery, endurance=ENDURANCE))
    plan(adversarial_path(0, limits.plan).path, limits.airframe, limits)
    return limits


def tables(settings: Settings, trials: list[Trial]) -> Iterator[Table]:
    """Yield times and flights by group and planner; for hard paths the outcomes by family."""
    of = f"{settings.workload} paths"
    if settings.workload is Workload.HARD:
        yield table("answers", "Adversarial paths, planned within the budget", ANSWER_COLUMNS, trials, by=("group",),
                    last="all")  # fmt: skip
        return
    yield table("time", f"Time to plan: {of}", TIME_COLUMNS, trials, by=("group", "planner"))
    yield table("flight", f"Planned flights: {of}", FLIGHT_COLUMNS, trials, by=("group", "planner"))


STUDY = Study(Settings, work, tables, "--workload random --paths 1000 -o results/planners-random.json")
