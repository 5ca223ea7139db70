"""Label a row of a dataset: a path from its seed, and the solution of the expert or of TOPPQuad."""

import math
from collections.abc import Callable
from dataclasses import asdict
from functools import lru_cache
from typing import Any, get_type_hints

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from cfplan.errors import CfplanError
from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.path import Path
from cfplan.geometry.path_families import Family, family_waypoints
from cfplan.geometry.path_file import PathShape
from cfplan.geometry.random_paths import generator, perturbed, random_waypoints
from cfplan.geometry.yaw import YawMode
from cfplan.learning.dataset_spec import DatasetSpec, Labeller, Relabel
from cfplan.learning.draws import draw_limit_set, draw_space
from cfplan.planners.expert.expert import plan_expert
from cfplan.planners.solution import Solution, Status
from cfplan.planners.task import PlanningTask
from cfplan.safety.certificate import certify
from cfplan.safety.limit_sets import LimitSet
from cfplan.safety.limits import PlanLimits
from cfplan.safety.slowing import slow_until_certified
from cfplan.safety.space import Space
from cfplan.vehicle.airframe import UNPLANNED, Airframe
from cfplan.vehicle.trajectory import Trajectory

_LIMITS, _SHAPE = 1, 2  # streams of random numbers: of limits, vehicles and yaw; of the path's shape and its room
ACTIVE_USAGE = 0.98  # of a limit, from which it counts as active

ChoosePath = Callable[[NDArray, Space, LimitSet, YawMode, float], Path]
"""Return the path to be flown from waypoints, (K, 3) m, their room, vehicle and limits, and yaw with its angle, rad."""

_TYPES = {float: pa.float64(), str: pa.string()}
_NUMBERS = pa.list_(pa.float64())  # of all other fields of airframes and limits


def _fields_of(kind: type, without: frozenset[str] = frozenset()) -> pa.DataType:
    types = get_type_hints(kind)
    return pa.struct([(name, _TYPES.get(types[name], _NUMBERS)) for name in types if name not in without])


SCHEMA = pa.schema(
    [
        ("row", pa.int64()),
        ("path", pa.int64()),  # number of the clean path
        ("copy", pa.int32()),  # 0 the clean path, then its perturbed copies
        ("seed", pa.int64()),
        ("family", pa.string()),  # of the path; "box" in one of the spec's boxes
        ("airframe", _fields_of(Airframe, UNPLANNED)),
        ("limits", _fields_of(PlanLimits)),
        ("yaw_mode", pa.string()),
        ("yaw_angle", pa.float64()),  # rad
        ("version", pa.string()),  # of cfplan
        ("breaks", _NUMBERS),  # (M+1,)
        ("coefficients", _NUMBERS),  # (M, D, 3), rows first
        ("length", pa.float64()),  # m
        ("end", pa.float64()),  # S of the grid 0, S/N, …, S
        ("nodes", pa.int32()),  # N intervals
        ("h", _NUMBERS),  # (N+1,)
        ("dh", _NUMBERS),
        ("ddh", _NUMBERS),
        ("dddh", _NUMBERS),  # (N,)
        ("yaw", _NUMBERS),  # (N+1,) rad
        ("dyaw", _NUMBERS),
        ("ddyaw", _NUMBERS),  # (N,)
        ("status", pa.string()),  # name of a Status
        ("reason", pa.string()),
        ("solver", pa.string()),
        ("iterations", pa.int32()),
        ("travel_time", pa.float64()),  # s, before slowing
        ("peak_speed", pa.float64()),  # m/s
        ("certified_share", pa.float64()),  # fraction of its speed that the certificate passes; 1 without slowing
        ("active_limits", pa.list_(pa.string())),
    ]
)
TIMING_SCHEMA = pa.schema([("row", pa.int64()), ("solve_seconds", pa.float64())])


def make_rows(spec: DatasetSpec, rows: range, choose: ChoosePath | None = None) -> tuple[pa.Table, pa.Table]:
    """Label these rows. Return their table, and a second one of solve times, which differ from run to run.

    A row depends only on `spec` and its number, so every worker makes the same. Chosen paths need `choose`.
    """
    labelled = [_row(spec, row, choose) for row in rows]
    table = pa.Table.from_pylist([row for row, _ in labelled], schema=SCHEMA)
    timing = [{"row": row["row"], "solve_seconds": seconds} for row, seconds in labelled]
    return table, pa.Table.from_pylist(timing, schema=TIMING_SCHEMA)


@lru_cache(maxsize=1)
def clean_path(spec: DatasetSpec, number: int, choose: ChoosePath | None = None) -> Path:
    """Return the path of that number, from the dataset's seed; the last one is cached for its copies.

    Raises:
        InputError: the waypoints that were drawn make no path.
        ValueError: the path is to be chosen, and `choose` is not given.
    """
    points = _waypoints(spec, number)
    random = generator(np.random.SeedSequence(spec.seed, spawn_key=(number, 0, _SHAPE)))
    drawn = PathShape(random.choice([shape.value for shape in PathShape]))
    if (spec.shape or drawn) is PathShape.MIN_SNAP:
        return min_snap(points)
    if choose is None:
        raise ValueError("a dataset of chosen paths needs a function that chooses them")
    return choose(points, draw_space(random, points), *row_limits(spec, number))


