"""Try the learned planner under limits and for vehicles that it has not learned from, against the expert.

Each of a model's training draws has its place among the twelve numbers that it sees of limits and vehicle, each number
over its standard deviation in training. Its neighbourhood reaches as far as the nearest other training draw is away
from 99 of 100 training draws. Two groups of draws lie outside every neighbourhood: one with vehicles, one with limits
that nobody trained for. Paths are of all families, with yaw of all modes, of seeds that no dataset has.

The expert's profiles are repaired just as the network's are refined. A path is left out where the expert finds no
flight, or the vehicle cannot hover within its limits.
"""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cfplan.errors import CfplanError, InputError
from cfplan.geometry.path import Path
from cfplan.geometry.random_paths import generator
from cfplan.geometry.yaw import YawMode
from cfplan.learning import draws
from cfplan.learning.dataset_spec import DatasetSpec
from cfplan.learning.features import scaled_limits
from cfplan.learning.labels import clean_path, row_limits
from cfplan.learning.learned import plan_learned
from cfplan.learning.model_files import Model, find_model
from cfplan.planners.expert.expert import plan_expert
from cfplan.planners.task import PlanningTask
from cfplan.planning.repair import refine, repair
from cfplan.safety.limit_sets import LIMIT_SETS, LimitSet
from cfplan.safety.limits import PlanLimits
from studies.runner.result import Column, StudyResult, Table, collect, detail_table
from cfplan.vehicle.airframe import GRAVITY, Airframe

NODES = 100
SEED = 99  # of the draws; datasets have other seeds
WITHIN, SHIPPED, VEHICLES, LIMITS = "drawn as in training", "shipped limits", "vehicles outside", "limits outside"
NEIGHBOURS = 0.99  # quantile of the distances from training draws to the nearest other one
UNUSUAL = 0.6  # share of the numbers of a draw outside that are unusual
_TRIES = 1000  # draws until one lies outside

# Below and above what draws.py draws for training.
SPEED = ((0.1, 0.3), (8.0, 16.0))  # m/s
ACCELERATION = ((0.3, 1.0), (20.0, 40.0))  # m/s²
ANGULAR_VELOCITY = ((0.7, 2.0), (25.0, 50.0))  # rad/s
ANGULAR_ACCELERATION = ((3.0, 10.0), (300.0, 1000.0))  # rad/s²
TILT = ((5.0, 15.0), (85.0, 88.0))  # degrees
SPECIFIC_THRUST = ((0.02, 0.1), (0.8, 0.9))  # g
MASS = ((0.010, 0.020), (0.080, 0.250))  # kg
ARM = ((0.015, 0.025), (0.060, 0.120))  # m
INERTIA = ((0.1, 0.3), (0.8, 2.0))  # over mass and the square of the arm
THRUST_TO_WEIGHT = ((1.25, 1.4), (4.0, 8.0))
THRUST_TO_TORQUE = ((0.001, 0.004), (0.035, 0.100))  # m
DRAG = ((0.8, 1.6),)  # 1/s

