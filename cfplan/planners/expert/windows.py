"""A long path taken window by window, so that time grows with its length and memory does not.

Each window begins in the state where the kept part of the one before ends, and looks further than it keeps, by more
than it takes to brake. Joints are crossed a little below the limits.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.planners.expert.problem import Ends
from cfplan.planners.expert.program import Shape, layout_of
from cfplan.planners.expert.tightening import Kept, Task
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.profile import BoundaryState
from cfplan.vehicle.profile_spline import node_values
from cfplan.vehicle.yaw_spline import YawSpline

NEAR = 0.5
# m that a window looks ahead at least, beyond twice what braking takes


class Joined(NamedTuple):
    """What the windows came to."""

    table: NDArray
    # (N+3, 1 or 2) spline coefficients
    joints: tuple[float, ...]
    # s, where windows meet
    iterations: int
    rounds: int
    # of tightening


def windows_of(nodes: int, kept: int, ahead: int) -> list[tuple[int, int]]:
    """(first interval, first beyond) of each window; one where it fits. Each keeps what the next does not begin."""
    begins = range(0, max(nodes - ahead, 1), kept)
    return [(first, nodes if first == begins[-1] else first + kept + ahead) for first in begins]


def far_enough(size: tuple[int, int], step: float, limits: PlanLimits) -> tuple[int, int]:
    """A window's size, more where that many intervals of a fine grid are too short to brake in."""
    kept, ahead = size
    needed = math.ceil((limits.speed**2 / limits.acceleration + NEAR) / step)
    return max(kept, 2 * needed), max(ahead, needed)


def by_windows(
    whole: Task,
    size: tuple[int, int],
    search: Callable[[Task, NDArray], Kept | str],
    near: NDArray | None = None,
) -> Joined | str:
    """The whole searched by windows of which `size` says how many intervals they keep, and look ahead; or why not.

    `search` solves one window; it is given the coefficients that `near`, (N+3, 1 or 2), has there, else zeros, but for
    those that a joint decides.
    """
    shape, ends = whole.layout.shape, whole.ends
    nodes, unit, step = shape.nodes, whole.limits.speed**2, whole.path.end / shape.nodes
    table = np.zeros((nodes + 3, 2 if shape.free_yaw else 1)) if near is None else near.copy()
    kept, ahead = far_enough(size, step, whole.limits)
    windows = windows_of(nodes, kept, ahead)
    iterations = rounds = 0
    for first, last in windows:
        track = whole.track.part(first, last)
        at_start, at_end = first == 0, last == nodes
        state = ends.start if at_start else _state(table[first : first + 3], track, unit, step)
        task = Task(
            whole.path if at_start and at_end else whole.path.part(first * step, last * step),
            whole.airframe, whole.limits,
            Ends(state, ends.end if at_end else None, continues=not at_start, joint=None if at_end else kept), track,
            layout_of(Shape(last - first, shape.free_yaw, shape.turning_limited, (3 * at_start, 3 * at_end))),
            whole.backend,
        )  # fmt: skip
        found = search(task, table[first : last + 3])
        if isinstance(found, str):
            return found if len(windows) == 1 else f"s = {first * step:.3g} to {last * step:.3g}: {found}"
        table[first : last + 3] = found.table
        iterations += found.iterations
        rounds += found.rounds
    return Joined(table, tuple(first * step for first, _ in windows[1:]), iterations, rounds)


def _state(rows: NDArray, track: YawSpline, unit: float, step: float) -> BoundaryState:
    """The state at a node whose first three coefficients of h, and two of yaw where it is free, are in these rows."""
    cubic = rows[:, 0] * unit
    h, slope, bend = node_values(*cubic)
    yaw, dyaw = track.yaw[0], track.dyaw[0]
    if rows.shape[1] == 2:
        yaw, dyaw = (rows[0, 1] + rows[1, 1]) / 2, (rows[1, 1] - rows[0, 1]) / step
    return BoundaryState(float(h), float(slope / step), float(bend / step**2), float(yaw), float(dyaw))
