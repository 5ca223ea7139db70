"""Make the paper's Table 2: networks and the shipped planner on perturbed paths.

Each path, and each of its perturbations by at most ε, is planned, and the geometric controller flies the plan with the
paper's motor lag. The networks, without repair, are compared with the shipped planner, certified, in each yaw mode, the
expert and TOPPQuad. One network is not in the paper: it learns from perturbed paths that are solved again, whereas the
paper keeps the clean path's label.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import CfplanError
from cfplan.geometry.path import Path
from cfplan.geometry.random_paths import perturbed
from cfplan.geometry.yaw import YawMode
from cfplan.learning.dataset_spec import Relabel
from cfplan.planners.baselines.toppquad import plan_toppquad
from cfplan.planners.expert.expert import plan_expert
from cfplan.planners.task import Planner
from cfplan.safety.limit_sets import PAPER
from cfplan.simulation.geometric_flight import fly_geometric, nearest_states
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.trajectory import Trajectory
from studies.paper.printed import TEST
from studies.paper.recovery import recover_profile
from studies.paper.robustness_tables import (
    FACTORS,
    HELD_YAW,
    SCALES,
    SHIPPED,
    SHIPPED_FIXED,
    SHIPPED_TANGENT,
    TOLERANCE,
    RobustnessTrial,
    robustness_table,
    variation_table,
)
from studies.paper.sequences import path_inputs
from studies.paper.trained import NODES, SEEDS, NetworkSettings, PaperPath, TrainedNetwork, paper_data
from studies.paper.training import OURS, SequenceOptions, answer
from studies.paper.trials import (
    EXPERT,
    FLOWN,
    TOPPQUAD,
    Plan,
    ordered,
    profile_by,
    shipped_profile,
    training_table,
    trajectory_by,
)
from studies.runner.options import option
from studies.runner.result import Table
from studies.runner.study import Run, Study, Work

MODELS = MappingProxyType(
    {
        each.name: each
        for each in (
            *(SequenceOptions(epsilon=epsilon) for epsilon in SCALES),
            SequenceOptions(epsilon=SCALES[-1], relabel=Relabel.SOLVE),
            OURS,
            replace(OURS, epsilon=SCALES[-1], relabel=Relabel.SOLVE),
        )
    }
)
REFERENCES: Mapping[str, Planner] = MappingProxyType({"toppquad": plan_toppquad, "expert": plan_expert})


class Answered(NamedTuple):
    """A model's answer: a profile, and h and cos ψ at the nodes, which are a network's outputs."""

    profile: SpeedProfile
    h: NDArray  # (N,)
    cosine: NDArray  # (N,)
    speed: NDArray  # (N,) m/s, along the path of the request


Ask = Callable[[Path], Answered]  # raises CfplanError if there is no answer


def _planner(plan: Plan) -> Ask:
    def ask(path: Path) -> Answered:
        profile = plan(path)
        return _answer(profile, path, profile.h, np.cos(profile.yaw))

    return ask


def _answer(profile: SpeedProfile, path: Path, h: NDArray, cosine: NDArray) -> Answered:
    places = np.linspace(0.0, path.end, len(h))
    return Answered(profile, h, cosine, np.linalg.norm(path(places, 1), axis=1) * np.sqrt(h))


PLANNERS: Mapping[str, tuple[str, Ask]] = MappingProxyType(  # besides the networks, with their names in tables
    {
        "shipped": (SHIPPED, _planner(shipped_profile)),
        "shipped-fixed": (SHIPPED_FIXED, _planner(partial(shipped_profile, yaw=YawMode.FIXED))),
        "shipped-tangent": (SHIPPED_TANGENT, _planner(partial(shipped_profile, yaw=YawMode.TANGENT))),
        "expert": (EXPERT, _planner(profile_by(plan_expert))),
        "toppquad": (TOPPQUAD, _planner(profile_by(plan_toppquad))),
    }
)
USUAL = (*MODELS, *(name for name in PLANNERS if name != "toppquad"))  # TOPPQuad alone takes 18 s per path, these 10 s


@dataclass(frozen=True, slots=True)
class Settings(NetworkSettings):
    """The models to compare, and the paths."""

    paths: int = option(100, "Paths for testing.", least=1)
    draws: int = option(10, "Perturbations of each path, for each ε.", least=1)
    seeds: int = option(1, SEEDS, least=1)
    models: tuple[str, ...] = option(USUAL, "Network or planner.", choices=(*MODELS, *PLANNERS))
    reference: str = option(
        "toppquad", "Reference planner for travel times, on the path and on the perturbed one.",
        choices=tuple(REFERENCES),
    )  # fmt: skip
    reference_draws: int | None = option(
        None, "Draws that the reference plans too; takes most of the time.  [default: all]", least=1
    )


def work(settings: Settings, run: Run) -> Work:
    """Return one case per test path; networks are trained if necessary. Raises what `paper_data` raises."""
    models = [MODELS[name] for name in settings.models if name in MODELS]
    data = paper_data(settings, run, [replace(each, seed=seed) for each in models for seed in range(settings.seeds)])
    return Work(data.part(TEST), partial(measure, settings, data.networks), RobustnessTrial, data.identity)


def measure(settings: Settings, networks: list[TrainedNetwork], item: PaperPath) -> list[RobustnessTrial]:
    """Plan the path and each of its perturbations with each model."""
    _, row, path = item
    asked = {each.name: _network(each) for each in networks}
    asked |= dict(PLANNERS[name] for name in settings.models if name in PLANNERS)
    training = {each.name: each.training for each in networks}
    models = {each.name: each.options.model for each in networks}  # a row of the tables is of all seeds
    reference = REFERENCES[settings.reference]
    compared = settings.draws if settings.reference_draws is None else settings.reference_draws
    clean = {name: _answered(ask, path) for name, ask in asked.items()}
    clean_time, trials = _time(reference, path), list[RobustnessTrial]()
    for epsilon in SCALES:
        for draw in range(settings.draws if epsilon else 1):
            seed = np.random.SeedSequence(row, spawn_key=(SCALES.index(epsilon), draw))
            moved = perturbed(path, epsilon, seed) if epsilon else path
            own_time = against = np.nan
            if draw < compared:
                own_time, against = _time(reference, moved) if epsilon else clean_time, clean_time
            own = [
                _flown(
                    RobustnessTrial(models.get(name, name), epsilon, row, draw, own_time=own_time, clean_time=against,
                                    training=training.get(name)),
                    moved, _answered(ask, moved), clean[name],
                )
                for name, ask in asked.items()
            ]  # fmt: skip
            free = next((trial.travel_time for trial in own if trial.model == SHIPPED), np.nan)
            trials += [replace(trial, free_time=free) if trial.model in HELD_YAW else trial for trial in own]
    return trials


def _flown(begun: RobustnessTrial, path: Path, found: Answered | str, clean: Answered | str) -> RobustnessTrial:
    if isinstance(found, str):
        return replace(begun, reason=found)
    trajectory = Trajectory(path, found.profile, PAPER.airframe)
    flight = fly_geometric(trajectory, FLOWN)
    places, speeds = nearest_states(flight.flight, trajectory, trajectory.time_at(found.profile.s))
    needed = np.maximum(places / TOLERANCE[0], speeds / TOLERANCE[1])
    reached = tuple(float(np.mean(needed <= factor)) for factor in FACTORS)
    trial = replace(begun, travel_time=trajectory.duration, deviation=flight.deviation, reached=reached)
    if isinstance(clean, str):
        return trial
    return replace(
        trial,
        h_variation=float(np.abs(found.h - clean.h).max()),
        h_relative=float(np.abs(found.h / clean.h - 1.0).max()),
        speed_variation=float(np.abs(found.speed - clean.speed).max()),
        cosine_variation=float(np.abs(found.cosine - clean.cosine).max()),
    )


def _answered(ask: Ask, path: Path) -> Answered | str:
    """Return the answer, or the reason why there is none."""
    try:
        return ask(path)
    except CfplanError as error:
        return str(error)


def _network(trained: TrainedNetwork) -> Ask:
    def ask(path: Path) -> Answered:
        answers = answer(trained.network, path_inputs(path, NODES + 1)[None], trained.options.inputs)[0]
        return _answer(recover_profile(answers, path.end), path, answers[:, 0], answers[:, 1])

    return ask


def _time(planner: Planner, path: Path) -> float:
    try:
        return trajectory_by(profile_by(planner))(path).duration
    except CfplanError:
        return float("nan")


def tables(settings: Settings, rows: list[RobustnessTrial]) -> Iterator[Table]:
    """Yield the paper's table, how answers vary, and the trainings."""
    trials = ordered(rows, "model")
    yield robustness_table(trials, settings.reference)
    yield variation_table(trials)
    yield training_table(trials, "model")


STUDY = Study(Settings, work, tables, "--reference-draws 1 -o results/robustness.json")