FIGURES = (
    Column("group", "figure"),
    Column("paths", "paths", goal="1000"),
    Column("known", "within the model's ranges", of="paths", meaning="where `auto` asks it"),
    Column("distance", "distance to the nearest training draw: median", "", ".2f"),
    Column("network_mean", "network against expert: mean of the absolute", "%", ".2f", meaning="before refining"),
    Column("certified", "certified", of="paths", goal="all"),
    Column("slowed", "slowed as a whole", of="paths", meaning="to be certified; `auto` then asks the expert"),
    Column("against_mean", "against expert: mean", "%", "+.3f", goal="+0.05 %", meaning="certified flights' duration"),
    Column("against_p95", "against expert: p95", "%", "+.3f", goal="+0.2 %"),
    Column("against_max", "against expert: max", "%", "+.2f", goal="+0.5 %"),
    Column("over", "slower by more than 0.5 %", of="paths", goal="0"),
    Column("auto_max", "with the expert where slowed: max", "%", "+.2f"),
    Column("seconds", "path to certificate: median", "ms", ".2f", meaning="processor time"),
    Column("expert_seconds", "the expert's median", "ms", ".2f"),
    Column("speed_up", "expert's time over learned, median", "×", ".2f", goal="4×, at least", meaning="path by path"),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class UnseenDraw:
    """One path under limits that were drawn. NaN where there is nothing to measure."""

    group: str
    number: int
    distance: float  # to the nearest training draw
    known: bool  # within the model's ranges
    reason: str = ""  # why it is not certified
    expert: float = np.nan  # s of flight
    network: float = np.nan  # s, before refining
    learned: float = np.nan  # s
    speed_factor: float = np.nan  # on the whole; 1: not slowed
    seconds: float = np.nan  # of the processor, to the certificate
    expert_seconds: float = np.nan


class Neighbourhoods:
    """Where a model's training draws lie."""

    def __init__(self, spec: DatasetSpec) -> None:
        """Draw them again, from the dataset's seed."""
        numbers = []
        for number in range(spec.count):
            chosen, _, _ = row_limits(spec, number)
            numbers.append(scaled_limits(chosen.airframe, chosen.limits).numbers)
        drawn = np.array(numbers)
        self.spread = drawn.std(axis=0)
        self.tree = cKDTree(drawn / self.spread)
        apart, _ = self.tree.query(self.tree.data, k=2)
        self.radius = float(np.quantile(apart[:, 1], NEIGHBOURS))

    def distance(self, numbers: NDArray) -> float:
        """Return the distance of (NUMBERS,) to the nearest training draw."""
        return float(self.tree.query(numbers / self.spread)[0])


def unseen_limits(
    *,
    paths: int = 1000,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> StudyResult:
    """Plan `paths` paths in each of four groups. An interrupt ends it early with what is planned by then.

    Raises:
        InputError: no path at all, or no model that has learned from draws.
    """
    if paths < 1:
        raise InputError("paths must be at least 1", where="paths", hint="give --paths 100")
    usual = LIMIT_SETS["hardware"]
    model = find_model(usual.airframe, usual.limits)
    if model is None or model.card.data.get("limits") != "drawn":
        raise InputError("no model that has learned from draws", where="models", hint="train one with `cfplan train`")
    around = Neighbourhoods(DatasetSpec(count=model.card.data["count"], seed=model.card.data["seed"]))
    flights, interrupted = collect(_planned(model, around, paths, progress))
    groups = [(name, [each for each in flights if each.group == name]) for name in _DRAW]
    rows = tuple(_figures(name, group) for name, group in groups if group)
    title = f"The learned planner under drawn limits, N = {NODES}; neighbourhoods reach {around.radius:.2f} far"
    odd = [each for each in flights if each.reason or each.speed_factor < 1.0 or each.learned > 1.005 * each.expert]
    settings = {"paths": paths, "nodes": NODES, "seed": SEED, "model": model.name, "radius": around.radius}
    tables = (Table("figures", title, FIGURES, rows, across=True),)
    return StudyResult("unseen-limits", settings, tables, (detail_table("odd", odd),), interrupted)


def _planned(
    model: Model, around: Neighbourhoods, paths: int, progress: Callable[[int, int], None]
) -> Iterator[UnseenDraw]:
    for place, (name, draw) in enumerate(_DRAW.items()):
        spec, number, done = DatasetSpec(count=10_000_000, seed=SEED + place), 0, 0
        while done < paths:
            chosen, mode, angle = draw(spec, number, around)
            found = _try(name, number, _path(spec, number), chosen, mode, angle, model, around)
            number += 1
            if found is not None:
                done += 1
                progress(place * paths + done, len(_DRAW) * paths)
                yield found


def _path(spec: DatasetSpec, number: int) -> Path | None:
    """Return the path of that number, if the waypoints that were drawn make one."""
    try:
        path = clean_path(spec, number)
        path.check()
    except CfplanError:
        return None
    return path


def _try(
    group: str, number: int, path: Path | None, chosen: LimitSet, mode: YawMode, angle: float, model: Model,
    around: Neighbourhoods,
) -> UnseenDraw | None:  # fmt: skip
    """Return what became of a path; None where the expert finds no flight."""
    if path is None:
        return None
    task = PlanningTask(path, chosen.airframe, chosen.limits, NODES, mode, angle)
    try:
        begun = time.process_time()
        expert = plan_expert(task)
        if expert.profile is None:
            return None
        best = repair(task, expert.profile)
        expert_seconds = time.process_time() - begun
    except CfplanError:
        return None
    numbers = scaled_limits(chosen.airframe, chosen.limits).numbers
    known = not model.outside(chosen.airframe, chosen.limits)
    trial = UnseenDraw(
        group, number, around.distance(numbers), known, expert=best.trajectory.duration, expert_seconds=expert_seconds
    )
    try:
        begun = time.process_time()
        solution = plan_learned(task, model=model)
        if solution.profile is None:
            return replace(trial, reason=solution.reason or str(solution.status))
        found = refine(task, solution.profile)
        seconds = time.process_time() - begun
    except CfplanError as error:
        return replace(trial, reason=str(error))
    return replace(
        trial, network=found.before, learned=found.trajectory.duration, speed_factor=found.speed_factor,
        seconds=seconds, reason="" if found.certificate.passed else "the certificate does not pass",
    )  # fmt: skip


def _figures(group: str, flights: Sequence[UnseenDraw]) -> dict[str, Any]:
    """Return the figures of one group, by the keys of FIGURES."""
    good = [each for each in flights if not each.reason]
    against = np.array([each.learned / each.expert - 1.0 for each in good] or [np.nan])
    auto = [0.0 if each.speed_factor < 1.0 else slower for each, slower in zip(good, against, strict=False)]
    return {
        "group": group,
        "paths": len(flights),
        "known": sum(each.known for each in flights),
        "distance": float(np.median([each.distance for each in flights])),
        "network_mean": float(np.mean([abs(each.network / each.expert - 1.0) for each in good] or [np.nan])),
        "certified": len(good),
        "slowed": sum(each.speed_factor < 1.0 for each in good),
        "against_mean": float(against.mean()),
        "against_p95": float(np.quantile(against, 0.95)),
        "against_max": float(against.max()),
        "over": int((against > 0.005).sum()),
        "auto_max": float(max(auto, default=np.nan)),
        "seconds": float(np.median([each.seconds for each in good] or [np.nan])),
        "expert_seconds": float(np.median([each.expert_seconds for each in good] or [np.nan])),
        "speed_up": float(np.median([each.expert_seconds / each.seconds for each in good] or [np.nan])),
    }


def _as_in_training(spec: DatasetSpec, number: int, _around: Neighbourhoods) -> tuple[LimitSet, YawMode, float]:
    return row_limits(spec, number)


def _shipped(spec: DatasetSpec, number: int, _around: Neighbourhoods) -> tuple[LimitSet, YawMode, float]:
    _, mode, angle = row_limits(spec, number)
    return list(LIMIT_SETS.values())[number % len(LIMIT_SETS)], mode, angle


def _vehicle_outside(spec: DatasetSpec, number: int, around: Neighbourhoods) -> tuple[LimitSet, YawMode, float]:
    return _outside(spec, number, around, lambda random: _limited(random, _unusual_airframe(random), draws.draw_limits))


def _limits_outside(spec: DatasetSpec, number: int, around: Neighbourhoods) -> tuple[LimitSet, YawMode, float]:
    return _outside(spec, number, around, lambda random: _limited(random, draws.draw_airframe(random), _unusual_limits))


_DRAW: dict[str, Callable[[DatasetSpec, int, Neighbourhoods], tuple[LimitSet, YawMode, float]]] = {
    SHIPPED: _shipped,
    WITHIN: _as_in_training,
    VEHICLES: _vehicle_outside,
    LIMITS: _limits_outside,
}


def _outside(
    spec: DatasetSpec, number: int, around: Neighbourhoods, draw: Callable[[np.random.Generator], LimitSet]
) -> tuple[LimitSet, YawMode, float]:
    """Draw until one lies outside of every training draw's neighbourhood, and can hover."""
    _, mode, angle = row_limits(spec, number)
    random = generator(np.random.SeedSequence(spec.seed, spawn_key=(number, 1)))
    for _ in range(_TRIES):
        chosen = draw(random)
        airframe, limits = chosen.airframe, chosen.limits
        hovers = limits.motor_thrust_min < airframe.hover_thrust < limits.motor_thrust_max
        if hovers and around.distance(scaled_limits(airframe, limits).numbers) > around.radius:
            return chosen, mode, angle
    raise InputError("no draw lies outside of every neighbourhood", where="limits", hint="please report this")


def _limited(
    random: np.random.Generator, airframe: Airframe, limit: Callable[[np.random.Generator, Airframe], PlanLimits]
) -> LimitSet:
    return LimitSet("outside", airframe, limit(random, airframe))


def _unusual(random: np.random.Generator, usual: tuple[float, float], unusual: Sequence[tuple[float, float]]) -> float:
    """Draw a number whose logarithm is uniform, mostly from one of the unusual ranges."""
    ends = unusual[int(random.integers(len(unusual)))] if random.uniform() < UNUSUAL else usual
    return math.exp(random.uniform(math.log(ends[0]), math.log(ends[1])))


def _unusual_airframe(random: np.random.Generator) -> Airframe:
    mass, arm = _unusual(random, draws.MASS, MASS), _unusual(random, (0.025, 0.060), ARM)
    roll = mass * arm**2 * _unusual(random, (0.3, 0.8), INERTIA)
    pitch = roll * random.uniform(0.7, 1.4)
    weight = mass * GRAVITY / 4
    sideways = mass * _unusual(random, (0.01, 0.8), DRAG)
    return Airframe(
        name="unusual", mass=mass, inertia=(roll, pitch, (roll + pitch) * random.uniform(0.75, 0.99)), arm=arm,
        thrust_to_torque=_unusual(random, (0.004, 0.035), THRUST_TO_TORQUE),
        motor_thrust_min=random.uniform(0.0, 0.2) * weight,
        motor_thrust_max=_unusual(random, draws.THRUST_TO_WEIGHT, THRUST_TO_WEIGHT) * weight,
        motor_time_constant=random.uniform(0.04, 0.12), drag=(sideways, sideways * random.uniform(0.7, 1.5)),
        source="drawn",
    )  # fmt: skip


def _unusual_limits(random: np.random.Generator, airframe: Airframe) -> PlanLimits:
    usual = draws.draw_limits(random, airframe)
    return PlanLimits(
        speed=_unusual(random, draws.SPEED, SPEED),
        acceleration=_unusual(random, draws.ACCELERATION, ACCELERATION),
        angular_velocity=_unusual(random, draws.ANGULAR_VELOCITY, ANGULAR_VELOCITY),
        angular_acceleration=_unusual(random, draws.ANGULAR_ACCELERATION, ANGULAR_ACCELERATION),
        tilt=math.radians(_unusual(random, draws.TILT, TILT)),
        specific_thrust_min=GRAVITY * _unusual(random, draws.SPECIFIC_THRUST, SPECIFIC_THRUST),
        motor_thrust_min=usual.motor_thrust_min,
        motor_thrust_max=usual.motor_thrust_max,
    )