def _waypoints(spec: DatasetSpec, number: int) -> NDArray:
    """Return the waypoints of the path of that number, (K, 3) m."""
    if not spec.boxes:
        return family_waypoints(_family(spec, number), _seed(spec, number, 0))
    half = np.array(spec.boxes[number % len(spec.boxes)]) / 2
    return random_waypoints(_seed(spec, number, 0), np.array([-half, half]), spec.waypoints)


def row_limits(spec: DatasetSpec, number: int) -> tuple[LimitSet, YawMode, float]:
    """Return the vehicle and limits, the yaw mode and its angle, rad, with which the path of that number is planned."""
    random = generator(np.random.SeedSequence(spec.seed, spawn_key=(number, 0, _LIMITS)))
    chosen = spec.limit_set or draw_limit_set(random)
    if spec.yaw is not None:
        return chosen, spec.yaw, 0.0
    mode = random.choice(np.array([YawMode.FIXED, YawMode.TANGENT, YawMode.FREE]))
    return chosen, YawMode(str(mode)), random.uniform(-math.pi, math.pi)


def _family(spec: DatasetSpec, number: int) -> Family:
    return spec.families[number % len(spec.families)]


def row_path(spec: DatasetSpec, row: int, choose: ChoosePath | None = None) -> Path:
    """Return the path of a row: a clean one, or a perturbed copy of one. Raises what clean_path() raises."""
    number, copy = divmod(row, 1 + spec.copies)
    path = clean_path(spec, number, choose)
    return path if copy == 0 else perturbed(path, spec.epsilon, _seed(spec, number, copy))


def _seed(spec: DatasetSpec, number: int, copy: int) -> np.random.SeedSequence:
    return np.random.SeedSequence(spec.seed, spawn_key=(number, copy))


def _row(spec: DatasetSpec, row: int, choose: ChoosePath | None) -> tuple[dict[str, Any], float]:
    number, copy = divmod(row, 1 + spec.copies)
    chosen, mode, angle = row_limits(spec, number)
    content: dict[str, Any] = {
        "row": row, "path": number, "copy": copy, "seed": spec.seed,
        "family": "box" if spec.boxes else _family(spec, number).value, "airframe": asdict(chosen.airframe),
        "limits": asdict(chosen.limits), "yaw_mode": mode.value, "yaw_angle": angle, "version": spec.version,
        "nodes": spec.nodes,
    }  # fmt: skip
    try:
        path = row_path(spec, row, choose)
        path.check()
        content |= {"breaks": path.breaks, "coefficients": path.coefficients.ravel()}
        content |= {"length": path.length, "end": path.end}
        kept = copy > 0 and spec.relabel is Relabel.KEEP
        solution = _clean_solution(spec, number, choose) if kept else solve(spec, number, path)
        content |= _label(path, solution, chosen)
        seconds = float(solution.stats.get("solve_seconds", np.nan))
    except CfplanError as error:
        content |= {"status": "PATH", "reason": str(error)}
        seconds = np.nan
    return {name: content.get(name) for name in SCHEMA.names}, seconds


def solve(spec: DatasetSpec, number: int, path: Path) -> Solution:
    """Solve a path under the limits, for the vehicle and with the yaw of the dataset's path of that number."""
    chosen, mode, angle = row_limits(spec, number)
    task = PlanningTask(path, chosen.airframe, chosen.limits, nodes=spec.nodes, yaw=mode, yaw_angle=angle)
    if spec.planner is Labeller.TOPPQUAD:
        from cfplan.planners.baselines.toppquad import plan_toppquad  # imports CasADi, which is slow

        return plan_toppquad(task)
    return plan_expert(task)


@lru_cache(maxsize=1)
def _clean_solution(spec: DatasetSpec, number: int, choose: ChoosePath | None) -> Solution:
    """Return the clean path's label, cached for its copies, which are the next rows."""
    return solve(spec, number, clean_path(spec, number, choose))


def _label(path: Path, solution: Solution, chosen: LimitSet) -> dict[str, Any]:
    profile = solution.profile
    label = {
        "status": solution.status.name,
        "reason": solution.reason,
        "solver": str(solution.stats.get("solver", "")),
        "iterations": int(solution.stats.get("iterations", 0)),
    }
    if solution.status is not Status.SOLVED or profile is None:
        return label
    trajectory = Trajectory(path, profile, chosen.airframe)
    certificate = certify(trajectory, chosen.limits)
    label |= {name: getattr(profile, name) for name in ("h", "dh", "ddh", "dddh", "yaw", "dyaw", "ddyaw")}
    return label | {
        "travel_time": trajectory.duration,
        "peak_speed": certificate.margins[0].worst,
        "certified_share": 1.0 if certificate.passed else _certified_speed_factor(trajectory, chosen.limits),
        "active_limits": [margin.name for margin in certificate.margins if margin.share >= ACTIVE_USAGE],
    }


def _certified_speed_factor(trajectory: Trajectory, limits: PlanLimits) -> float:
    """Return the factor on speed at which the trajectory passes; 0 if no slowing helps."""
    try:
        return slow_until_certified(trajectory, limits).speed_factor
    except CfplanError:
        return 0.0
