"""The tables of the study robustness.py: the paper's Table 2, and the variation of the answers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from cfplan.safety.limit_sets import PAPER
from studies.paper.printed import ROBUSTNESS, paper_column
from studies.paper.trials import DEVIATION, DEVIATION_FLOWN, FAILED, PAPER_LAG, SPREAD
from studies.runner.reductions import count, finite, mean, median, quantile
from studies.runner.result import Column, Table, table

SCALES = (0.0, 0.001, 0.01, 0.1)  # m
TOLERANCE = (0.02, 0.1)  # m and m/s, times a factor: within it a planned state counts as reached
FACTORS = (0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 7.5, 10.0)
SHOWN_FACTORS = (1.0, 2.5, 5.0)
CLEAN = ("LSTM", 0.001)  # model and ε, m, whose printed in-BRT probability determines the paper's tolerance
SHIPPED = "the shipped planner, certified"  # yaw is free, as in the paper
SHIPPED_FIXED, SHIPPED_TANGENT = HELD_YAW = ("the shipped planner, yaw fixed", "the shipped planner, yaw tangent")


@dataclass(frozen=True, slots=True)
class RobustnessTrial:
    """One path, perturbed once, planned by one model. NaN where there was nothing to measure."""

    model: str
    epsilon: float  # m
    row: int  # of the dataset
    draw: int
    reason: str = ""  # why there is no flight; empty if there is one
    travel_time: float = np.nan  # s
    own_time: float = np.nan  # s, of the reference on the same perturbed path
    clean_time: float = np.nan  # s, of the reference on the clean path
    free_time: float = np.nan  # s, of SHIPPED on the same perturbed path; only for HELD_YAW
    deviation: float = np.nan  # m, LOST where it failed
    h_variation: float = np.nan  # largest difference of h from the answer along the clean path
    h_relative: float = np.nan  # the same, relative
    speed_variation: float = np.nan  # m/s, likewise of the speed at a node
    cosine_variation: float = np.nan  # largest difference of cos ψ
    reached: Sequence[float] = (0.0,) * len(FACTORS)
    """Fraction of planned states that are reached from the previous one in the planned time, by FACTORS."""
    training: Mapping[str, Any] | None = None  # of the network that planned


def _reached(key: str, title: str, factor: float, meaning: str = "") -> Column:
    value = mean(lambda trial: np.interp(factor, FACTORS, trial.reached) if np.isfinite(factor) else np.nan)
    return Column(f"reached_{key}", title, "%", ".1f", meaning=meaning, value=value)


def papers_factor(trials: Sequence[RobustnessTrial]) -> float:
    """Return the factor of TOLERANCE at which CLEAN reaches the fraction that the paper prints; NaN without its trials.

    It is interpolated, and at most the largest of FACTORS.
    """
    reached = [trial.reached for trial in trials if (trial.model, trial.epsilon) == CLEAN]
    return float(np.interp(ROBUSTNESS[CLEAN].in_brt, np.mean(reached, axis=0), FACTORS)) if reached else np.nan


def _size(factor: float) -> str:
    """Return a tolerance in words."""
    return f"{100 * factor * TOLERANCE[0]:.3g} cm, {100 * factor * TOLERANCE[1]:.3g} cm/s"


def _over(time: str) -> Any:
    return mean(lambda trial: trial.travel_time / getattr(trial, time) - 1.0)


_paper = partial(paper_column, ROBUSTNESS, by=("model", "epsilon"))


def robustness_table(trials: Sequence[RobustnessTrial], reference: str) -> Table:
    """Return the paper's Table 2 beside the paper's numbers."""
    first, second, third = SHOWN_FACTORS
    papers = papers_factor(trials)
    columns = (
        Column("model", "model"),
        Column("epsilon", "ε", "m", "g"),
        Column("trials", value=count()),
        DEVIATION,
        SPREAD,
        DEVIATION_FLOWN,
        _paper("deviation", unit="m", spec=".3f"),
        replace(FAILED, of="trials"),
        Column("slower", f"time over {reference}, same path", "%", "+.2f", value=_over("own_time")),
        Column("slower_clean", "clean path", "%", "+.2f", value=_over("clean_time")),
        _paper("slower", unit="%", spec="+.2f", meaning="it does not say on which of the two"),
        _reached("1", f"in BRT: {_size(first)}", first),
        _reached("2", _size(second), second, "fraction of planned states whose position is passed within that in the "
                 "time before, at a velocity within that, by the controller from where it is"),
        _reached("3", _size(third), third),
        _reached("papers", "at the paper's tolerance", papers,
                 f"{_size(papers)}: where the LSTM reaches the paper's {100 * ROBUSTNESS[CLEAN].in_brt:g} % at "
                 f"ε = {CLEAN[1]:g} m"),
        _paper("in_brt", unit="%", spec=".1f", meaning="within a tolerance that it does not name"),
    )  # fmt: skip
    title = f"Perturbed paths, {PAPER.limits.speed:g} m/s, motor lag {PAPER_LAG:g} s"
    return table("robustness", title, columns, trials, by=("model", "epsilon"))


def variation_table(trials: Sequence[RobustnessTrial]) -> Table:
    """Return the variation of outputs against the clean path: the largest difference at a node in each trial.

    For cos ψ, also the largest over all draws of a path, averaged over paths. A further column is the time lost by
    fixed or tangent yaw.
    """
    columns = (
        Column("model", "model"),
        Column("epsilon", "ε", "m", "g"),
        Column("paths", "", meaning="number of them", value=lambda group: len(_by_path(group))),
        Column("h_variation", "Δh", "", ".2f", meaning="largest change of h at a node, mean over trials",
               value=mean("h_variation")),
        Column("h_relative", "Δh/h", "%", ".1f", meaning="the same, as a fraction of h there",
               value=mean("h_relative")),
        Column("h_relative_median", "median", "%", ".1f", meaning="of trials", value=median("h_relative")),
        Column("speed_variation", "Δv", "m/s", ".3f", meaning="the same of the speed at a node",
               value=mean("speed_variation")),
        Column("cosine_variation", "Δcos ψ", "", ".4f", meaning="the same of cos ψ", value=mean("cosine_variation")),
        Column("cosine_median", "median", "", ".4f", meaning="of trials", value=median("cosine_variation")),
        Column("cosine_p90", "p90", "", ".4f", value=quantile("cosine_variation", 0.9)),
        Column("cosine_most", "largest of all draws", "", ".4f", meaning="mean over paths", value=_mean_of_largest),
        _paper("variation", spec=".3f", meaning="of both outputs, in units that it does not name"),
        Column("slower_free", "time over yaw free", "%", "+.2f", meaning=f"of {SHIPPED}, on the same paths",
               value=_over("free_time")),
    )  # fmt: skip
    moved = [trial for trial in trials if trial.epsilon]
    title = "What a planner answers, against its answer along the clean path"
    return table("variation", title, columns, moved, by=("model", "epsilon"))


def _by_path(trials: Sequence[RobustnessTrial]) -> dict[int, list[RobustnessTrial]]:
    paths: dict[int, list[RobustnessTrial]] = {}
    for trial in trials:
        paths.setdefault(trial.row, []).append(trial)
    return paths


def _mean_of_largest(trials: Sequence[RobustnessTrial]) -> float:
    largest = [finite(own, "cosine_variation").max() for own in _by_path(trials).values()]
    return mean(float)(largest)
