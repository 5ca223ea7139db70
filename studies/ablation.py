"""What a network is worth without parts of what it sees: the same short training, on the same rows, of each.

Limits and vehicle reach a network in three ways: as numbers without dimension among its inputs, in the reference rate
that its answer is counted from, and in the units of length and time. Each network lacks one or two of them. All plan
the same unseen paths, under limits and vehicles drawn at random, and are refined by the same search to the same end.

The training is a short one, so the figures compare the networks with each other and say little about a full one; the
model that is shipped stands beside them, and again without the multipliers with which rounds of tightening go on.
"""

import math
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path as FilePath
from typing import Any, NamedTuple

import numpy as np

from cfplan.errors import CfplanError, InputError
from cfplan.geometry.yaw import YawMode
from cfplan.learning.dataset_spec import DatasetSpec
from cfplan.learning.features import ScaledLimits, View, scaled_limits
from cfplan.learning.labels import clean_path, row_limits
from cfplan.learning.learned import plan_learned
from cfplan.learning.model_files import Model, find_model, load_model
from cfplan.planners.expert.expert import plan_expert
from cfplan.planners.expert.refine import refinements
from cfplan.planners.expert.search import Start, refining_restarts
from cfplan.planners.task import PlanningTask
from cfplan.planning.repair import repair
from cfplan.safety.certificate import certify
from cfplan.safety.limit_sets import LIMIT_SETS
from cfplan.safety.limits import PlanLimits
from studies.proposals import cold_restarts
from studies.runner.result import Column, StudyResult, Table, collect
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.timing import duration_of
from cfplan.vehicle.trajectory import Trajectory

NODES = 100
UNSEEN_SEED = 77  # of the paths, limits and vehicles; datasets have other seeds
COLUMNS = (
    Column("network", "network"),
    Column("paths"),
    Column("error", "proposal's time of flight: mean error", "%", ".2f", meaning="absolute, against the expert's"),
    Column("error_p95", "p95", "%", ".2f"),
    Column("failed", "not refined", of="paths", meaning="no search from there succeeded, or the certificate refused"),
    Column("steps", "Newton steps, mean", "", ".1f"),
    Column("steps_p95", "Newton steps, p95", "", ".0f"),
    Column("finish", "refine and certify, median", "ms", ".2f", meaning="processor time"),
    Column("slower", "flight against the expert, mean", "%", "+.3f"),
)


def without_limits(airframe: Airframe, limits: PlanLimits) -> ScaledLimits:
    """Return what there is to see, less the numbers: limits are in the reference and the units alone."""
    known = scaled_limits(airframe, limits)
    return known._replace(numbers=np.zeros_like(known.numbers))


def speed_alone(airframe: Airframe, limits: PlanLimits) -> ScaledLimits:
    """Return what there is to see of the limit on speed alone; the rest is that of the hardware's limits."""
    usual = LIMIT_SETS["hardware"]
    known, usual_known = scaled_limits(airframe, limits), scaled_limits(usual.airframe, usual.limits)
    return known._replace(bounds=usual_known.bounds, numbers=np.zeros_like(known.numbers))


class _InMetres(ScaledLimits):
    """The same in metres and seconds."""

    @property
    def smoothing(self) -> float:
        """Return the time over which answers are smoothed, s."""
        return super().smoothing * math.sqrt(GRAVITY)


def without_scaling(airframe: Airframe, limits: PlanLimits) -> ScaledLimits:
    """Return the same in metres and seconds."""
    known = scaled_limits(airframe, limits)
    numbers, bounds = known.numbers.copy(), known.bounds.copy()
    numbers[0] += math.log(GRAVITY)  # acceleration, m/s²
    numbers[1] -= math.log(known.time)  # angular velocity, rad/s
    numbers[[2, 5, 6, 7]] -= 2.0 * math.log(known.time)  # angular accelerations, rad/s²
    bounds[:4] *= known.length / known.time ** np.arange(1, 5)
    bounds[4:] /= known.time ** np.arange(1, 3)
    return _InMetres(1.0, 1.0, bounds, numbers)


VIEWS: dict[str, View] = {
    "all of it": scaled_limits,
    "limits not as inputs": without_limits,
    "of limits the speed alone": speed_alone,
    "no scaling: metres and seconds": without_scaling,
}
SHIPPED, COLD = "the shipped model", "the shipped model, multipliers not kept"


class _Planned(NamedTuple):
    """One proposal and what became of it; NaN where it failed."""

    error: float  # of the proposal's time of flight
    steps: float
    seconds: float
    slower: float  # than the expert


