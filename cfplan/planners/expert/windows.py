"""Plan a long path window by window, so that time grows with its length and memory does not.

Each window begins in the state at the end of the previous window's kept part, and looks ahead beyond its own kept part
by more than the braking distance. Joints are crossed a little below the limits.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.geometry.path import Path
from cfplan.planners.expert.problem import Ends, Segment, Shape, layout_of
from cfplan.planners.expert.tuning import TUNING, WindowSize
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.profile import BoundaryState
from cfplan.vehicle.profile_spline import node_values
from cfplan.vehicle.yaw_spline import YawSpline


class Tightened(NamedTuple):
    """A window's solution after tightening, which usually keeps its limits between the points too."""

    coefficients: NDArray  # (N+3, 1 or 2)
    rounds: int  # of tightening
    iterations: int  # of all searches


class Joined(NamedTuple):
    """The windows' solutions put together."""

    coefficients: NDArray  # (N+3, 1 or 2)
    joints: tuple[float, ...]  # s, where windows meet
    iterations: int
    rounds: int  # of tightening
    unfinished: str = ""  # why the remaining windows are unchanged; empty if all are solved


def windows_of(path: Path, nodes: int, size: WindowSize, limits: PlanLimits) -> list[tuple[int, int, int]]:
    """Return (first interval, first that is not kept, first beyond) of each window; one window if the path fits in it.

    Windows are larger than `size` where that number of the path's `nodes` intervals is too short to brake in.
    """
    spacing = np.linalg.norm(path(np.linspace(0.0, path.end, nodes + 1), 1), axis=1) * (path.end / nodes)
    length = np.append(0.0, np.cumsum((spacing[1:] + spacing[:-1]) / 2.0))  # m, of the path up to each node
    far_enough = np.searchsorted(length, length + limits.speed**2 / limits.acceleration + TUNING.lookahead)
    seen = np.minimum(far_enough, nodes).tolist()  # by node: how far a window looks that keeps the intervals before it
    windows: list[tuple[int, int, int]] = []
    first = 0
    while True:
        left = first + max(size.kept, 2 * (seen[first] - first))
        beyond = max(left + size.ahead, seen[min(left, nodes)])
        if beyond >= nodes:
            return [*windows, (first, nodes, nodes)]
        windows.append((first, left, beyond))
        first = left


def by_windows(
    whole: Segment,
    size: WindowSize,
    search: Callable[[Segment, NDArray], Tightened | str],
    near: NDArray | None = None,
) -> Joined | str:
    """Solve the whole segment by windows of that size, and join them; or return the reason for failure.

    `search` solves one window from the coefficients of `near`, (N+3, 1 or 2), in that window, or from zeros without it;
    those that a joint decides are set. If a window fails behind a solved one, it and all behind it stay as in `near`.
    """
    shape, ends = whole.layout.shape, whole.ends
    nodes, step = shape.nodes, whole.path.end / shape.nodes
    coefficients = np.zeros((nodes + 3, 2 if shape.free_yaw else 1)) if near is None else near.copy()
    windows = windows_of(whole.path, nodes, size, whole.limits)
    joints = tuple(first * step for first, _, _ in windows[1:])
    iterations = rounds = 0
    for number, (first, left, last) in enumerate(windows):
        yaw = whole.yaw.part(first, last)
        at_start, at_end = first == 0, last == nodes
        state = ends.start if at_start else _state(coefficients[first : first + 3], yaw, whole.unit, step)
        window = Segment(
            whole.path if at_start and at_end else whole.path.part(first * step, last * step),
            whole.airframe, whole.limits,
            Ends(state, continues=not at_start, joint=None if at_end else left - first),
            yaw, layout_of(Shape(last - first, shape.free_yaw, shape.turning_limited, (3 * at_start, 3 * at_end))),
            whole.caps and whole.caps.part(first * step, last * step), whole.slowness,
        )  # fmt: skip
        found = search(window, coefficients[first : last + 3])
        if isinstance(found, str):
            failure = found if len(windows) == 1 else f"s = {first * step:.3g} to {last * step:.3g}: {found}"
            if near is None or at_start:
                return failure
            return Joined(coefficients, joints[: number - 1], iterations, rounds, failure)
        given = coefficients[left + 3 : last + 3].copy()
        coefficients[first : last + 3] = found.coefficients
        if near is not None and not at_end:
            _lead_back(coefficients[left + 3 : last + 3], given)
        iterations += found.iterations
        rounds += found.rounds
    return Joined(coefficients, joints, iterations, rounds)


def _lead_back(found: NDArray, given: NDArray) -> None:
    """Blend a window's solution beyond its kept part into the given one, so that the next window begins smoothly."""
    share = np.clip(np.linspace(-1.0, 1.0, len(found)), 0.0, 1.0)
    share = share**2 * (3.0 - 2.0 * share)
    found[:, 0] = found[:, 0] ** (1.0 - share) * given[:, 0] ** share


def _state(rows: NDArray, yaw_given: YawSpline, unit: float, step: float) -> BoundaryState:
    """Return the state at a node with these three coefficients of h about it, and two of yaw where it is free."""
    h, slope, bend = node_values(*(rows[:, 0] * unit))
    yaw, dyaw = yaw_given.yaw[0], yaw_given.dyaw[0]
    if rows.shape[1] == 2:
        yaw, dyaw = (rows[0, 1] + rows[1, 1]) / 2, (rows[1, 1] - rows[0, 1]) / step
    return BoundaryState(float(h), float(slope / step), float(bend / step**2), float(yaw), float(dyaw))
