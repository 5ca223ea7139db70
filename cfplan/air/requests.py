"""Requests to change the path in flight, and the answers to them."""

import math
from dataclasses import dataclass
from enum import StrEnum

from cfplan.flight.telemetry import Triple
from cfplan.planning.plan_result import Plan


class Wish(StrEnum):
    """The kind of a request."""

    EXTEND = "extend"  # fly on through these waypoints after those ahead
    REPLACE = "replace"  # fly through these instead
    STOP = "stop"  # come to rest soon, ahead on the path
    SLOWER = "slower"  # fly the rest, and later requests, at three quarters of the speed
    FASTER = "faster"  # undo SLOWER


class PathVerdict(StrEnum):
    """The outcome of a request."""

    ACCEPTED = "accepted"
    CHANGED = "changed"  # accepted, but the rest of it is flown otherwise: slower from here on, or after a stop
    REFUSED = "refused"  # no plan, or the pilot did not verify it
    LATE = "late"  # planned, but not in time
    CUT_SHORT = "cut short"  # accepted, but what follows did not pass later: the vehicle rests before its end
    SUPERSEDED = "superseded"  # another request came before it was planned


@dataclass(frozen=True, slots=True)
class PathRequest:
    """A request to change the path in flight."""

    number: int  # its answer has the same number
    wish: Wish
    waypoints: tuple[Triple, ...] = ()  # m


@dataclass(frozen=True, slots=True)
class AnswerTimes:
    """Times of the steps until a request was accepted, s on the flight's clock."""

    received: float  # the request
    begun: float  # planning; of a request whose first proposal came late, of the second
    planned: float  # s that the plan took, before its setpoints were certified
    proposed: float  # to the pilot
    answered: float  # by the pilot


@dataclass(frozen=True, slots=True)
class PathAnswer:
    """The answer to a request."""

    number: int
    verdict: PathVerdict
    reason: str = ""  # one line: why it was refused, or why nothing need be proposed
    joint: float = math.nan  # s from the first setpoint, when the new plan takes over
    ends: float = math.nan  # s from the first setpoint, when the motion ends
    seconds: float = 0.0  # s from the request to the answer
    splice: int = -1  # number of the first setpoint of the proposal that was accepted; -1 where nothing was proposed
    checksum: int = 0  # of that proposal
    plan: Plan | None = None  # behind it; a stop has none
    stop: int = 0  # checksum of the stop that was proposed before it, to go on from rest; 0 where none was
    times: AnswerTimes | None = None  # where it was accepted
