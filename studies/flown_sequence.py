"""Judge the setpoints of a steered flight, from the first to the last, against the limits of plans and of stops.

Results of planner and pilot are not trusted: the committed bytes, as the pilot reports them, are joined into one
sequence. What was sent is compared with that sequence, and the sequence is compared with the committed motions and with
finite differences of its own velocities.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import NotCertifiedError
from cfplan.flight.setpoints.byte_check import check_bytes, check_setpoints
from cfplan.flight.setpoints.commitment import QUANTUM
from cfplan.flight.setpoints.encoding import RATE, EncodedFlight
from cfplan.flight.setpoints.packets import ATTITUDE_QUANTUM, HALF_QUANTUM, FullStateSetpoints, decode
from cfplan.flight.setpoints.rate_trade import gains_under
from cfplan.flight.telemetry import SetpointSent
from cfplan.safety.certificate import certify
from cfplan.safety.limits import Limits
from cfplan.safety.space import inside
from cfplan.vehicle.joint import JoinedTrajectory

_FIELDS = ("position", "velocity", "acceleration", "body_rate")
_SPAN = 2  # setpoints on each side in a central difference of velocity
_ROUNDED = np.sqrt(3.0) * 2.0 * HALF_QUANTUM * RATE / (2.0 * _SPAN)  # m/s², its largest rounding error


@dataclass(frozen=True, slots=True, eq=False)
class Committed:
    """One plan or stop that the pilot accepted, or the plan that the flight began with."""

    splice: int  # number of its first setpoint
    payloads: NDArray  # (K, 29) uint8
    stops: NDArray  # (K, 2, 29) uint8, first and last setpoint of the stop that begins at each
    flown: JoinedTrajectory  # all motion of the flight including it; its clock is 0 at setpoint 0
    stop_from: int = 0  # number of the first setpoint of the stop at its end, or of the stop itself; 0: none
    stop_until: int = 0  # number of the setpoint at which that stop is at rest
    later: int = 0  # setpoints by which all of it is delayed against its proposal


@dataclass(frozen=True, slots=True)
class SequenceVerdict:
    """The worst values of a flown sequence."""

    setpoints: int  # number sent
    missing: int  # moving setpoints between the first and the last that were not sent
    differing: int  # setpoints sent that differ from those committed
    plan_usage: float  # largest usage of any limit in a committed plan, by the dense certificate
    speed: float  # m/s
    acceleration: float  # m/s², by differences of velocity outside stops, less the rounding in packets
    stop_acceleration: float  # m/s², likewise in stops
    joint: float  # quanta, largest jump of any field at a splice
    without_stop: int  # setpoints sent without a committed stop that begins there and ends at rest inside
    faults: tuple[str, ...]  # the exceeded limits, in words


def judge_sequence(
    sent: Mapping[int, SetpointSent], commitments: Sequence[Committed], limits: Limits
) -> SequenceVerdict:
    """Return the verdict on the setpoints sent, by their numbers; the first of `commitments` begins the flight."""
    sequence, stops, joint = _laid_together(commitments)
    numbers = np.array(sorted(sent), dtype=int)
    rows = np.minimum(numbers, len(sequence) - 1)  # the vehicle hovers after the end of the sequence
    flown, planned = _of_messages([sent[number] for number in numbers]), _rows(decode(sequence), rows)
    off = np.max([np.abs(getattr(flown, name) - getattr(planned, name)).max(axis=1) for name in _FIELDS], axis=0)
    in_stop = np.zeros(len(sequence), dtype=bool)
    for each in commitments:
        in_stop[each.splice :] = False
        in_stop[each.stop_from : each.stop_until] = True
    faults = [fault for each in commitments for fault in _byte_faults(each, limits)]
    speed = np.linalg.norm(flown.velocity, axis=1)
    accelerating = _differentiated(flown.velocity, numbers)
    stopping = _widened(in_stop)[rows]
    verdict = SequenceVerdict(
        setpoints=len(numbers),
        missing=_missing(sequence, numbers),
        differing=int((off > 1e-9).sum()),
        plan_usage=_plan_usage(commitments, limits),
        speed=float(speed.max()),
        acceleration=float(accelerating[~stopping].max(initial=0.0)),
        stop_acceleration=float(accelerating[stopping].max(initial=0.0)),
        joint=joint,
        without_stop=_without_stop(flown, stops[rows], limits),
        faults=(),
    )
    return replace(verdict, faults=(*faults, *_exceeded(verdict, limits)))


def _missing(sequence: NDArray, numbers: NDArray) -> int:
    """Return the number of moving setpoints not sent; setpoints at rest do not count, as the pilot repeats the last."""
    moving = np.array(decode(sequence).velocity.any(axis=1))
    moving[numbers[numbers < len(moving)]] = False
    return int(moving[numbers[0] : numbers[-1]].sum())


def _exceeded(verdict: SequenceVerdict, limits: Limits) -> list[str]:
    bounds = (
        ("usage of a limit in a plan", verdict.plan_usage, 1.0),
        ("speed", verdict.speed, limits.plan.speed + 2.0 * HALF_QUANTUM),
        ("acceleration by differences", verdict.acceleration, limits.plan.acceleration),
        ("acceleration by differences in a stop", verdict.stop_acceleration, limits.flight.acceleration.brake),
        ("jump at a splice, in quanta", verdict.joint, 1.0),
        ("setpoints left out", verdict.missing, 0),
        ("setpoints sent that were not committed", verdict.differing, 0),
        ("setpoints sent without a committed stop", verdict.without_stop, 0),
    )
    return [f"{what}: {value:.6g}, allowed {most:g}" for what, value, most in bounds if not value <= most]


def _laid_together(commitments: Sequence[Committed]) -> tuple[NDArray, NDArray, float]:
    """Return the last committed version of all setpoints, (N, 29), their stops, and the largest jump at a splice."""
    sequence, stops, worst = commitments[0].payloads, commitments[0].stops, 0.0
    for each in commitments[1:]:
        waits = max(each.splice - len(sequence) + 1, 0)  # hovers at the end of the previous commitment
        sequence = np.concatenate([sequence, np.repeat(sequence[-1:], waits, axis=0)])
        stops = np.concatenate([stops, np.repeat(stops[-1:], waits, axis=0)])
        worst = max(worst, _jump(sequence[each.splice], each.payloads[0]))
        sequence = np.concatenate([sequence[: each.splice], each.payloads])
        stops = np.concatenate([stops[: each.splice], each.stops])
    return sequence, stops, worst


def _jump(before: NDArray, after: NDArray) -> float:
    """Return the largest difference of two setpoints, (29,), in quanta; attitude counts in its own rounding error."""
    both = decode(np.stack([before, after]))
    fields = max(float(np.abs(np.subtract(*getattr(both, name))).max()) for name in _FIELDS) / QUANTUM
    turned = 2.0 * np.arccos(min(abs(float(both.quaternion[0] @ both.quaternion[1])), 1.0))
    return float(max(round(fields, 6), turned / (2.0 * ATTITUDE_QUANTUM)))


def _plan_usage(commitments: Sequence[Committed], limits: Limits) -> float:
    """Return the largest usage of any limit in any committed motion, by the dense certificate."""
    trajectories = {id(each): each for committed in commitments for each in committed.flown.trajectories}
    return max(certify(each, limits.plan, limits.space).worst.share for each in trajectories.values())


def _byte_faults(committed: Committed, limits: Limits) -> list[str]:
    """Return the faults that the byte check finds in a plan's setpoints, without those of the stop at its end."""
    before_stop = committed.stop_from - committed.splice if committed.stop_from else len(committed.payloads)
    if before_stop <= 0:
        return []  # the commitment is a stop
    first = 1 if committed.splice else 0  # a plan made in the air begins with the setpoint committed before
    payloads = committed.payloads[first:before_stop]
    times = np.arange(first, before_stop) / RATE
    since, decoded = committed.flown.since(committed.splice / RATE), decode(payloads)
    encoded = EncodedFlight(times, payloads, decoded, decoded, gains_under(limits), limits.space)
    check = check_setpoints if committed.stop_from else check_bytes
    try:
        check(encoded, since, limits.plan)
    except NotCertifiedError as error:
        return [f"{error.where} behind {committed.splice}: {error.what}"]
    return []


