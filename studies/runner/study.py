"""A study: its settings, its cases, a function that measures a case, and the tables made from all rows.

A module of `studies` defines it as STUDY; the module's docstring is the help text. The runner does the rest: it derives
options, help and record from the settings, and handles processes, clusters, resuming and progress for all studies.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from studies.runner.result import Table

Progress = Callable[[int, int], None]  # called with the number of finished cases and their total


@dataclass(frozen=True, slots=True)
class Run:
    """Resources of a run, for studies that prepare data in several processes themselves."""

    scratch: Path  # a folder that is deleted after the run
    workers: int = 1  # processes on this machine
    scheduler: str | None = None  # address of a Dask cluster to use instead
    progress: Progress = lambda done, total: None  # reports progress of the preparation


@dataclass(frozen=True, slots=True)
class Work:
    """The cases of a run, ready to be measured."""

    cases: Mapping[str, Any]  # by name
    measure: Callable[[Any], Any]  # case → a row, or a list of rows; both picklable
    row: Callable[..., Any] = dict  # rebuilds a row from its fields: the row's dataclass
    identity: Mapping[str, Any] = field(default_factory=dict)  # dependencies of rows besides settings, sources


@dataclass(frozen=True, slots=True)
class Study:
    """Everything that the runner needs to know about a study."""

    settings: type  # a dataclass; its fields are made by `option` and `argument`
    work: Callable[[Any, Run], Work]  # settings, run → cases
    tables: Callable[[Any, list[Any]], Iterable[Table]]  # settings, rows → tables
    example: str  # example arguments, for the help
    one_at_a_time: bool = False  # it measures wall-clock time: no other process may run beside it
