"""Link loss as an assessment: how far beyond the walls each setpoint leaves the vehicle, were it the last one.

So do the setpoints of the stops. There are a hundred times as many of these as setpoints of the plan, so they are
sampled: every tenth stop after every twelfth of its setpoints; and each stop about one that so comes near a wall or
sends more than harmless rates, after every other setpoint.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.setpoints.encoding import RATE, EncodedFlight
from cfplan.flight.setpoints.packets import PAYLOAD_SIZE, decode
from cfplan.flight.setpoints.rate_trade import BRAKE_RATE_MAX
from cfplan.flight.setpoints.stops import encode_stops
from cfplan.preparation.local_slowing import Assessment, SimulatedLinkLoss
from cfplan.safety.limits import Limits
from cfplan.simulation.link_loss import WALLS, LinkLossMoments, link_loss_at_every_setpoint, link_loss_within_stops

MARGIN = 0.02  # m inside the walls that planning aims at: what the last refinement changes stays within
OUTSIDE_HINT = (
    "keep the path farther from that wall; in a room with nets, write `outside: warn` under `link_loss` in safety.yaml"
)
_LEAST_REACH = 1e-3  # m
STOPS_EVERY, STOPS_EACH, STOPS_DENSE = 10, 12, 2  # setpoints between sampled stops, within them, and near a wall
STOPS_NEAR = 0.15  # m from a wall, within which stops are sampled densely


def assess_link_loss(encoded: EncodedFlight, limits: Limits, margin: float = MARGIN) -> Assessment:
    """Simulate that each setpoint is the last one; what comes down within `margin`, m, of a wall is at fault."""
    moments = link_loss_at_every_setpoint(encoded.payloads, limits)
    number, (axis, side) = np.arange(len(moments.time)), np.array(WALLS)[moments.wall].T
    reach = np.where(side[:, None], moments.high - moments.place, moments.place - moments.low)[number, axis]

    def describe(at: int) -> str:
        far = (
            f"{moments.beyond[at]:.2f} m beyond"
            if moments.beyond[at] > 0.0
            else f"within {-moments.beyond[at]:.2f} m of"
        )
        return f"takes the vehicle {far} {moments.name_of_wall(at, limits)}"

    return Assessment(
        what="link loss",
        time=encoded.times,
        excess=moments.beyond + margin,
        reach=np.maximum(reach, _LEAST_REACH),
        describe=describe,
        near=lambda at: moments.name_of_wall(at, limits),
        hint=OUTSIDE_HINT,
        simulated=SimulatedLinkLoss(encoded.payloads, moments),
    )


def assess_link_loss_of_stops(
    encoded: EncodedFlight, limits: Limits, plan: LinkLossMoments, margin: float = MARGIN
) -> Assessment:
    """Simulate that the link is lost within stops from the setpoints of a flight, whose own link loss is `plan`.

    A setpoint is at fault for a stop that was sampled from it; one from which none was is not.
    """
    count = len(encoded.payloads)
    worst, far, walls = np.full(count, -np.inf), np.full(count, _LEAST_REACH), np.zeros(count, dtype=int)

    def sample(begin: NDArray, each: int, rows: slice = slice(None)) -> tuple[NDArray, NDArray]:
        stops = encode_stops(encoded.motion, RATE, rows=begin, gains=encoded.gains, space=encoded.space)
        within = np.unique(np.append(np.arange(0, stops.shape[1], each), stops.shape[1] - 1))[rows]
        found = link_loss_within_stops(stops, plan.snapshots[:, begin], limits, within)
        beyond = found.beyond.reshape(len(begin), len(within))
        beyond = np.where(np.isnan(beyond), np.inf, beyond)
        rates = decode(stops.reshape(-1, PAYLOAD_SIZE)).body_rate[:, :2].reshape(*stops.shape[:2], 2)
        harmful = np.linalg.norm(rates, axis=2) > BRAKE_RATE_MAX + 1e-3
        number = np.arange(len(begin)) * len(within) + beyond.argmax(axis=1)
        axis, side = np.array(WALLS)[found.wall[number]].T
        up, down = (found.high - found.place)[number, axis], (found.place - found.low)[number, axis]
        higher = beyond.max(axis=1) > worst[begin]
        some = begin[higher]
        worst[some], far[some], walls[some] = (
            beyond.max(axis=1)[higher],
            np.where(side, up, down)[higher],
            found.wall[number][higher],
        )
        near = np.concatenate([within[beyond.max(axis=0) > -STOPS_NEAR], np.flatnonzero(harmful.any(axis=0))])
        return begin[(beyond.max(axis=1) > -STOPS_NEAR) | harmful.any(axis=1)], near

    coarse = np.unique(np.append(np.arange(0, count, STOPS_EVERY), count - 1))
    near, within = sample(coarse, STOPS_EACH)
    if len(near):
        about = near[:, None] + np.arange(1 - STOPS_EVERY, STOPS_EVERY)
        first, last = max(within.min() - STOPS_EACH, 0), within.max() + STOPS_EACH
        rows = slice(int(first) // STOPS_DENSE, int(last) // STOPS_DENSE + 1)
        sample(np.unique(np.clip(about, 0, count - 1)), STOPS_DENSE, rows)
    moments = replace(plan, wall=walls)

    def describe(at: int) -> str:
        where = f"{worst[at]:.2f} m beyond" if worst[at] > 0.0 else f"within {-worst[at]:.2f} m of"
        return f"takes the vehicle {where} {moments.name_of_wall(at, limits)}"

    return Assessment(
        what="link loss within a stop",
        time=encoded.times,
        excess=worst + margin,
        reach=np.maximum(far, _LEAST_REACH),
        describe=describe,
        near=lambda at: moments.name_of_wall(at, limits),
        hint=OUTSIDE_HINT,
    )
