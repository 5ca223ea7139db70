"""How a plan changes with its path: the same path perturbed, planned again, and flown in the dry run.

A path that was measured, or drawn a little differently the next day, should give nearly the same flight. This says
whether it does, as the paper asks it of its networks (see paper/robustness.py).
"""

import pathlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cfplan.errors import CfplanError, InputError
from cfplan.flight.setpoints.encoding import check_bytes, encode_trajectory
from cfplan.geometry.path import Path
from cfplan.geometry.path_file import PathFile
from cfplan.geometry.random_paths import perturbed
from cfplan.planning.plan import plan
from cfplan.planning.plan_result import Plan
from cfplan.planning.planners import AUTO
from cfplan.safety.limits import Limits
from cfplan.simulation.dry_run import dry_run
from studies.runner.result import Column, StudyResult, Table, collect, detail_table

SCALES = (0.001, 0.01, 0.1)  # m
SAMPLES = 500  # places along the path at which speed and yaw are compared


@dataclass(frozen=True, slots=True)
class PerturbedPlan:
    """The path perturbed once, planned and rehearsed. NaN where there was nothing to measure."""

    epsilon: float  # m
    draw: int
    reason: str = ""  # why it was not planned, or why its setpoints or its dry run are refused
    flight: float = np.nan  # s
    longer: float = np.nan  # relative change of the time of flight
    faster: float = np.nan  # m/s, largest change of speed at a share of the path, either way
    turned: float = np.nan  # rad, likewise of yaw
    deviation: float = np.nan  # m, in the dry run


COLUMNS = (
    Column("epsilon", "perturbed by at most", "cm", "g"),
    Column("plans"),
    Column("certified", "certified", of="plans"),
    Column("flown", "dry run passed", of="plans"),
    Column("longer", "time of flight: mean change", "%", "+.2f"),
    Column("longer_most", "largest", "%", "+.2f"),
    Column("faster", "speed: largest change", "m/s", ".2f", meaning="at a share of the path's s; mean of the draws"),
    Column("turned", "yaw: largest change", "rad", ".3f", meaning="likewise"),
    Column("deviation", "dry run: deviation", "cm", ".1f", meaning="mean of the draws"),
    Column("deviation_most", "largest", "cm", ".1f"),
)


def path_robustness(
    path_file: PathFile,
    limits: Limits,
    *,
    scales: Sequence[float] = SCALES,
    draws: int = 10,
    seed: int = 0,
    planner: str = AUTO,
    models: tuple[pathlib.Path, ...] = (),
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> StudyResult:
    """Perturb the path `draws` times by at most each of `scales`, m; an interrupt keeps what is measured by then.

    Raises:
        InputError: no draw, or a scale that is no length.
        InfeasibleError: the path as it is cannot be planned.
    """
    if draws < 1 or not scales or not all(0.0 < scale < np.inf for scale in scales):
        raise InputError(
            "draws must be at least 1 and scales above 0 m", where="robustness", hint="leave them out for the usual"
        )

    def planned(path: Path) -> Plan:
        factor, yaw = path_file.speed, path_file.yaw
        return plan(
            path, limits.airframe, limits, planner=planner, yaw=yaw, yaw_angle=path_file.yaw_angle,
            speed_factor=factor, models=models,
        )  # fmt: skip

    total = len(scales) * draws + 1
    clean = planned(path_file.path)
    progress(1, total)

    def trials() -> Iterator[PerturbedPlan]:
        for k, scale in enumerate(scales):
            for draw in range(draws):
                moved = perturbed(path_file.path, scale, np.random.SeedSequence(seed, spawn_key=(k, draw)))
                yield _trial(scale, draw, moved, clean, planned)
                progress(k * draws + draw + 2, total)

    done, interrupted = collect(trials())
    title = f"{path_file.name}, {path_file.path.length:.1f} m, {clean.trajectory.duration:.2f} s: the path perturbed"
    table = Table("robustness", title, COLUMNS, tuple(_rows(done)))
    settings = {"path": path_file.name, "draws": draws, "seed": seed, "planner": planner}
    return StudyResult("path-robustness", settings, (table,), (detail_table("plans", done),), interrupted)


def _trial(scale: float, draw: int, path: Path, clean: Plan, planned: Callable[[Path], Plan]) -> PerturbedPlan:
    known: dict[str, Any] = {"epsilon": scale, "draw": draw}
    try:
        found = planned(path)
        before, after = _along(clean), _along(found)
        known |= {
            "flight": found.trajectory.duration,
            "longer": found.trajectory.duration / clean.trajectory.duration - 1.0,
            "faster": float(np.abs(after[0] - before[0]).max()),
            "turned": float(np.abs(after[1] - before[1]).max()),
        }
        encoded = encode_trajectory(found.trajectory)
        check_bytes(encoded, found.trajectory, found.limits.plan)
        run = dry_run(encoded, found.trajectory, found.airframe, found.limits.flight)
        return PerturbedPlan(**known, reason=run.reason, deviation=run.deviation)
    except CfplanError as error:
        return PerturbedPlan(**known, reason=str(error))


def _along(found: Plan) -> tuple[np.ndarray, np.ndarray]:
    """Return speed, m/s, and yaw, rad, at the same shares of the path, (SAMPLES,) each."""
    places = np.linspace(0.0, found.path.end, SAMPLES)
    state = found.trajectory.at(found.trajectory.time_at(places))
    return np.linalg.norm(state.velocity, axis=1), state.yaw


def _rows(done: Sequence[PerturbedPlan]) -> Iterator[dict[str, Any]]:
    for scale in dict.fromkeys(trial.epsilon for trial in done):
        own = [trial for trial in done if trial.epsilon == scale]
        longer, away = _known(trial.longer for trial in own), _known(trial.deviation for trial in own)
        yield {
            "epsilon": scale,
            "plans": len(own),
            "certified": sum(np.isfinite(trial.flight) for trial in own),
            "flown": sum(not trial.reason for trial in own),
            "longer": longer.mean(),
            "longer_most": longer[np.argmax(np.abs(longer))],
            "faster": _known(trial.faster for trial in own).mean(),
            "turned": _known(trial.turned for trial in own).mean(),
            "deviation": away.mean(),
            "deviation_most": away.max(),
        }


def _known(values: Iterable[float]) -> np.ndarray:
    """Return those that are finite as an array that is never empty."""
    return np.array([value for value in values if np.isfinite(value)] or [np.nan])
