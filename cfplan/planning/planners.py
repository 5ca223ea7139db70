"""The planners by name: their functions, their grids, and whether their profiles are refined."""

import difflib
from enum import StrEnum
from importlib import import_module
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from cfplan.errors import InputError
from cfplan.geometry.path import Path
from cfplan.planners.task import Planner

AUTO = "auto"  # not a planner: the fastest flight of several, see policy.POLICIES
FEWEST_NODES, MOST_NODES = 60, 3000
NODES_PER_PIECE = 4  # of a path, at least


class Finish(StrEnum):
    """How a planner's profile is finished."""

    REFINED = "refined"  # a proposal: refined to the optimum, whether it passes or not
    REPAIRED = "repaired"  # kept if it passes, else refined
    SLOWED = "slowed"  # as a whole if it does not pass


class PlannerEntry(NamedTuple):
    """Data about a planner that is not imported yet."""

    function: str  # module:name
    finished: Finish
    nodes_per_metre: int = 10
    most_nodes: int = MOST_NODES


PLANNERS = MappingProxyType(
    {
        "learned": PlannerEntry("cfplan.learning.learned:plan_learned", Finish.REFINED, most_nodes=30_000),
        "expert": PlannerEntry("cfplan.planners.expert.expert:plan_expert", Finish.REPAIRED),
        "toppquad": PlannerEntry("cfplan.planners.baselines.toppquad:plan_toppquad", Finish.SLOWED),
        "convex": PlannerEntry("cfplan.planners.baselines.convex:plan_convex", Finish.REFINED),
        "minsnap": PlannerEntry("cfplan.planners.baselines.min_snap:plan_min_snap", Finish.SLOWED),
    }
)


def find_planner(name: str) -> Planner:
    """Return the planner of that name, imported now. Raises InputError."""
    if name not in PLANNERS:
        near = difflib.get_close_matches(name, [AUTO, *PLANNERS], n=1)
        guess = f"did you mean {near[0]}? " if near else ""
        known = ", ".join([AUTO, *PLANNERS])
        raise InputError(f"unknown planner {name!r}", where="planner", hint=f"{guess}known: {known}")
    module, function = PLANNERS[name].function.split(":")
    planner: Planner = getattr(import_module(module), function)
    return planner


def default_nodes(path: Path, planner: str = "expert") -> int:
    """Return the intervals of a planner's grid for a path: some a metre within bounds, and a few for each piece."""
    entry = PLANNERS[planner]
    by_length = int(np.clip(round(entry.nodes_per_metre * path.length), FEWEST_NODES, entry.most_nodes))
    return max(by_length, NODES_PER_PIECE * (len(path.breaks) - 1))
