"""The limits under which a study flies: those of the nearest safety.yaml, or one that ends only lost flights."""

import math
from pathlib import Path

from cfplan.errors import InputError
from cfplan.files.nearest import nearest
from cfplan.safety.limits import FlightLimits, Ladder, Limits
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.geometric_flight import LOST


def limits_for(path_file: Path) -> Limits:
    """Return the limits of the nearest safety.yaml in or above the working folder, or else above the path file.

    Raises InputError if there is none or it is invalid.
    """
    found = nearest("safety.yaml", Path.cwd(), path_file.resolve().parent)
    if found is None:
        raise InputError("no safety.yaml in or above this folder", where=str(path_file), hint="run in the repository")
    return load_limits(found)


def lost_alone() -> FlightLimits:
    """Return flight limits that end a flight only when it is LOST."""
    never = Ladder(math.inf, math.inf, math.inf)
    return FlightLimits(
        deviation=Ladder(LOST, LOST, LOST), fence=never, speed=never, acceleration=never, angular_velocity=never,
        patience=1.0,
    )  # fmt: skip
