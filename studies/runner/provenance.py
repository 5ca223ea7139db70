"""Where a measurement comes from: the command, the date, the commit and the sources of cfplan, and the machine."""

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
    """Enough to make the measurement again."""

    command: str
    date: str  # of its beginning, ISO 8601
    commit: str  # of cfplan; "unknown" where it does not run from its repository
    modified: bool  # cfplan, its models or its limits were not as in that commit
    machine: Machine
    module: str = ""  # of the study; "" in results from before sources were noted
    sources: str = ""  # digest of all that the figures depend on

    @property
    def fresh(self) -> bool:
        """Return whether the figures are those of the present sources."""
        return bool(self.module) and self.sources == sources_digest(self.module)

    @staticmethod
    def from_json(document: Mapping[str, Any]) -> "Provenance":
        """Return the provenance that a result's JSON names."""
        return Provenance(**{**document, "machine": Machine(**document["machine"])})


@cache
def provenance(module: str) -> Provenance:
    """Return that of this process and a study, as it was at the first call."""
    return Provenance(
        command=shlex.join(["python", "-m", "studies", *sys.argv[1:]]),
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        commit=version.commit(),
        modified=bool(version.git("status", "--porcelain", "--", *PACKAGES, *DATA)),
        machine=this_machine(),
        module=module,
        sources=sources_digest(module),
    )
