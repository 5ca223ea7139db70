"""The limits under which a study flies: those of the nearest safety.yaml."""

from pathlib import Path

from cfplan.errors import InputError
from cfplan.files.nearest import nearest
from cfplan.safety.limits import Limits
from cfplan.safety.limits_file import load_limits


def limits_for(path_file: Path) -> Limits:
    """Return the limits of the nearest safety.yaml in or above the working folder, or else above the path file.

    Raises InputError if there is none or it is invalid.
    """
    found = nearest("safety.yaml", Path.cwd(), path_file.resolve().parent)
    if found is None:
        raise InputError("no safety.yaml in or above this folder", where=str(path_file), hint="run in the repository")
    return load_limits(found)
