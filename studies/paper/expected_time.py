"""How long all of the paper's tables take, from what their last results took, and what of them is there already."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from types import MappingProxyType
from typing import Any

from cfplan.learning.paper.training import SequenceOptions

from cfplan.errors import InputError
from cfplan.version import REPOSITORY
from studies.paper.all_tables import TABLES, is_current
from studies.paper.hardware import LEARNED_FROM
from studies.paper.robustness import perturbed_paths, step_names
from studies.runner.items import SHORT, count_unfinished
from studies.runner.result import StudyResult, read_result

SHIPPED_RESULTS = REPOSITORY / "results"  # what is known of a study that the folder has no result of
_EPOCHS = SequenceOptions().epochs
# How many steps of each kind a whole run of a study has, by the names in the detail `work` of its result; what a
# training sees is counted apart.
WHOLE = MappingProxyType({
    "architectures": {"path": 200}, "inputs": {"path": 200}, "robustness": dict.fromkeys(
        step_names(), perturbed_paths(100, 10)
    ),
    "yaw-consistency": {"pair": 100}, "baselines": {"path": 50, "corridor": 2000}, "hardware": {"plan": 150},
    "simulators": {"flight": 64},
    "long": {"plan": 63},
})  # fmt: skip
SEEN = MappingProxyType({"hardware": LEARNED_FROM})  # paths of an epoch, where they are not USUALLY_SEEN
USUALLY_SEEN = 9849
TRAINING = "path through "  # before the name of a network


class ResultState(StrEnum):
    """What there is of a study's result."""

    MADE = "made by this commit"
    STALE = "stale"
    BEGUN = "begun"
    MISSING = "not made"


@dataclass(frozen=True, slots=True)
class Expected:
    """One study of `paper_tables`."""

    study: str
    state: ResultState
    remark: str  # of which commit a stale one is, or how much of it is done
    training_seconds: float  # of the processor, of networks that no study before it trains
    other_seconds: float  # likewise, which several processes share
    unknown: tuple[str, ...]  # steps of which no result says how long they take; they are not counted


def expected(folder: Path, *, quick: bool = False) -> list[Expected]:
    """Say of each study what is in the folder, and how long a whole run of it takes; of a quick one, nothing of that.

    Raises InputError where there is no such folder.
    """
    if not folder.is_dir():
        raise InputError("no such folder", where=str(folder), hint="make it first")
    trained: set[str] = set()
    return [_expected(name, folder / f"{name}.json", trained, quick=quick) for name in TABLES]


def _expected(name: str, file: Path, trained: set[str], *, quick: bool) -> Expected:
    made = read_result(file) if file.is_file() else None
    begun = count_unfinished(file)
    state, remark = ResultState.MISSING, ""
    if made is not None and is_current(made, quick=quick):
        state = ResultState.MADE
    elif begun:
        state, remark = ResultState.BEGUN, f"{begun} items done"
    elif made is not None:
        state, remark = ResultState.STALE, f"of {made.provenance.commit[:SHORT]}"
    seconds = (0.0, 0.0, tuple(WHOLE[name])) if quick else _seconds(name, made, trained)
    return Expected(name, state, remark, *seconds)


def _seconds(name: str, made: StudyResult | None, trained: set[str]) -> tuple[float, float, tuple[str, ...]]:
    """Return what a whole run takes for training and for the rest, and which steps of that are not known.

    `trained` are the networks that are trained by then.
    """
    steps = _known(name) | _work(made)
    training = 0.0
    for step, seconds in steps.items():
        network = step.removeprefix(TRAINING)
        if network != step and network not in trained:
            trained.add(network)
            training += seconds * _EPOCHS * SEEN.get(name, USUALLY_SEEN)
    whole = WHOLE[name]
    other = sum(steps[step] * count for step, count in whole.items() if step in steps)
    return training, other, tuple(step for step in whole if step not in steps)


def _work(result: StudyResult | None) -> dict[str, float]:
    """Return the seconds of one step of each kind; of older results, what their trainings and plans took."""
    if result is None:
        return {}
    tables = {table.name: table.rows for table in (*result.tables, *result.details)}
    training = {
        f"{TRAINING}{' '.join(row[key] for key in ('limits', 'network') if key in row)}": row["seconds"]
        / (row["epochs"] * row["learned_from"])
        for row in tables.get("training", ())
    }
    steps = {row["step"]: row["seconds"] / row["count"] for row in tables.get("work", ()) if row["count"]}
    return training | _planning(tables.get("trials", ())) | steps


def _planning(trials: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return what planning took for a path, by all planners."""
    paths = {(row.get("part"), row.get("row", row.get("seed"))) for row in trials}
    taken = [row["seconds"] for row in trials if row.get("seconds") is not None and not row.get("repaired")]
    return {"path": sum(taken) / len(paths)} if taken else {}


def _known(name: str) -> dict[str, float]:
    """Return the same of the results that come with cfplan, of which a study may have several: NAME-PART.json."""
    files = [SHIPPED_RESULTS / f"{name}.json", *sorted(SHIPPED_RESULTS.glob(f"{name}-*.json"))]
    return {step: each for file in files if file.is_file() for step, each in _work(read_result(file)).items()}
