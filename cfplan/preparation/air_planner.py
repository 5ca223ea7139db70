"""Planning in the air: what is asked for while the vehicle flies, what is proposed for it, and how it is answered.

The planner's process and that on a stepped clock both plan by this.
"""

import contextlib
import math
from dataclasses import dataclass
from enum import StrEnum

from cfplan.errors import CfplanError, NotCertifiedError
from cfplan.flight.setpoints.commitment import Fault, Refusal
from cfplan.flight.setpoints.encoding import RATE
from cfplan.flight.telemetry import Triple
from cfplan.planning.continuation import NoWayError
from cfplan.planning.plan_result import Plan
from cfplan.preparation.certified_flight import EndsBadlyError
from cfplan.preparation.replan import (
    PACE,
    AnswerAttempt,
    HeldFlight,
    Replanned,
    at_pace,
    bound_already,
    go_on,
    halt,
    pace,
    replan,
    replan_behind_stop,
    slowed_ahead,
)
from cfplan.safety.limits import Limits

FIRST_PART, NEXT_PART = 0.3, 0.8  # s of a plan committed at once, at least: its beginning, and more of it
PART = 4.0  # likewise, for each s that planning looks ahead
SLACK = 0.001  # s more than that
NEAR = 0.5  # s before one must plan the next part of a plan, from when on that is done
QUIET = 1.0  # s without a request, after which more of a plan is committed than is near: others may replace it soon
ON_ITS_WAY = "the vehicle is there, or on its way there already"
FARTHEST = 30.0  # s ahead of which no more of it is committed even then, until the vehicle comes nearer


class Wish(StrEnum):
    """What a request is for."""

    EXTEND = "extend"  # fly on through these waypoints after those ahead
    REPLACE = "replace"  # fly through these instead
    STOP = "stop"  # come to rest soon, ahead on the path
    SLOWER = "slower"  # fly what is ahead, and what is asked for later, at PACE times the speed
    FASTER = "faster"  # undo that


class PathVerdict(StrEnum):
    """What became of a request."""

    ACCEPTED = "accepted"
    CHANGED = "changed"  # accepted, but the rest of it is flown otherwise: slower from here on, or after a stop
    REFUSED = "refused"  # no plan, or the pilot did not verify it
    LATE = "late"  # planned, but not in time
    CUT_SHORT = "cut short"  # accepted, but what follows did not pass later: the vehicle rests before its end
    SUPERSEDED = "superseded"  # another request came before it was planned, or before its plan had passed


@dataclass(frozen=True, slots=True)
class PathRequest:
    """A request to change the path in flight."""

    number: int  # by which its answer names it
    wish: Wish
    waypoints: tuple[Triple, ...] = ()  # m


@dataclass(frozen=True, slots=True)
class AnswerTimes:
    """When a planner's process did what for a request that was accepted, s on the clock of time.monotonic()."""

    received: float  # the request
    begun: float  # to plan; of a request whose first proposal came late, the last time
    planned: float  # s that the plan took of what follows, before it was checked
    proposed: float  # to the pilot
    answered: float  # by the pilot


@dataclass(frozen=True, slots=True)
class PathAnswer:
    """The answer to a request."""

    number: int
    verdict: PathVerdict
    reason: str = ""  # one line: why it was refused, or why nothing need be proposed
    joint: float = math.nan  # s from the first setpoint, from when on the new plan is flown
    ends: float = math.nan  # s from the first setpoint, when it ends
    seconds: float = 0.0  # s from the request to the answer
    splice: int = -1  # number of the first setpoint of the proposal that was accepted; -1 where nothing was proposed
    checksum: int = 0  # of that proposal
    plan: Plan | None = None  # behind it; a stop has none
    stop: int = 0  # checksum of the stop that was proposed before it, to go on from rest; 0 where none was
    times: AnswerTimes | None = None  # where it was accepted by a process


def part_within(ahead: float, least: float = FIRST_PART) -> int:
    """Return how many setpoints of a plan to commit at once, where planning looks `ahead`, s; `least`, s, at least.

    The next part is to be committed before the vehicle stops behind this one, a request in between or not.
    """
    return round(max(least, PART * ahead) * RATE)


def wants_more(held: HeldFlight, first: int, quiet: float) -> bool:
    """Return whether the next part of a plan is to be planned, where one may plan from setpoint `first` on.

    It has been `quiet`, s, since the last request.
    """
    within = NEAR if quiet < QUIET else FARTHEST
    return held.unfinished and (held.stops_from is None or held.stops_from < first + round(within * RATE))


