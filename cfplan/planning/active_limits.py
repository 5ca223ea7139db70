"""Active limits: which limit holds a plan back, and where; and the colour of each limit in drawings."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from cfplan.planning.plan_result import Plan
from cfplan.safety.certificate import shares

ACTIVE = 0.95  # usage from which a limit counts as active
STEP = 0.01  # s, between the samples of the plan
LIGHTEST = 0.55  # largest luminance of a colour on white paper; lighter ones are darkened

Colour = tuple[int, int, int]
FREE, FREE_COLOUR = "none", (60, 66, 76)
LIMIT_COLOURS: dict[str, Colour] = {
    "speed": (0, 158, 115),
    "acceleration": (204, 121, 167),
    "angular velocity": (213, 94, 0),
    "angular acceleration": (170, 130, 220),
    "tilt": (240, 228, 66),
    "motor thrust, most": (226, 74, 74),
    "motor thrust, least": (0, 114, 178),
    "specific thrust, least": (176, 122, 92),
}


@dataclass(frozen=True, slots=True, eq=False)
class ActiveLimits:
    """Which limit holds the plan back, and where."""

    time: NDArray  # (N,) s from the start of the path
    position: NDArray  # (N, 3) m
    name: NDArray  # (N,) str: the limit with the largest usage if that is at least ACTIVE, else FREE
    shares: dict[str, NDArray]  # (N,) of each limit, 1 at the limit

    def stretches(self) -> list[tuple[str, slice]]:
        """Return each run of samples with the same name, in order; neighbours share a sample, so that lines meet."""
        edges = [0, *(np.flatnonzero(self.name[1:] != self.name[:-1]) + 1), len(self.name)]
        return [
            (str(self.name[begin]), slice(int(begin), min(int(end) + 1, len(self.name))))
            for begin, end in pairwise(edges)
        ]


def on_white(colour: Colour) -> str:
    """Return the colour for white paper as #rrggbb, darkened if it is too light."""
    red, green, blue = colour
    luminance = (0.2126 * red + 0.7152 * green + 0.0722 * blue) / 255
    factor = min(1.0, LIGHTEST / luminance) if luminance > 0 else 1.0
    return f"#{round(factor * red):02x}{round(factor * green):02x}{round(factor * blue):02x}"


def active_limits(plan: Plan) -> ActiveLimits:
    """Sample the active limit every STEP."""
    trajectory = plan.trajectory
    time = np.append(np.arange(0.0, trajectory.duration, STEP), trajectory.duration)
    used = shares(trajectory, plan.limits.plan, time)
    table = np.stack(list(used.values()))
    names = np.where(table.max(axis=0) >= ACTIVE, np.array(list(used))[table.argmax(axis=0)], FREE)
    return ActiveLimits(time, trajectory.at(time).position, names, used)