def _without_stop(flown: FullStateSetpoints, stops: NDArray, limits: Limits) -> int:
    begin, end = decode(stops[:, 0]), decode(stops[:, 1])
    off = np.maximum(
        np.abs(begin.position - flown.position).max(axis=1), np.abs(begin.velocity - flown.velocity).max(axis=1)
    )
    kept = inside(limits.space.beyond(end.position), QUANTUM).all(axis=1)
    return int((~((off <= 1.001 * QUANTUM) & kept & ~end.velocity.any(axis=1))).sum())


def _differentiated(velocity: NDArray, numbers: NDArray) -> NDArray:
    """Return (N,) m/s²: the rate of change of velocity at each setpoint, less the rounding in packets, at least 0."""
    out = np.zeros(len(numbers))
    ahead, behind = np.arange(2 * _SPAN, len(numbers)), np.arange(len(numbers) - 2 * _SPAN)
    change = np.linalg.norm(velocity[ahead] - velocity[behind], axis=1) * RATE / (numbers[ahead] - numbers[behind])
    out[_SPAN : len(numbers) - _SPAN] = np.maximum(change - _ROUNDED, 0.0)
    return out


def _widened(rows: NDArray) -> NDArray:
    """Return (N,) whether any row within _SPAN of each is True."""
    wide = rows.copy()
    for by in range(1, _SPAN + 1):
        wide[by:] |= rows[:-by]
        wide[:-by] |= rows[by:]
    return wide


def _of_messages(messages: Sequence[SetpointSent]) -> FullStateSetpoints:
    return FullStateSetpoints(
        *(np.array([getattr(message, name) for message in messages]) for name in FullStateSetpoints.__slots__)
    )


def _rows(setpoints: FullStateSetpoints, rows: NDArray) -> FullStateSetpoints:
    return FullStateSetpoints(*(getattr(setpoints, name)[rows] for name in FullStateSetpoints.__slots__))
