"""Where a measurement comes from: the command, the date, the commit of cfplan and the machine."""

import hashlib
import shlex
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

from cfplan import version
from cfplan.studies.machine import Machine, this_machine

DECIDES = ("cfplan", "models", "flights", "safety.yaml")  # what a study's figures depend on


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
        commit=version.commit(),
        modified=bool(version.git("status", "--porcelain", "--", *DECIDES)),
        machine=this_machine(),
    )


@cache
def sources_digest() -> str:
    """Return a digest of all that a study's figures depend on, as it was at the first call: of code that is changed
    but not committed too, and where there is no repository.
    """
    digest = hashlib.sha256()
    for top in DECIDES:
        for file in sorted(_files(version.REPOSITORY / top)):
            digest.update(f"{file.relative_to(version.REPOSITORY)}\n".encode() + file.read_bytes())
    return digest.hexdigest()


def _files(top: Path) -> list[Path]:
    found = [top] if top.is_file() else top.rglob("*")
    return [file for file in found if file.is_file() and "__pycache__" not in file.parts]
