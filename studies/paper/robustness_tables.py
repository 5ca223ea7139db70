"""The tables of the study of perturbed paths (robustness.py beside it): the paper's Table 2, and how answers vary."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cfplan.safety.limit_sets import PAPER
from cfplan.simulation.geometric_flight import LOST
from studies.paper.printed import ROBUSTNESS
from studies.paper.trials import PAPER_LAG, finite_mean
from studies.runner.result import Column, Table

SCALES = (0.0, 0.001, 0.01, 0.1)  # m
TOLERANCES = ((0.02, 0.1), (0.05, 0.25), (0.1, 0.5))  # m and m/s, within which a planned state counts as reached
SHIPPED = "the shipped planner, certified"  # yaw is free, as in the paper
SHIPPED_FIXED, SHIPPED_TANGENT = "the shipped planner, yaw fixed", "the shipped planner, yaw tangent"


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
    speed_variation: float = np.nan  # m/s, likewise of the speed at a node
    cosine_variation: float = np.nan  # largest difference of cos ψ
    reached: tuple[float, ...] = (np.nan,) * len(TOLERANCES)
    """Share of planned states that are reached in the time before them, by tolerance."""

    @property
    def failed(self) -> bool:
        """Return whether there was no flight, or one that crashed or was LOST."""
        return not self.deviation < LOST


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
        **{f"reached_{k + 1}": float(share) for k, share in enumerate(reached.mean(axis=0))},
        "paper_deviation": printed.deviation if printed else None,
        "paper_slower": printed.slower if printed else None,
        "paper_in_brt": printed.in_brt if printed else None,
    }


def variation_table(trials: Sequence[RobustnessTrial], names: Iterable[str]) -> Table:
    """Return how far outputs are from those along the clean path: the largest difference at a node of each trial.

    Of cos ψ also the largest of all draws of a path, mean over paths. Beside it, what a mode of yaw costs in time.
    """
    columns = (
        Column("model", "model"),
        Column("epsilon", "ε", "m", "g"),
        Column("paths", "", meaning="number of them"),
        Column("h_variation", "Δh", "", ".2f", meaning="largest change of h at a node, mean over trials"),
        Column("h_relative", "Δh/h", "%", ".1f", meaning="the same, as a share of h there"),
        Column("h_relative_median", "median", "%", ".1f", meaning="of trials"),
        Column("speed_variation", "Δv", "m/s", ".3f", meaning="the same of the speed at a node"),
        Column("cosine_variation", "Δcos ψ", "", ".4f", meaning="the same of cos ψ"),
        Column("cosine_median", "median", "", ".4f", meaning="of trials"),
        Column("cosine_p90", "p90", "", ".4f"),
        Column("cosine_most", "largest of all draws", "", ".4f", meaning="mean over paths"),
        Column("paper_variation", "paper", "", ".3f", meaning="of both outputs, in units that it does not name"),
        Column("slower_free", "time over yaw free", "%", "+.2f", meaning=f"of {SHIPPED}, on the same paths"),
    )  # fmt: skip
    free = {(each.epsilon, each.row, each.draw): each.travel_time for each in trials if each.model == SHIPPED}
    rows = []
    for name in names:
        for epsilon in SCALES[1:]:
            own = [trial for trial in trials if (trial.model, trial.epsilon) == (name, epsilon)]
            if own:
                rows.append(_varied(own, free))
    return Table("variation", "What a planner answers, against its answer along the clean path", columns, tuple(rows))


def _varied(own: Sequence[RobustnessTrial], free: Mapping[tuple[float, int, int], float]) -> dict[str, Any]:
    printed = ROBUSTNESS.get((own[0].model, own[0].epsilon))
    relative, cosines = _finite(each.h_relative for each in own), _finite(each.cosine_variation for each in own)
    by_path: dict[int, list[float]] = {}
    for trial in own:
        by_path.setdefault(trial.row, []).append(trial.cosine_variation)
    return {
        "model": own[0].model,
        "epsilon": own[0].epsilon,
        "paths": len(by_path),
        "h_variation": finite_mean(trial.h_variation for trial in own),
        "h_relative": float(relative.mean()),
        "h_relative_median": float(np.median(relative)),
        "speed_variation": finite_mean(trial.speed_variation for trial in own),
        "cosine_variation": float(cosines.mean()),
        "cosine_median": float(np.median(cosines)),
        "cosine_p90": float(np.quantile(cosines, 0.9)),
        "cosine_most": finite_mean(_finite(each).max() for each in by_path.values()),
        "paper_variation": printed.variation if printed else None,
        "slower_free": finite_mean(
            trial.travel_time / free.get((trial.epsilon, trial.row, trial.draw), np.nan) - 1.0 for trial in own
        )
        if own[0].model in (SHIPPED_FIXED, SHIPPED_TANGENT)
        else None,
    }


def _finite(values: Iterable[float]) -> NDArray:
    """Return those that are finite as an array that is never empty."""
    return np.array([value for value in values if np.isfinite(value)] or [np.nan])
