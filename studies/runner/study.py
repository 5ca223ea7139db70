"""A study: its settings, its cases, one function from a case to what is measured of it, and the tables of all rows.

A module of `studies` holds one as STUDY; its docstring is the study's help. Everything else is the runner's: options,
help and record follow from the settings; processes, clusters, seeds, resuming and progress are the same for all.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from studies.runner.result import Table

Progress = Callable[[int, int], None]  # told how many of how many are done


@dataclass(frozen=True, slots=True)
class Run:
    """How the runner works, for studies that prepare something by several processes themselves."""

    scratch: Path  # a folder that is deleted after the run
    workers: int = 1  # processes on this machine
    scheduler: str | None = None  # address of a Dask cluster that works instead
    progress: Progress = lambda done, total: None  # of the preparation


@dataclass(frozen=True, slots=True)
class Work:
    """The cases of a run, ready to be measured."""

    cases: Mapping[str, Any]  # by their names
    measure: Callable[[Any], Any]  # case → a row, or a list of rows; both picklable
    row: Callable[..., Any] = dict  # rebuilds a row from its fields: the row's dataclass
    identity: Mapping[str, Any] = field(default_factory=dict)  # what the rows depend on besides settings and sources


@dataclass(frozen=True, slots=True)
class Study:
    """What the runner needs to know of a study."""

    settings: type  # a dataclass; its fields are made by `option` and `argument`
    work: Callable[[Any, Run], Work]  # settings, run → what is to be measured
    tables: Callable[[Any, list[Any]], Iterable[Table]]  # settings, rows → what is shown
    example: str  # arguments, for the help
    one_at_a_time: bool = False  # it goes by the computer's clock: no other process may measure beside it
