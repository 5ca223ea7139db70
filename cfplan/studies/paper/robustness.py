"""The paper's Table 2: networks trained on clean and on perturbed paths, asked about perturbed ones.

For each path and each of its perturbations by at most ε: the plan is flown by the geometric controller with the paper's
motor lag. Beside the networks, as they are, the planner that ships, certified. One network is not in the paper: it
learns from perturbed paths with labels of their own, where the paper keeps the clean path's.
"""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
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
from cfplan.learning.dataset_spec import Relabel
from cfplan.learning.paper.recovery import recover_profile
from cfplan.learning.paper.sequences import path_inputs
from cfplan.learning.paper.training import SequenceOptions, answer
from cfplan.planners.baselines.toppquad import plan_toppquad
from cfplan.planners.expert.expert import plan_expert
from cfplan.planners.task import Planner
from cfplan.safety.limit_sets import PAPER
from cfplan.simulation.geometric_flight import LOST, fly_geometric, nearest_states
from cfplan.studies.items import HERE, Progress, Running, work_table, work_through
from cfplan.studies.paper.architectures import settings_of, training_steps, training_table
from cfplan.studies.paper.networks import (
    DATA,
    NETWORKS,
    PaperItem,
    TrainedNetwork,
    identities,
    paper_data,
    paper_items,
    trained_networks,
)
from cfplan.studies.paper.printed import ROBUSTNESS, TEST
from cfplan.studies.paper.trials import FLOWN, NODES, PAPER_LAG, finite_mean, profile_by, shipped_profile, trajectory_by
from cfplan.studies.result import Column, StudyResult, Table, detail_table
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.trajectory import Trajectory

SCALES = (0.0, 0.001, 0.01, 0.1)  # m
MODELS = MappingProxyType(
    {
        each.name: each
        for each in (
            *(SequenceOptions(epsilon=epsilon) for epsilon in SCALES),
            SequenceOptions(epsilon=SCALES[-1], relabel=Relabel.SOLVE),
        )
    }
)
SHIPPED, SHIPPED_NAME = "the shipped planner, certified", "shipped"  # in tables, and where it is asked for
REFERENCES: Mapping[str, Planner] = MappingProxyType({"toppquad": plan_toppquad, "expert": plan_expert})
COMPARING, ASKING = "perturbed path, compared", "perturbed path, "  # steps of the work; behind the second, a model
TOLERANCES = ((0.02, 0.1), (0.05, 0.25), (0.1, 0.5))  # m and m/s, within which a planned state counts as reached


class Answered(NamedTuple):
    """What a model answers: a profile, and h and cos ψ at the nodes, which is all that a network says."""

    profile: SpeedProfile
    h: NDArray  # (N,)
    cosine: NDArray  # (N,)


@dataclass(frozen=True, slots=True)
class RobustnessTrial:
    """One path, perturbed once, planned by one model. NaN where there was nothing to measure."""

    model: str
    epsilon: float  # m
    row: int  # of the dataset
    draw: int
    reason: str = ""  # why there is no flight
    travel_time: float = np.nan  # s
    own_time: float = np.nan  # s, of the reference on the same perturbed path
    clean_time: float = np.nan  # s, of the reference on the clean path
    seconds: float = np.nan  # of the processor, to plan, fly and compare
    deviation: float = np.nan  # m, LOST where it failed
    h_variation: float = np.nan  # largest difference of h from that on the clean path
    h_relative: float = np.nan  # the same, relative
    cosine_variation: float = np.nan  # largest difference of cos ψ
    reached: tuple[float, ...] = (np.nan,) * len(TOLERANCES)
    """Share of planned states that are reached in the time before them, by tolerance."""

    @property
    def failed(self) -> bool:
        """Return whether there was no flight, or one that crashed or was LOST."""
        return not self.deviation < LOST