def presses(held: HeldFlight, first: int, ahead: float) -> bool:
    """Return whether the next part of a plan must be planned before anything else, to be in time at setpoint `first`.

    Planning looks `ahead`, s.
    """
    return held.stops_from is not None and held.stops_from < first + round(1.5 * ahead * RATE)


def plan_request(
    held: HeldFlight,
    request: PathRequest,
    first: int,
    limits: Limits,
    part: int | None = None,
    attempt: AnswerAttempt | None = None,
) -> Replanned | HeldFlight:
    """Return the proposal from setpoint `first` on that does what is asked for, of so many setpoints as `part` says.

    Where nothing need be proposed, what is held from now on. Raises a CfplanError where no plan does it, TooLateError
    where the `attempt` says so.
    """
    yaw = float(held.flown.at(held.ends).yaw)
    match request.wish:
        case Wish.STOP:
            return halt(held, first, limits)
        case Wish.SLOWER | Wish.FASTER:
            now = min(held.speed, limits.plan.speed)
            speed = now * PACE if request.wish is Wish.SLOWER else now / PACE
            paced = pace(held, first, speed, limits, yaw_angle=yaw, part=part, attempt=attempt)
            return paced or at_pace(held, speed)
    keep = request.wish is Wish.EXTEND
    if (bound := bound_already(held, first, request.waypoints, limits, keep=keep)) is not None:
        return bound
    return replan(held, first, request.waypoints, limits, keep=keep, yaw_angle=yaw, part=part, attempt=attempt)


def plan_behind_stop(
    held: HeldFlight, request: PathRequest, first: int, limits: Limits, part: int, refused: CfplanError
) -> Replanned:
    """Return the proposal to stop from setpoint `first` on, and to do from rest what was `refused` from the motion.

    Raises that where it asks for something else, or cannot be done from rest either.
    """
    if request.wish is Wish.REPLACE and isinstance(refused, (NoWayError, EndsBadlyError, NotCertifiedError)):
        yaw = float(held.flown.at(held.ends).yaw)
        with contextlib.suppress(CfplanError):
            return replan_behind_stop(held, first, request.waypoints, limits, yaw_angle=yaw, part=part)
    raise refused


def plan_next_part(held: HeldFlight, first: int, limits: Limits, part: int) -> Replanned | HeldFlight:
    """Return the proposal, from setpoint `first` on, of the next part of the plan that is held. Raises as go_on()."""
    return go_on(held, first, limits, part, yaw_angle=float(held.flown.at(held.ends).yaw))


def plan_slower(held: HeldFlight, first: int, limits: Limits, part: int, attempt: AnswerAttempt) -> Replanned | None:
    """Return the proposal, from setpoint `first` on, to fly slower where that must be. As slowed_ahead()."""
    return slowed_ahead(held, first, limits, part, attempt, yaw_angle=float(held.flown.at(held.ends).yaw))


def answer_accepted(
    number: int, made: Replanned, stop: int = 0, verdict: PathVerdict = PathVerdict.ACCEPTED
) -> PathAnswer:
    """Return the answer to a request whose proposal the pilot has accepted, behind a stop with that checksum."""
    flown, proposal = made.held.flown, made.proposal
    return PathAnswer(
        number, verdict, joint=made.joint, ends=flown.duration, splice=proposal.splice, checksum=proposal.checksum,
        plan=made.plan, stop=stop,
    )  # fmt: skip


def answer_changed(number: int, made: Replanned) -> PathAnswer:
    """Return what is told of a request that was accepted, where the rest of it is flown by another plan."""
    return answer_accepted(number, made, verdict=PathVerdict.CHANGED)


def answer_held(request: PathRequest, held: HeldFlight) -> PathAnswer:
    """Return the answer to a request for which nothing need be proposed."""
    reason = ON_ITS_WAY if request.waypoints else ""
    return PathAnswer(request.number, PathVerdict.ACCEPTED, reason, ends=held.ends)


def answer_cut_short(number: int, held: HeldFlight, reason: str) -> PathAnswer:
    """Return what is told of a request that was accepted, where the rest of its plan does not pass."""
    return PathAnswer(number, PathVerdict.CUT_SHORT, reason, ends=held.ends)


def answer_refused(request: PathRequest, answer: Refusal) -> PathAnswer:
    """Return the answer to a request whose proposal the pilot has refused."""
    late = answer.fault is Fault.LATE
    return PathAnswer(request.number, PathVerdict.LATE if late else PathVerdict.REFUSED, str(answer))
