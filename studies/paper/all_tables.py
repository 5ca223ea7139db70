"""All tables of the paper that cfplan makes, one study after the other, each with its result in a file of its own.

A run that was stopped goes on: results of the same commit are kept, those of another are made anew, none are mixed.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from cfplan.errors import InputError
from cfplan.version import UNKNOWN
from studies.long_paths import long_paths
from studies.paper.architectures import architectures
from studies.paper.baselines import baselines
from studies.paper.hardware import hardware
from studies.paper.inputs import inputs_study
from studies.paper.robustness import robustness
from studies.paper.simulators import simulators
from studies.paper.yaw_consistency import yaw_consistency
from studies.runner.items import HERE, Progress, Running, forget_unfinished
from studies.runner.provenance import provenance
from studies.runner.result import StudyResult, read_result

TABLES: MappingProxyType[str, Callable[..., StudyResult]] = MappingProxyType({
    "architectures": architectures, "inputs": inputs_study, "robustness": robustness,
    "yaw-consistency": yaw_consistency, "baselines": baselines, "hardware": hardware, "simulators": simulators,
    "long": long_paths,
})  # fmt: skip
AT_ONCE = ("long",)  # compares times on one computer, so it is made in one process
QUICK: MappingProxyType[str, dict[str, Any]] = MappingProxyType({
    "architectures": {"paths": 2, "quick": True}, "inputs": {"paths": 2, "quick": True},
    "robustness": {"paths": 1, "draws": 1, "quick": True}, "yaw-consistency": {"pairs": 2},
    "baselines": {"paths": 1, "quick": True}, "hardware": {"paths": 1, "quick": True},
    "simulators": {"paths": 1, "quick": True},
    "long": {"paths": 1, "repeats": 1, "lengths": (20.0, 40.0)},
})  # fmt: skip


class MadeTables(NamedTuple):
    """What became of one study."""

    result: StudyResult
    file: Path
    kept: bool  # as it was made before
    seconds: float  # that it took


def paper_tables(
    folder: Path,
    *,
    quick: bool = False,
    running: Running = HERE,
    begin: Callable[[str], Progress] = lambda name: lambda done, total: None,
    tables: MappingProxyType[str, Callable[..., StudyResult]] = TABLES,
) -> list[MadeTables]:
    """Make every table's study and write its result to `folder`; an interrupt ends it after the study under way.

    `begin` is told the name of each study and returns what is told of its progress; `running` says who works.

    Raises:
        InputError: no such folder or no dataset; what was made by then is kept.
    """
    if not folder.is_dir():
        raise InputError("no such folder", where=str(folder), hint="make it first")
    made = []
    for name, study in tables.items():
        file, begun = folder / f"{name}.json", time.monotonic()
        kept = file.is_file() and is_current(read_result(file), quick=quick)
        own = {"running": replace(running, result=file)} if name not in AT_ONCE else {}
        result = read_result(file) if kept else study(**(QUICK[name] if quick else {}), **own, progress=begin(name))
        if not kept:
            result.write(file)
        if not result.interrupted:
            forget_unfinished(file)
        made.append(MadeTables(result, file, kept, time.monotonic() - begun))
        if result.interrupted:
            break
    return made


def is_current(result: StudyResult, *, quick: bool) -> bool:
    """Return whether it is whole and of this commit, with nothing changed then or now."""
    now, then = provenance(), result.provenance
    same = then.commit == now.commit != UNKNOWN and not (then.modified or now.modified)
    return same and not result.interrupted and bool(result.settings.get("quick", False)) == quick
