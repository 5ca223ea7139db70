"""The provenance of a measurement: command, date, commit and sources of cfplan, and the machine."""

import shlex
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from typing import Any

from cfplan import version
from studies.runner.machine import Machine, this_machine
from studies.runner.sources import DATA, PACKAGES, sources_digest


@dataclass(frozen=True, slots=True)
class Provenance:
    """Everything needed to repeat a measurement."""

    command: str
    date: str  # when it began, ISO 8601
    commit: str  # of cfplan; "unknown" outside of its repository
    modified: bool  # cfplan, its models or its limits differed from that commit
    machine: Machine
    module: str = ""  # of the study; "" in results from before sources were noted
    sources: str = ""  # digest of all that the figures depend on

    @property
    def fresh(self) -> bool:
        """Return whether the sources are the present ones."""
        return bool(self.module) and self.sources == sources_digest(self.module)

    @staticmethod
    def from_json(document: Mapping[str, Any]) -> "Provenance":
        """Return the provenance from a result's JSON."""
        return Provenance(**{**document, "machine": Machine(**document["machine"])})


@cache
def provenance(module: str) -> Provenance:
    """Return the provenance of a study in this process, as of the first call."""
    return Provenance(
        command=shlex.join(["python", "-m", "studies", *sys.argv[1:]]),
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        commit=version.commit(),
        modified=bool(version.git("status", "--porcelain", "--", *PACKAGES, *DATA)),
        machine=this_machine(),
        module=module,
        sources=sources_digest(module),
    )
