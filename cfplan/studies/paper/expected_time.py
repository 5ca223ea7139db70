"""How long all of the paper's tables take, from what their last results took, and what of them is there already."""

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from types import MappingProxyType

import numpy as np

from cfplan.errors import InputError
from cfplan.learning.paper.training import SequenceOptions
from cfplan.studies.items import SHORT, count_unfinished
from cfplan.studies.paper.all_tables import TABLES, is_current
from cfplan.studies.paper.hardware import LEARNED_FROM
from cfplan.studies.paper.robustness import ASKING, COMPARING, MODELS, SHIPPED, perturbed_paths
from cfplan.studies.result import StudyResult, read_result
from cfplan.version import REPOSITORY

SHIPPED_RESULTS = REPOSITORY / "results"  # what is known of a study that the folder has no result of
_EPOCHS = SequenceOptions().epochs
# How many steps of each kind a whole run of a study has, by the names in the detail `work` of its result; what a
# training sees is counted apart.
WHOLE = MappingProxyType({
    "architectures": {"path": 200}, "inputs": {"path": 200}, "robustness": dict.fromkeys(
        [COMPARING, *(f"{ASKING}{model}" for model in (*MODELS, SHIPPED))], perturbed_paths(100, 10)
    ),
    "yaw-consistency": {"pair": 100}, "baselines": {"path": 50, "corridor": 2000}, "hardware": {"plan": 136},
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
    training_seconds: float  # of the processor, of networks that no study before it trains; NaN where not known
    other_seconds: float  # likewise, which several processes share


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
        state, remark = ResultState.STALE, f"of commit {made.provenance.commit[:SHORT]}"
    seconds = (np.nan, np.nan) if quick else _seconds(name, made, trained)
    return Expected(name, state, remark, *seconds)


def _seconds(name: str, made: StudyResult | None, trained: set[str]) -> tuple[float, float]:
    """Return what a whole run takes for training and for the rest; `trained` are the networks that are trained then."""
    steps = _known(name) | _work(made)
    if not steps:
        return np.nan, np.nan
    training = 0.0
    for step, seconds in steps.items():
        network = step.removeprefix(TRAINING)
        if network != step and network not in trained:
            trained.add(network)
            training += seconds * _EPOCHS * SEEN.get(name, USUALLY_SEEN)
    other = sum(steps.get(step, np.nan) * count for step, count in WHOLE[name].items())
    return training, float(other)


def _work(result: StudyResult | None) -> dict[str, float]:
    """Return the seconds of one step of each kind."""
    tables = [table for table in result.details if table.name == "work"] if result else []
    return {row["step"]: row["seconds"] / row["count"] for table in tables for row in table.rows if row["count"]}


def _known(name: str) -> dict[str, float]:
    """Return the same of the results that come with cfplan, of which a study may have several: NAME-PART.json."""
    files = [SHIPPED_RESULTS / f"{name}.json", *sorted(SHIPPED_RESULTS.glob(f"{name}-*.json"))]
    return {step: each for file in files if file.is_file() for step, each in _work(read_result(file)).items()}
