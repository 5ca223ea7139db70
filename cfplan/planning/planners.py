"""The planners by name: where each is found, on which grid it plans, and whether its profiles are refined."""

import difflib
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


class PlannerEntry(NamedTuple):
    """What planning knows of a planner before it is imported."""

    function: str  # module:name
    refined: bool  # a profile that does not pass is refined; else it is only slowed as a whole
    nodes_per_metre: int = 10
    most_nodes: int = MOST_NODES


PLANNERS = MappingProxyType(
    {
        # trained on wide grids; refining costs by the node
        "learned": PlannerEntry("cfplan.learning.learned:plan_learned", True, nodes_per_metre=5, most_nodes=30_000),
        "expert": PlannerEntry("cfplan.planners.expert.expert:plan_expert", True),
        "toppquad": PlannerEntry("cfplan.planners.baselines.toppquad:plan_toppquad", False),
        "convex": PlannerEntry("cfplan.planners.baselines.convex:plan_convex", True),
        "minsnap": PlannerEntry("cfplan.planners.baselines.min_snap:plan_min_snap", False),
    }
)


def find_planner(name: str) -> Planner:
    """Return the planner of that name, imported now. Raises InputError."""
    if name not in PLANNERS:
        near = difflib.get_close_matches(name, [AUTO, *PLANNERS], n=1)
        guess = f"did you mean {near[0]}? " if near else ""
        raise InputError(f"unknown planner {name!r}", hint=f"{guess}known: {', '.join([AUTO, *PLANNERS])}")
    module, function = PLANNERS[name].function.split(":")
    planner: Planner = getattr(import_module(module), function)
    return planner


def default_nodes(path: Path, planner: str = "expert") -> int:
    """Return the intervals of a planner's grid for a path: some a metre within bounds, and a few for each piece."""
    entry = PLANNERS[planner]
    by_length = int(np.clip(round(entry.nodes_per_metre * path.length), FEWEST_NODES, entry.most_nodes))
    return max(by_length, NODES_PER_PIECE * (len(path.breaks) - 1))
