"""The version of cfplan and the commit that it was made of, which plans, records and results are marked with."""

import subprocess
from functools import cache
from pathlib import Path

__version__ = "0.1.0"

UNKNOWN = "unknown"
REPOSITORY = Path(__file__).parents[1]  # where there is one
_WRITTEN = Path(__file__).with_name("commit.txt")  # setup.py writes it into what it builds


@cache
def commit() -> str:
    """Return the commit of the repository from which this cfplan runs or was built; "unknown" where neither says."""
    top, head = git("rev-parse", "--show-toplevel"), git("rev-parse", "HEAD")
    if head and Path(top).resolve() == REPOSITORY.resolve():
        return head
    return _WRITTEN.read_text().strip() if _WRITTEN.is_file() else UNKNOWN


def git(*arguments: str) -> str:
    """Return what git says of the folder in which cfplan lies; "" where there is no git or no repository."""
    command = ["git", "-C", str(REPOSITORY), *arguments]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""
