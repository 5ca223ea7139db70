"""The planners by name, imported when they are asked for."""

import difflib
from importlib import import_module
from importlib.util import find_spec
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


_NEEDS = MappingProxyType({"convex": "copp_py"})  # parts that are not always installed


def available(name: str) -> bool:
    """Whether the parts that a planner needs are installed."""
    return name not in _NEEDS or find_spec(_NEEDS[name]) is not None


def find_planner(name: str) -> Planner:
    """The planner of that name. Raises InputError."""
    if name not in PLANNERS:
        near = difflib.get_close_matches(name, PLANNERS, n=1)
        guess = f"did you mean {near[0]}? " if near else ""
        raise InputError(f"unknown planner {name!r}", hint=f"{guess}known: {', '.join(PLANNERS)}")
    if not available(name):
        raise InputError(f"the planner {name!r} needs a part that is not installed", hint="pip install 'cfplan[bench]'")
    module, function = PLANNERS[name].split(":")
    planner: Planner = getattr(import_module(module), function)
    return planner