def robustness(
    *,
    paths: int = 100,
    draws: int = 10,
    models: Sequence[str] = (*MODELS, SHIPPED_NAME),
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
        if name not in (*MODELS, SHIPPED_NAME):
            known = ", ".join((*MODELS, SHIPPED_NAME))
            raise InputError(f"unknown model {name!r}", where="models", hint=f"known: {known}")
    if draws < 1:
        raise InputError("draws must be at least 1", where="draws", hint="give --draws 10, as is usual")
    wanted = [MODELS[name] for name in models if name != SHIPPED_NAME]
    with paper_data(data, networks, paths, epochs=epochs, quick=quick) as material:
        trained = trained_networks(material, wanted, progress)
        settings = settings_of(material, quick) | {
            "draws": draws, "models": list(models), "reference": reference,
            "reference_draws": draws if reference_draws is None else reference_draws,
        }  # fmt: skip
        unseen = replace(material, parts={TEST: material.parts[TEST]})
        asked = Questions(tuple(trained), SHIPPED_NAME in models, draws, reference, settings["reference_draws"])
        work = work_through(
            "robustness", settings | {"networks": identities(trained)}, partial(_trials_of, asked),
            paper_items(unseen), running, progress,
        )  # fmt: skip
    trials = [RobustnessTrial(**trial) for value in work.values for trial in value["trials"]]
    tables = (
        robustness_table(trials, list(asked.models()), reference),
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


def perturbed_paths(paths: int, draws: int) -> int:
    """Return how many paths are asked about: each as it is, and its draws of each other scale."""
    return paths * (1 + draws * (len(SCALES) - 1))


@dataclass(frozen=True, slots=True)
class Questions:
    """What is asked about each path."""

    networks: tuple[TrainedNetwork, ...]
    shipped: bool  # whether the planner that ships is asked too
    draws: int
    reference: str
    reference_draws: int

    def models(self) -> dict[str, Callable[[Path], Answered]]:
        """Return those that are asked, by name."""
        return {each.name: _network(each) for each in self.networks} | ({SHIPPED: _shipped} if self.shipped else {})


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
        cosine_variation=float(np.abs(found.cosine - clean.cosine).max()),
    )


def _answered(ask: Callable[[Path], Answered], path: Path) -> Answered | str:
    """Return the answer, or why there is none."""
    try:
        return ask(path)
    except CfplanError as error:
        return str(error)


def _network(trained: TrainedNetwork) -> Callable[[Path], Answered]:
    def ask(path: Path) -> Answered:
        answers = answer(trained.network, path_inputs(path, NODES + 1)[None], trained.options.inputs)[0]
        return Answered(recover_profile(answers, path.end), answers[:, 0], answers[:, 1])

    return ask


def _shipped(path: Path) -> Answered:
    profile = shipped_profile(path)
    return Answered(profile, profile.h, np.cos(profile.yaw))


def _time(planner: Planner, path: Path) -> float:
    try:
        return trajectory_by(profile_by(planner))(path).duration
    except CfplanError:
        return float("nan")


def robustness_table(trials: Sequence[RobustnessTrial], names: Iterable[str], reference: str) -> Table:
    """Return the paper's Table 2 with the paper's numbers beside."""
    first, second, third = (f"{100 * place:g} cm, {100 * speed:g} cm/s" for place, speed in TOLERANCES)
    columns = (
        Column("model", "model"),
        Column("epsilon", "ε", "m", "g"),
        Column("trials"),
        Column("deviation", "largest deviation", "m", ".3f", meaning=f"mean; a failure counts as {LOST:g} m"),
        Column("deviation_flown", "without failures", "m", ".3f"),
        Column("paper_deviation", "paper", "m", ".3f"),
        Column("failed", "failures", of="trials", meaning=f"no plan, a crash, or {LOST:g} m from its place"),
        Column("slower", f"time over {reference}, same path", "%", "+.2f"),
        Column("slower_clean", "clean path", "%", "+.2f"),
        Column("paper_slower", "paper", "%", "+.2f", meaning="it does not say on which of the two"),
        Column("h_variation", "variation of h", "", ".3f", meaning="largest change at a node, mean over trials"),
        Column("h_relative", "relative", "%", ".1f", meaning="the same, as a share of h there"),
        Column("cosine_variation", "variation of cos ψ", "", ".3f", meaning="largest change at a node, likewise"),
        Column("paper_variation", "paper", "", ".3f", meaning="of both outputs, in units that it does not name"),
        Column("reached_1", f"in BRT: {first}", "%", ".1f"),
        Column(
            "reached_2", second, "%", ".1f",
            meaning="share of planned states whose position is passed within that in the time before, at a velocity "
            "within that, by the controller from where it is",
        ),
        Column("reached_3", third, "%", ".1f"),
        Column("paper_in_brt", "paper", "%", ".1f", meaning="within a tolerance that it does not name"),
    )  # fmt: skip
    rows = []
    for name in names:
        for epsilon in SCALES:
            own = [trial for trial in trials if (trial.model, trial.epsilon) == (name, epsilon)]
            if own:
                rows.append(_row(own))
    title = f"Perturbed paths, {PAPER.limits.speed:g} m/s, motor lag {PAPER_LAG:g} s"
    return Table("robustness", title, columns, tuple(rows))


def _row(own: Sequence[RobustnessTrial]) -> dict[str, Any]:
    printed = ROBUSTNESS.get((own[0].model, own[0].epsilon))
    reached = np.array([trial.reached if not trial.reason else (0.0,) * len(TOLERANCES) for trial in own])
    return {
        "model": own[0].model,
        "epsilon": own[0].epsilon,
        "trials": len(own),
        "deviation": finite_mean(LOST if trial.failed else trial.deviation for trial in own),
        "deviation_flown": finite_mean(trial.deviation for trial in own if not trial.failed),
        "failed": sum(trial.failed for trial in own),
        "slower": finite_mean(trial.travel_time / trial.own_time - 1.0 for trial in own),
        "slower_clean": finite_mean(trial.travel_time / trial.clean_time - 1.0 for trial in own),
        "h_variation": finite_mean(trial.h_variation for trial in own),
        "h_relative": finite_mean(trial.h_relative for trial in own),
        "cosine_variation": finite_mean(trial.cosine_variation for trial in own),
        **{f"reached_{k + 1}": float(share) for k, share in enumerate(reached.mean(axis=0))},
        "paper_deviation": printed.deviation if printed else None,
        "paper_slower": printed.slower if printed else None,
        "paper_variation": printed.variation if printed else None,
        "paper_in_brt": printed.in_brt if printed else None,
    }
