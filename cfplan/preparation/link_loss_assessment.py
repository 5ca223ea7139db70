"""Link-loss assessment: how far beyond the walls the vehicle ends if each setpoint is the last one.

Setpoints of stops are assessed too. There are a hundred times as many as in the plan, so they are sampled: every tenth
stop at every twelfth of its setpoints, and more densely around those that end near a wall or send more than harmless
rates, up to every stop at every other setpoint (GRIDS).

Most setpoints are far from all walls, as a coarse simulation shows with a margin. Those that may end outside are
simulated with every motor lag.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.setpoints.encoding import RATE, EncodedFlight
from cfplan.flight.setpoints.packets import PAYLOAD_SIZE, decode
from cfplan.flight.setpoints.stops import DURATION, encode_stops
from cfplan.preparation.local_slowing import Assessment, SimulatedLinkLoss
from cfplan.safety.limits import Limits
from cfplan.safety.space import SIDES
from cfplan.simulation.link_loss import (
    ALLOWANCE,
    LinkLossMoments,
    link_loss_near_walls,
    link_loss_within_stops,
)

MARGIN = 0.02  # m inside the walls, planning's target; more than the last refinement changes
OUTSIDE_HINT = (
    "keep the path farther from there; in a room with nets, write `outside: warn` under `link_loss` in safety.yaml"
)
_LEAST_REACH = 1e-3  # m
STOPS_EVERY, STOPS_EACH = 10, 12  # setpoints between sampled stops, and between samples within a stop
GRIDS = ((STOPS_EVERY, STOPS_EACH, 0.18), (3, 4, 0.1), (1, 2, 0.0))
"""Denser grids, each used around samples that ended within the given distance, m, of a wall on the one before."""


def assess_link_loss(encoded: EncodedFlight, limits: Limits, margin: float = MARGIN) -> Assessment:
    """Simulate each setpoint as the last one; it is at fault if the vehicle ends within `margin`, m, of a wall."""
    moments, faces = link_loss_near_walls(encoded.payloads, limits, margin), limits.space.faces

    def describe(at: int) -> str:
        return f"takes the vehicle to {limits.space.describe(moments.beyond[at], moments.face[at])}"

    return Assessment(
        what="link loss",
        time=encoded.times,
        excess=moments.beyond + margin,
        reach=_reach(moments),
        describe=describe,
        near=lambda at: faces[moments.face[at]],
        hint=OUTSIDE_HINT,
        simulated=SimulatedLinkLoss(encoded.payloads, moments),
    )


def assess_link_loss_of_stops(
    encoded: EncodedFlight,
    limits: Limits,
    plan: LinkLossMoments,
    margin: float = MARGIN,
    stops: NDArray | None = None,
) -> Assessment:
    """Simulate link loss within stops from the setpoints of a flight, whose own link loss is `plan`.

    `stops`, (N, M, 29) uint8, are those from every setpoint; if not given, they are made as needed. A setpoint is at
    fault for a stop sampled from it, never without one. Samples that were only simulated coarsely count with their
    upper bound.
    """
    count, length = len(encoded.payloads), round(DURATION * RATE) + 1
    sampled = _Sampled(np.full(count, -np.inf), np.full(count, _LEAST_REACH), np.zeros(count, dtype=int))
    about, done = np.ones((count, length), dtype=bool), np.zeros((count, length), dtype=bool)

    def made(begin: NDArray) -> NDArray:
        if stops is not None:
            return stops[begin]
        return encode_stops(encoded.motion, RATE, rows=begin, gains=encoded.gains, space=encoded.space)

    for every, each, near in GRIDS:
        asked = about & _every(count, every)[:, None] & _every(length, each) & ~done
        if not asked.any():
            break
        about, done = (
            _about(_sample(sampled, asked, made, encoded, limits, plan, margin=margin) > -near, every, each),
            done | asked,
        )
    faces = limits.space.faces

    def describe(at: int) -> str:
        return f"takes the vehicle to {limits.space.describe(sampled.beyond[at], sampled.face[at])}"

    return Assessment(
        what="link loss within a stop",
        time=encoded.times,
        excess=sampled.beyond + margin,
        reach=sampled.reach,
        describe=describe,
        near=lambda at: faces[sampled.face[at]],
        hint=OUTSIDE_HINT,
    )


@dataclass(frozen=True, slots=True)
class _Sampled:
    """The worst sample of the stops from each setpoint, updated in place."""

    beyond: NDArray  # (N,) m beyond a face of the space; -inf if no stop was sampled
    reach: NDArray  # (N,) m
    face: NDArray  # (N,) int, of the space


def _sample(
    sampled: _Sampled,
    asked: NDArray,
    made: Callable[[NDArray], NDArray],
    encoded: EncodedFlight,
    limits: Limits,
    plan: LinkLossMoments,
    *,
    margin: float,
) -> NDArray:
    """Simulate link loss in the stops and at the rows marked in `asked`, (N, M).

    `made` returns the stops from some setpoints. Returns, (N, M), how far beyond the walls they end by the coarse
    simulation: inf for more than harmless rates, -inf if not simulated.
    """
    begin = np.flatnonzero(asked.any(axis=1))
    forks, starts = asked[begin], plan.snapshots[:, begin]
    stops = made(begin)
    seen = link_loss_within_stops(stops, starts, limits, forks, coarsely=True)
    beyond, reach, face = seen.beyond + ALLOWANCE, _reach(seen), seen.face
    in_doubt = ~(beyond < -margin)
    if in_doubt.any():
        exactly = forks.copy()
        exactly[forks] = in_doubt
        some = exactly.any(axis=1)
        found = link_loss_within_stops(stops[some], starts[:, some], limits, exactly[some])
        beyond[in_doubt], reach[in_doubt], face[in_doubt] = found.beyond, _reach(found), found.face
    beyond = np.where(np.isnan(beyond), np.inf, beyond)

    rates = decode(stops.reshape(-1, PAYLOAD_SIZE)).body_rate[:, :2]
    harmful = (np.linalg.norm(rates, axis=1) > encoded.gains.level_out.rate_max + 1e-3).reshape(forks.shape)
    near = np.full(asked.shape, -np.inf)
    near[asked] = np.where(np.isnan(seen.beyond), np.inf, seen.beyond)
    near[begin] = np.where(harmful, np.inf, near[begin])

    of_all = np.full(forks.shape, -np.inf)
    of_all[forks] = beyond
    numbers = np.full(forks.shape, -1)
    numbers[forks] = np.arange(len(beyond))
    at = numbers[np.arange(len(begin)), of_all.argmax(axis=1)]
    worse = beyond[at] > sampled.beyond[begin]
    for values, new in ((sampled.beyond, beyond), (sampled.reach, reach), (sampled.face, face)):
        values[begin[worse]] = new[at[worse]]
    return near


def _about(near: NDArray, every: int, each: int) -> NDArray:
    """Return, (N, M), the neighbourhood of the samples that are `near`, (N, M), up to the next samples."""
    return _closer_than(every, _closer_than(each, near.T).T)


def _closer_than(distance: int, near: NDArray) -> NDArray:
    """Return, (N, M), whether any row less than `distance` away is `near`, (N, M)."""
    before = np.cumsum(np.pad(near, ((1, 0), (0, 0))), axis=0)
    row = np.arange(len(near))
    return before[np.minimum(row + distance, len(near))] > before[np.maximum(row - distance + 1, 0)]


def _every(count: int, step: int) -> NDArray:
    """Return (N,) bool: every `step`-th, and the last."""
    number = np.arange(count)
    return (number % step == 0) | (number == count - 1)


def _reach(moments: LinkLossMoments) -> NDArray:
    """Return how far each moves towards the nearest wall, m, positive; horizontally if that is an obstacle."""
    to_walls = np.concatenate([moments.place - moments.low, moments.high - moments.place], axis=1)
    wall = np.minimum(moments.face, SIDES - 1)
    reach = np.where(moments.face < SIDES, to_walls[np.arange(len(wall)), wall], moments.distance)
    return np.maximum(reach, _LEAST_REACH)
