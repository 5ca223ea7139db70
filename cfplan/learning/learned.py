"""The learned planner: a chain of windows over a path of any length, each in a millisecond.

The network answers for a window; its answers are smoothed into coefficients of the spline of h (smooth.py) and the
first part of them is kept. The next window begins there, from the boundary state that the kept coefficients make, so
that h, h' and h'' are continuous by construction. Each window costs the same, and only the result grows with the path.

The profile is the network's guess and keeps no limit for sure: repair and certificate make it a flight.
"""

import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError
from cfplan.geometry.path import Path
from cfplan.geometry.yaw import YawMode
from cfplan.learning.features import (
    LEAST_SHARE,
    REFERENCE,
    Bounds,
    bounds,
    fill_yaw,
    node_features,
    rests,
    start_coefficients,
    start_features,
    start_logs,
    window_inputs,
)
from cfplan.learning.inference import Network
from cfplan.learning.model_files import Model, find_model
from cfplan.learning.smooth import Begin, smoothed
from cfplan.learning.windows import chain, kept_intervals
from cfplan.planners.solution import Solution, Status
from cfplan.planners.task import PlanningTask
from cfplan.vehicle.profile import BoundaryState
from cfplan.vehicle.profile_spline import spline_profile
from cfplan.vehicle.yaw_spline import YawSpline

LEAST_NODES = 10
BLEND_INTERVALS = 3.0  # over which the profile blends into a state given for the end
LOWERING_WIDTH = 2.0  # nodes, over which lowering for tighter limits is smoothed


def plan_learned(task: PlanningTask, *, model: Model | None = None) -> Solution:
    """Plan by the network over the task's intervals, or over one window's where those are more.

    Where limits are looser than the model's, the model's are kept; where they are tighter, the profile is lowered to
    about what they allow, and repair does the rest.

    Raises:
        InputError: fewer than ten nodes, or than the path needs, or no model for this vehicle and these limits.
    """
    began = time.perf_counter()
    if task.nodes < LEAST_NODES:
        raise InputError(
            f"{task.nodes} nodes; the learned planner needs {LEAST_NODES}", where="nodes", hint="100 is usual"
        )
    path, airframe, limits = task.path, task.airframe, task.limits
    model = model or find_model(airframe, limits)
    if model is None:
        raise InputError(
            f"no model for {airframe.name} within these limits",
            where="models",
            hint="train one with `cfplan train`, or take another planner",
        )
    if task.nodes < model.window:
        task = replace(task, nodes=model.window)
    task.check_nodes()
    if task.refusal:
        return task.refusal
    nodes, yaw, start, end = task.nodes, task.yaw, task.start, task.end
    track = None
    if yaw is not YawMode.FREE:
        track = YawSpline.along(path, nodes, yaw, task.yaw_angle, start, end)
    known, allowed = model.card.limits, model.limits_within(limits)
    coefficients, turned = predict(
        path, model.network, bounds(airframe, known), nodes, model.window, start=start, end=end,
        track=track, yaw_angle=task.yaw_angle, allowed=bounds(airframe, allowed) if allowed != known else None,
    )  # fmt: skip
    if not (np.isfinite(coefficients).all() and np.isfinite(turned).all() and (coefficients[1:-1] > 0).all()):
        return Solution(Status.NOT_CONVERGED, None, f"the network {model.name} answered what is not a number")
    stats: dict[str, float | int | str] = {
        "solve_seconds": time.perf_counter() - began,
        "iterations": 0,
        "solver": "learned",
        "model": model.name,
    }
    track = track or YawSpline.smoothed(turned, path.end / nodes, start, end)
    begins = (part.first for part in chain(nodes, model.window, kept_intervals(model.window)))
    joints = tuple(path.end / nodes * first for first in begins if first > 0)
    return Solution(Status.SOLVED, spline_profile(coefficients, path.end, track), "", stats, joints)


def predict(
    path: Path,
    network: Network,
    bound: Bounds,
    nodes: int,
    window: int,
    *,
    start: BoundaryState | None = None,
    end: BoundaryState | None = None,
    track: YawSpline | None = None,
    yaw_angle: float = 0.0,
    allowed: Bounds | None = None,
) -> tuple[NDArray, NDArray]:
    """Return (N+3,) coefficients of the spline of h, and (N+1,) yaw at the nodes, rad: the track's, else the network's.

    `bound` is what the network was trained for, `allowed` is set where limits are tighter. The result is not finite
    where the network fails. `nodes` is at least `window`.
    """
    step = path.end / nodes
    nodes_seen = node_features(path, 0.0, step, nodes + 1, bound)
    rest_start, rest_end = start is None and rests(path, 0.0), end is None and rests(path, path.end)
    logs = np.empty(nodes + 3)  # log √u/Δs
    yaw = np.empty(nodes + 1) if track is None else track.yaw
    angle, turning = (yaw_angle, 0.0) if start is None else (start.yaw, start.dyaw * step)
    settled = np.zeros(3)
    begin = Begin.REST if rest_start else Begin.FREE
    if start is not None:
        begin, settled = Begin.KNOWN, np.array(start_logs(start, step))
    for part in chain(nodes, window, kept_intervals(window)):
        first, stop = part.first, part.first + part.keep
        seen = nodes_seen[first : first + window + 1]
        known = start_features(*settled) if begin is Begin.KNOWN else None
        if track is not None:
            angle, turning = track.yaw[first], track.dyaw[first] * step
        answer = network(window_inputs(seen, begin is Begin.REST, part.last and rest_end, known, angle, turning))
        rates = answer[:, 0] + seen[:, REFERENCE]
        smooth = smoothed(rates, settled, int(begin), part.last and rest_end)
        logs[first : first + window + 3] = smooth
        begin, settled = Begin.KNOWN, smooth[part.keep : part.keep + 3]
        if track is None:
            fill_yaw(yaw[first : stop + 1], angle, answer)
            angle, turning = yaw[stop], yaw[stop] - yaw[stop - 1]
    if allowed is not None:
        asked = node_features(path, 0.0, step, nodes + 1, allowed)[:, REFERENCE]
        _lower(logs, nodes_seen[:, REFERENCE], asked, rest_start, rest_end)
    with np.errstate(over="ignore"):  # then they are not finite
        coefficients = np.exp(2.0 * (logs + np.log(step)))
    if start is not None:
        coefficients[:3] = start_coefficients(start, step)
    if end is not None:
        _blend_to(coefficients, end, step)
    return coefficients, yaw


def _lower(logs: NDArray, known: NDArray, asked: NDArray, rest_start: bool, rest_end: bool) -> None:
    """Lower the profile by as much as the reference is lower, less what the profile lies under its own already."""
    from scipy.ndimage import gaussian_filter1d  # slow to import

    gap = np.maximum(known - asked - np.maximum(known - logs[1:-1], 0.0), 0.0)

    gap = gaussian_filter1d(np.pad(gap, 1, mode="edge"), LOWERING_WIDTH, mode="nearest")
    if rest_start:
        gap[:4] = gap[:4].max()
    if rest_end:
        gap[-4:] = gap[-4:].max()
    logs -= gap


def _blend_to(coefficients: NDArray, end: BoundaryState, step: float) -> None:
    """Bend the last coefficients to the given end state."""
    last = np.array(start_coefficients(end, step))
    backwards = coefficients[::-1]
    share = max(last[0], LEAST_SHARE * end.h) / backwards[2]
    backwards[3:] *= share ** np.exp(-np.arange(1, len(coefficients) - 2) / BLEND_INTERVALS)
    coefficients[-3:] = last
