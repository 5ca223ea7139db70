"""The planners by name, imported when they are asked for."""

import difflib
from importlib import import_module
from types import MappingProxyType

from cfplan.errors import InputError
from cfplan.expert.solution import Planner

PLANNERS = MappingProxyType(
    {
        "expert": "cfplan.expert.reduced:plan_reduced",
        "toppquad": "cfplan.expert.toppquad:plan_toppquad",
        "convex": "cfplan.expert.convex:plan_convex",
        "min-snap": "cfplan.expert.min_snap_baseline:plan_min_snap",
    }
)


def find_planner(name: str) -> Planner:
    """The planner of that name. Raises InputError."""
    if name not in PLANNERS:
        near = difflib.get_close_matches(name, PLANNERS, n=1)
        guess = f"did you mean {near[0]}? " if near else ""
        raise InputError(f"unknown planner {name!r}", hint=f"{guess}known: {', '.join(PLANNERS)}")
    module, function = PLANNERS[name].split(":")
    planner: Planner = getattr(import_module(module), function)
    return planner