def ablation(
    dataset: FilePath,
    *,
    rows: int = 10_000,
    epochs: int = 6,
    paths: int = 300,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> StudyResult:
    """Train each network on the first `rows` of a dataset and plan `paths` unseen paths with each.

    An interrupt while planning ends it early with what is planned by then.

    Raises:
        InputError: no path, too few rows, or a dataset that cannot be read or has the seed of the unseen paths.
    """
    from cfplan.learning.training import Options, train_on  # torch takes its time to import
    from cfplan.learning.training_set import read_training_set

    if paths < 1 or rows < 100:
        raise InputError("paths must be at least 1, rows at least 100", where="ablation", hint="give --rows 10000")
    total, done = epochs * len(VIEWS) + paths, 0

    def another(*_: Any) -> None:
        nonlocal done
        done += 1
        progress(done, total)

    models: dict[str, tuple[Model, View]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for number, (name, view) in enumerate(VIEWS.items()):
            training_set = read_training_set(dataset, view=view)
            if training_set.spec.seed == UNSEEN_SEED:
                raise InputError(
                    f"its seed is {UNSEEN_SEED}, that of the unseen paths",
                    where=str(dataset),
                    hint="make one with another --seed by `cfplan dataset make`",
                )
            some = training_set.part(np.arange(min(rows, len(training_set.rows))))
            train_on(some, FilePath(folder, f"view-{number}"), Options(epochs=epochs), on_epoch=another)
            models[name] = load_model(FilePath(folder, f"view-{number}")), view
        shipped = find_model(LIMIT_SETS["hardware"].airframe, LIMIT_SETS["hardware"].limits)
        if shipped is not None:
            models[SHIPPED] = models[COLD] = shipped, scaled_limits
        measured, interrupted = collect(_unseen(models, paths, another))
    table = tuple(_row(name, [found[name] for found in measured]) for name in models)
    title = (
        f"Networks after {epochs} epochs on {len(some.rows)} rows; unseen paths, each under limits and for a vehicle "
        f"drawn at random, N = {NODES}"
    )
    settings = {"rows": len(some.rows), "epochs": epochs, "paths": paths, "unseen_seed": UNSEEN_SEED}
    return StudyResult("ablation", settings, (Table("networks", title, COLUMNS, table),), (), interrupted)


def _unseen(
    models: dict[str, tuple[Model, View]], paths: int, planned: Callable[[], None]
) -> Iterator[dict[str, _Planned]]:
    """Yield what became of each network's proposal for each path that the expert can plan."""
    spec = DatasetSpec(count=10 * paths + 10, seed=UNSEEN_SEED)
    number, left = 0, paths
    while left and number < spec.count:
        found = _of_path(spec, number, models)
        number += 1
        if found:
            left -= 1
            planned()
            yield found


def _of_path(spec: DatasetSpec, number: int, models: dict[str, tuple[Model, View]]) -> dict[str, _Planned]:
    chosen, mode, angle = row_limits(spec, number)
    try:
        path = clean_path(spec, number)
        path.check()
        task = PlanningTask(path, chosen.airframe, chosen.limits, NODES, YawMode(mode), angle)
        expert = plan_expert(task)
        if expert.profile is None:
            return {}
        best = repair(task, expert.profile)
        if best.speed_factor < 1.0:
            return {}
        flight = best.trajectory.duration
        return {
            name: _refined(task, model, view, cold_restarts if name == COLD else refining_restarts, flight)
            for name, (model, view) in models.items()
        }
    except CfplanError:
        return {}


def _refined(
    task: PlanningTask, model: Model, view: View, restarts: Callable[..., Sequence[Start]], flight: float
) -> _Planned:
    profile = plan_learned(task, model=model, view=view).profile
    if profile is None:
        return _Planned(np.nan, np.nan, np.nan, np.nan)
    error, begun = abs(duration_of(profile) / flight - 1.0), time.process_time()
    for refined in refinements(task, profile, restarts=restarts):
        if refined.profile is None:
            break
        trajectory = Trajectory(task.path, refined.profile, task.airframe)
        if certify(trajectory, task.limits).passed:
            seconds = time.process_time() - begun
            return _Planned(error, float(refined.stats["iterations"]), seconds, trajectory.duration / flight - 1.0)
    return _Planned(error, np.nan, np.nan, np.nan)


def _row(name: str, planned: Sequence[_Planned]) -> dict[str, Any]:
    """Return the figures of one network, by the keys of COLUMNS."""
    values = np.array(planned).reshape(-1, 4)
    good = np.isfinite(values).all(axis=1)
    row: dict[str, Any] = {"network": name, "paths": len(values), "failed": int((~good).sum())}
    if not good.any():
        return row | dict.fromkeys((column.key for column in COLUMNS if column.key not in row), np.nan)
    error, steps, seconds, slower = values[good].T
    return row | {
        "error": float(error.mean()),
        "error_p95": float(np.quantile(error, 0.95)),
        "steps": float(steps.mean()),
        "steps_p95": float(np.quantile(steps, 0.95)),
        "finish": float(np.median(seconds)),
        "slower": float(slower.mean()),
    }
