"""The paper's Table 2: networks trained on clean and on perturbed paths, asked about perturbed ones.

For each path and each of its perturbations by at most ε: the plan is flown by the geometric controller with the paper's
motor lag. Beside the networks, as they are: the planner that ships, certified, in each mode of yaw, the expert and
TOPPQuad. One network is not in the paper: it learns from perturbed paths with labels of their own, where the paper
keeps the clean path's.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path as FilePath
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import CfplanError, InputError
from cfplan.geometry.path import Path
from cfplan.geometry.random_paths import perturbed
from cfplan.geometry.yaw import YawMode
from cfplan.learning.dataset_spec import Relabel
from cfplan.learning.paper.recovery import recover_profile
from cfplan.learning.paper.sequences import path_inputs
from cfplan.learning.paper.training import SequenceOptions, answer
from cfplan.planners.baselines.toppquad import plan_toppquad
from cfplan.planners.expert.expert import plan_expert
from cfplan.planners.task import Planner
from cfplan.safety.limit_sets import PAPER
from cfplan.simulation.geometric_flight import fly_geometric, nearest_states
from studies.runner.items import HERE, Progress, Running, work_table, work_through
from studies.paper.architectures import settings_of, training_steps, training_table
from studies.paper.networks import (
    DATA,
    NETWORKS,
    PaperItem,
    TrainedNetwork,
    identities,
    paper_data,
    paper_items,
    trained_networks,
)
from studies.paper.printed import TEST
from studies.paper.robustness_tables import (
    SCALES,
    SHIPPED,
    SHIPPED_FIXED,
    SHIPPED_TANGENT,
    TOLERANCES,
    RobustnessTrial,
    robustness_table,
    variation_table,
)
from studies.paper.trials import (
    EXPERT,
    FLOWN,
    NODES,
    TOPPQUAD,
    Plan,
    profile_by,
    shipped_profile,
    trajectory_by,
)
from studies.runner.result import StudyResult, detail_table
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.trajectory import Trajectory

MODELS = MappingProxyType(
    {
        each.name: each
        for each in (
            *(SequenceOptions(epsilon=epsilon) for epsilon in SCALES),
            SequenceOptions(epsilon=SCALES[-1], relabel=Relabel.SOLVE),
        )
    }
)
REFERENCES: Mapping[str, Planner] = MappingProxyType({"toppquad": plan_toppquad, "expert": plan_expert})
COMPARING, ASKING = "perturbed path, compared", "perturbed path, "  # steps of the work; behind the second, a model


class Answered(NamedTuple):
    """What a model answers: a profile, and h and cos ψ at the nodes, which is all that a network says."""

    profile: SpeedProfile
    h: NDArray  # (N,)
    cosine: NDArray  # (N,)
    speed: NDArray  # (N,) m/s, along the path that it was asked about


Ask = Callable[[Path], Answered]  # raises CfplanError where there is no answer


def _planner(plan: Plan) -> Ask:
    def ask(path: Path) -> Answered:
        profile = plan(path)
        return _answer(profile, path, profile.h, np.cos(profile.yaw))

    return ask


def _answer(profile: SpeedProfile, path: Path, h: NDArray, cosine: NDArray) -> Answered:
    places = np.linspace(0.0, path.end, len(h))
    return Answered(profile, h, cosine, np.linalg.norm(path(places, 1), axis=1) * np.sqrt(h))


PLANNERS: Mapping[str, tuple[str, Ask]] = MappingProxyType(  # besides the networks: their names in tables
    {
        "shipped": (SHIPPED, _planner(shipped_profile)),
        "shipped-fixed": (SHIPPED_FIXED, _planner(partial(shipped_profile, yaw=YawMode.FIXED))),
        "shipped-tangent": (SHIPPED_TANGENT, _planner(partial(shipped_profile, yaw=YawMode.TANGENT))),
        "expert": (EXPERT, _planner(profile_by(plan_expert))),
        "toppquad": (TOPPQUAD, _planner(profile_by(plan_toppquad))),
    }
)
USUAL = (*MODELS, *(name for name in PLANNERS if name != "toppquad"))  # that takes 18 s a path, all others 10


def robustness(
    *,
    paths: int = 100,
    draws: int = 10,
    models: Sequence[str] = USUAL,
    reference: str = "toppquad",
    reference_draws: int | None = None,
    data: FilePath = DATA,
    networks: FilePath = NETWORKS,
    epochs: int | None = None,
    quick: bool = False,
    running: Running = HERE,
    progress: Progress = lambda done, total: None,
) -> StudyResult:
    """Perturb `paths` paths for testing, `draws` times each; networks are trained if need be.

    `reference` says whose travel times are compared with, toppquad or expert; `reference_draws`, of how many draws,
    of all where it is None.

    Raises:
        InputError: an unknown model, no such dataset, or fewer paths in it.
    """
    for name in models:
        if name not in (*MODELS, *PLANNERS):
            known = ", ".join((*MODELS, *PLANNERS))
            raise InputError(f"unknown model {name!r}", where="models", hint=f"known: {known}")
    if draws < 1:
        raise InputError("draws must be at least 1", where="draws", hint="give --draws 10, as is usual")
    wanted = [MODELS[name] for name in models if name in MODELS]
    planners = tuple(name for name in models if name in PLANNERS)
    with paper_data(data, networks, paths, epochs=epochs, quick=quick) as material:
        trained = trained_networks(material, wanted, progress)
        settings = settings_of(material, quick) | {
            "draws": draws, "models": list(models), "reference": reference,
            "reference_draws": draws if reference_draws is None else reference_draws,
        }  # fmt: skip
        unseen = replace(material, parts={TEST: material.parts[TEST]})
        asked = Questions(tuple(trained), planners, draws, reference, settings["reference_draws"])
        work = work_through(
            "robustness", settings | {"networks": identities(trained)}, partial(_trials_of, asked),
            paper_items(unseen), running, progress,
        )  # fmt: skip
    trials = [RobustnessTrial(**trial) for value in work.values for trial in value["trials"]]
    tables = (
        robustness_table(trials, list(asked.models()), reference),
        variation_table(trials, list(asked.models())),
        *([training_table(trained, material)] if trained else []),
    )
    compared = sum(value["compared"] for value in work.values)
    steps = training_steps(trained, settings["learned_from"]) | {
        COMPARING: (compared, sum(value["comparing_seconds"] for value in work.values))
    }
    for name in asked.models():
        own = [trial.seconds for trial in trials if trial.model == name]
        steps[f"{ASKING}{name}"] = (len(own), sum(own))
    details = (detail_table("trials", trials), work_table(steps))
    return StudyResult("robustness", settings, tables, details, work.interrupted)


def step_names() -> list[str]:
    """Return the names of the steps of a usual run, as its result counts them."""
    return [COMPARING, *(f"{ASKING}{PLANNERS[name][0] if name in PLANNERS else name}" for name in USUAL)]


def perturbed_paths(paths: int, draws: int) -> int:
    """Return how many paths are asked about: each as it is, and its draws of each other scale."""
    return paths * (1 + draws * (len(SCALES) - 1))


@dataclass(frozen=True, slots=True)
class Questions:
    """What is asked about each path."""

    networks: tuple[TrainedNetwork, ...]
    planners: tuple[str, ...]  # of PLANNERS
    draws: int
    reference: str
    reference_draws: int

    def models(self) -> dict[str, Ask]:
        """Return those that are asked, by name."""
        return {each.name: _network(each) for each in self.networks} | dict(PLANNERS[name] for name in self.planners)


def _trials_of(questions: Questions, item: PaperItem) -> dict[str, Any]:
    """Ask each model about the path and about each of its perturbations."""
    _, row, path = item
    asked, reference = questions.models(), REFERENCES[questions.reference]
    clean = {name: _answered(ask, path) for name, ask in asked.items()}
    trials, times, comparing = [], [], 0.0
    for epsilon in SCALES:
        for draw in range(questions.draws if epsilon else 1):
            seed = np.random.SeedSequence(row, spawn_key=(SCALES.index(epsilon), draw))
            moved = perturbed(path, epsilon, seed) if epsilon else path
            own_time = against = np.nan
            if draw < questions.reference_draws:
                begun = time.process_time()
                times.append(_time(reference, moved))
                comparing += time.process_time() - begun
                own_time, against = times[-1], times[0]
            for name, ask in asked.items():
                begun = time.process_time()
                trial = RobustnessTrial(name, epsilon, row, draw, own_time=own_time, clean_time=against)
                trial = _flown(trial, moved, _answered(ask, moved), clean[name])
                trials.append(replace(trial, seconds=time.process_time() - begun))
    return {"trials": trials, "compared": len(times), "comparing_seconds": comparing}


def _flown(begun: RobustnessTrial, path: Path, found: Answered | str, clean: Answered | str) -> RobustnessTrial:
    if isinstance(found, str):
        return replace(begun, reason=found)
    trajectory = Trajectory(path, found.profile, PAPER.airframe)
    flight = fly_geometric(trajectory, FLOWN)
    places, speeds = nearest_states(flight.flight, trajectory, trajectory.time_at(found.profile.s))
    reached = tuple(float(np.mean((places <= place) & (speeds <= speed))) for place, speed in TOLERANCES)
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
    """Return the answer, or why there is none."""
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
