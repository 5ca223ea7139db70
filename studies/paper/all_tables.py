"""Make the results for all of the paper's tables, one study after another.

A run that was stopped resumes: a result of the present sources and settings is kept, any other is measured again,
starting from its finished cases.
"""

import importlib
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from cfplan.errors import InputError
from studies import STUDIES
from studies.runner.cases import Effort, plain, run_study, write_result
from studies.runner.result import StudyResult, read_result
from studies.runner.study import Study

QUICK: Mapping[str, Mapping[str, Any]] = MappingProxyType({
    "architectures": {"paths": 2, "quick": True}, "inputs": {"paths": 2, "quick": True},
    "labels": {"paths": 1, "quick": True},
    "robustness": {"paths": 1, "draws": 1, "quick": True}, "yaw-consistency": {"pairs": 2},
    "baselines": {"paths": 1, "quick": True}, "hardware": {"paths": 1, "quick": True},
    "simulators": {"paths": 1, "others": 1, "quick": True}, "search": {"quick": True},
})  # fmt: skip
"""The studies, each with settings for a quick try; a full run uses their defaults, which are the paper's settings."""


@dataclass(frozen=True, slots=True)
class Made:
    """The result of one study."""

    file: Path
    result: StudyResult
    kept: bool  # it was up to date and was not measured again


def paper_results(
    folder: Path, *, quick: bool = False, effort: Effort | None = None, studies: Mapping[str, Mapping[str, Any]] = QUICK
) -> Iterator[Made]:
    """Write each study's result to `folder` and yield it; after an interrupt no further study is run.

    `studies` maps each study to its quick settings, which are used with `quick`.

    Raises:
        InputError: no such folder or no dataset; results that are already written are kept.
    """
    if not folder.is_dir():
        raise InputError("no such folder", where=str(folder), hint="make it first")
    for name, settings in studies.items():
        made = _made(name, folder / f"{name}.json", settings if quick else {}, effort or Effort())
        yield made
        if made.result.interrupted:
            return


def _made(name: str, file: Path, given: Mapping[str, Any], effort: Effort) -> Made:
    study: Study = importlib.import_module(STUDIES[name]).STUDY
    settings = study.settings(**given)
    before = read_result(file) if file.is_file() else None
    if before is not None and _is_current(before, settings):
        return Made(file, before, kept=True)
    result = run_study(name, STUDIES[name], study, settings, replace(effort, output=file))
    write_result(result, file)
    return Made(file, result, kept=False)


def _is_current(result: StudyResult, settings: Any) -> bool:
    fresh = result.provenance is not None and result.provenance.fresh
    return fresh and not result.interrupted and result.settings == plain(asdict(settings))
