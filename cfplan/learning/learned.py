"""The learned planner: all windows of a path of any length at once, through one network for any limits and vehicle.

The network answers for windows that overlap; its answers are joined and smoothed into coefficients of the spline of h
(smooth.py). Time and memory grow linearly with the path.

The profile is a proposal that may exceed limits: repair and certificate make it a flight.
"""

import math
import time
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError
from cfplan.geometry.path import Path
from cfplan.geometry.yaw import YawMode
from cfplan.learning.features import (
    INPUTS,
    LEAST_SHARE,
    REFERENCE,
    ScaledLimits,
    fill_inputs,
    node_features,
    rests,
    scaled_limits,
    start_coefficients,
    start_features,
    start_logs,
)
from cfplan.learning.inference import Network
from cfplan.learning.model_files import Model, find_model
from cfplan.learning.smooth import Begin, smoothed
from cfplan.learning.windows import overlapped, windows_over
from cfplan.machine_code import njit
from cfplan.planners.solution import Solution, Status
from cfplan.planners.task import FREE_START, PlanningTask
from cfplan.vehicle.profile import BoundaryState
from cfplan.vehicle.profile_spline import coefficients_of, spline_at, spline_profile
from cfplan.vehicle.yaw_spline import YawSpline

LEAST_NODES = 10
SPACING = 0.2  # m between the nodes of a query, about as in training


class ProposedProfile(NamedTuple):
    """A network's proposal for a path."""

    coefficients: NDArray  # (N+3,) of the spline of h; not finite where the network fails
    yaw: NDArray  # (N+1,) rad at the nodes: the track's where there is one


class Query(NamedTuple):
    """A query to a network: a path with limits, grid, start and yaw."""

    path: Path
    scaled_limits: ScaledLimits
    nodes: int  # intervals, at least the network's window
    start: BoundaryState | None = None
    track: YawSpline | None = None  # None: yaw is the network's to choose
    yaw_angle: float = 0.0  # rad, lower end of its initial range then, see PlanningTask


class _Windows(NamedTuple):
    """The windows of one path."""

    inputs: NDArray  # (B, W+1, INPUTS)
    starts: NDArray  # (B,)
    weights: NDArray  # (B, W+1), of each answer
    reference: NDArray  # (N+1,) log rates, in units of time
    rests: tuple[bool, bool]  # whether the path rests at its start and end, where no state is given


def plan_learned(task: PlanningTask, *, model: Model | None = None) -> Solution:
    """Plan by the network over the task's intervals, or over those of one window if these are more.

    If the grid is finer than the network needs, the network is queried on a coarser one and its answer interpolated.

    Raises:
        InputError: fewer than ten nodes, or than the path needs, or no model.
    """
    began = time.perf_counter()
    if task.nodes < LEAST_NODES:
        raise InputError(
            f"{task.nodes} nodes; the learned planner needs {LEAST_NODES}", where="nodes", hint="100 is usual"
        )
    model = model or find_model(task.airframe, task.limits, task.models)
    if model is None:
        raise InputError("no model", where="models", hint="train one with `cfplan train`, or take another planner")
    if task.nodes < model.window:
        task = replace(task, nodes=model.window)
    task.check_nodes()
    if task.refusal:
        return task.refusal
    coefficients, yaw = propose(task, model)
    if not _sound(coefficients, yaw.yaw):
        return Solution(Status.NOT_CONVERGED, None, f"the output of the network {model.name} is not finite")
    stats: dict[str, float | int | str] = {
        "solve_seconds": time.perf_counter() - began,
        "iterations": 0,
        "solver": "learned",
        "model": model.name,
    }
    return Solution(Status.SOLVED, spline_profile(coefficients, task.path.end, yaw), "", stats)


@njit
def _sound(coefficients: NDArray, yaw: NDArray) -> bool:
    """Return whether all are finite and the coefficients, but for the outermost, positive."""
    sound = True
    for n in range(len(coefficients)):
        sound = sound and math.isfinite(coefficients[n])
    for n in range(1, len(coefficients) - 1):
        sound = sound and coefficients[n] > 0.0
    for n in range(len(yaw)):
        sound = sound and math.isfinite(yaw[n])
    return sound


def propose(task: PlanningTask, model: Model) -> tuple[NDArray, YawSpline]:
    """Return the (N+3,) coefficients of h that a model proposes, not finite where it fails, and yaw."""
    path, nodes, start = task.path, task.nodes, task.start
    intervals = network_intervals(path, nodes, model.window)
    tracks = [
        None if task.yaw is YawMode.FREE else YawSpline.along(path, count, task.yaw, task.yaw_angle, start)
        for count in dict.fromkeys((intervals, nodes))
    ]
    scaled = scaled_limits(task.airframe, task.limits)
    query = Query(path, scaled, intervals, start, tracks[0], task.yaw_angle)
    ((coefficients, turned),) = predict([query], model.network, model.window)
    yaw = tracks[-1]
    if yaw is None:
        places = np.linspace(0.0, intervals, nodes + 1)
        yaw = YawSpline.smoothed(np.interp(places, np.arange(intervals + 1), turned), path.end / nodes, start)
    if intervals < nodes and np.isfinite(coefficients).all():
        coefficients = _interpolated(coefficients, nodes, path, start)
    return coefficients, yaw


