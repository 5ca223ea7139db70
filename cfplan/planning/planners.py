"""The planners by name, imported when they are asked for."""

import difflib
from importlib import import_module
from types import MappingProxyType

from cfplan.errors import InputError
from cfplan.planners.task import Planner

AUTO = "auto"
# no planner: the fastest of some, see plan()
PLANNERS = MappingProxyType(
    {
        "learned": "cfplan.learning.learned:plan_learned",
        "expert": "cfplan.planners.expert.expert:plan_expert",
        "toppquad": "cfplan.planners.baselines.toppquad:plan_toppquad",
        "convex": "cfplan.planners.baselines.convex:plan_convex",
        "minsnap": "cfplan.planners.baselines.min_snap:plan_min_snap",
    }
)


def find_planner(name: str) -> Planner:
    """The planner of that name. Raises InputError."""
    if name not in PLANNERS:
        near = difflib.get_close_matches(name, [AUTO, *PLANNERS], n=1)
        guess = f"did you mean {near[0]}? " if near else ""
        raise InputError(f"unknown planner {name!r}", hint=f"{guess}known: {', '.join([AUTO, *PLANNERS])}")
    module, function = PLANNERS[name].split(":")
    planner: Planner = getattr(import_module(module), function)
    return planner
