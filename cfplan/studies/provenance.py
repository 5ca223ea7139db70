"""Where a measurement comes from: the command, the date, the commit of cfplan and the machine."""

import shlex
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

from cfplan.studies.machine import Machine, this_machine

REPOSITORY = Path(__file__).parents[2]
DECIDES = ("cfplan", "models", "flights", "safety.yaml")  # what a study's figures depend on
UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class Provenance:
    """Enough to make the measurement again."""

    command: str
    date: str  # of its beginning, ISO 8601
    commit: str  # of cfplan; "unknown" where it does not run from its repository
    modified: bool  # cfplan, its models, its paths or its limits were not as in that commit
    machine: Machine

    @staticmethod
    def from_json(document: Mapping[str, Any]) -> "Provenance":
        """Return the provenance that a result's JSON names."""
        return Provenance(**{**document, "machine": Machine(**document["machine"])})


@cache
def provenance() -> Provenance:
    """Return that of this process, as it was at the first call."""
    return Provenance(
        command=shlex.join(["cfplan", *sys.argv[1:]]),
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        commit=_commit(),
        modified=bool(_git("status", "--porcelain", "--", *DECIDES)),
        machine=this_machine(),
    )


def _commit() -> str:
    top, commit = _git("rev-parse", "--show-toplevel"), _git("rev-parse", "HEAD")
    return commit if commit and Path(top).resolve() == REPOSITORY.resolve() else UNKNOWN


def _git(*arguments: str) -> str:
    """Return what git says of the folder in which cfplan lies; "" where there is no git or no repository."""
    command = ["git", "-C", str(REPOSITORY), *arguments]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""