def window_overlaps(path: Path, nodes: int, window: int) -> NDArray:
    """Return the ranges of s, (J, 2), where two windows of a network overlap on a path over `nodes` intervals."""
    intervals = network_intervals(path, nodes, window)
    starts, _ = windows_over(intervals, window)
    return np.stack([starts[1:], starts[:-1] + window], axis=1) * (path.end / intervals)


def network_intervals(path: Path, nodes: int, window: int) -> int:
    """Return the intervals of a network's query about a path that is planned over `nodes`."""
    return min(nodes, max(window, math.ceil(path.length / SPACING), len(path.breaks) - 1))


def _interpolated(coefficients: NDArray, nodes: int, path: Path, start: BoundaryState | None) -> NDArray:
    """Return the (N+3,) coefficients of nearly the same h over more intervals; ends are unchanged."""
    step = path.end / nodes
    h, dh, ddh = spline_at(coefficients, path.end, nodes)
    fine = coefficients_of(h, dh, ddh, step)
    fine = np.maximum(fine, LEAST_SHARE * coefficients.min())
    if start is not None:
        fine[:3] = start_coefficients(start, step)
    elif rests(path, 0.0):
        fine[:4] = fine[1]
    if rests(path, path.end):
        fine[-4:] = fine[-2]
    return fine


def predict(queries: list[Query], network: Network, window: int) -> list[ProposedProfile]:
    """Return a proposal for each query; the windows of all queries go through the network at once."""
    batches = [_windows(query, window) for query in queries]
    answers = network(batches[0].inputs if len(batches) == 1 else np.concatenate([each.inputs for each in batches]))
    ends = np.cumsum([len(each.starts) for each in batches])
    return [
        _proposal(query, each, answers[end - len(each.starts) : end])
        for query, each, end in zip(queries, batches, ends, strict=True)
    ]


def _windows(query: Query, window: int) -> _Windows:
    path, scaled, nodes, start, track, yaw_angle = query
    step = path.end / nodes
    table = node_features(path, nodes, scaled, track)
    starts, weights = windows_over(nodes, window)
    inputs = np.empty((len(starts), window + 1, INPUTS), np.float32)
    rest_start, rest_end = start is None and rests(path, 0.0), rests(path, path.end)
    first = (0.0, 0.0, 0.0)
    if start is not None:
        first = start_features(*(each + math.log(scaled.time) for each in start_logs(start, step)))
    for b, place in enumerate(starts):
        begins = b == 0
        yaw, turning = (start.yaw, start.dyaw * step) if start and begins else (yaw_angle, 0.0)
        if track is not None:
            yaw, turning = float(track.yaw[place]), float(track.dyaw[place]) * step
        fill_inputs(
            inputs[b], table[place : place + window + 1], begins and rest_start, b == len(starts) - 1 and rest_end,
            begins and start is not None, first, yaw, turning, track is None, scaled.numbers,
        )  # fmt: skip
    return _Windows(inputs, starts, weights, table[:, REFERENCE], (rest_start, rest_end))


def _proposal(query: Query, windows: _Windows, answers: NDArray) -> ProposedProfile:
    path, scaled, nodes, start, track, yaw_angle = query
    step, starts, weights = path.end / nodes, windows.starts, windows.weights
    rates = overlapped(starts, weights * answers[..., 0]) + windows.reference
    rest_start, rest_end = windows.rests
    begin, settled = Begin.REST if rest_start else Begin.FREE, np.zeros(3)
    if start is not None:
        begin, settled = Begin.KNOWN, np.array(start_logs(start, step)) + math.log(scaled.time)
    logs = smoothed(rates, settled, int(begin), rest_end, scaled.smoothing)
    with np.errstate(over="ignore"):  # then they are not finite
        coefficients = np.exp(2.0 * (logs + math.log(step / scaled.time)))
    if start is not None:
        coefficients[:3] = start_coefficients(start, step)
    if track is not None:
        return ProposedProfile(coefficients, track.yaw)
    turned = np.arctan2(answers[..., 2], answers[..., 1])
    turns = np.diff(turned, axis=1)
    turns -= 2.0 * math.pi * np.round(turns / (2.0 * math.pi))
    total = np.cumsum(overlapped(starts, weights * np.pad(turns, ((0, 0), (1, 0)))))
    # In the middle of its initial range: from a bound, refining would converge to another optimum than the expert's.
    first = start.yaw if start else yaw_angle + FREE_START / 2
    return ProposedProfile(coefficients, first + total - total[0])
